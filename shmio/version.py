"""The version of shmio."""

__version__ = "0.1.0"
