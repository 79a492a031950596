"""shmio: shared-memory I/O for digital twins of multi-robot cells."""

__version__ = "0.1.0"
