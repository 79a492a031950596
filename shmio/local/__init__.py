"""A cell on this host: attaches to its shared memory to read, write, inject, step and replay."""
