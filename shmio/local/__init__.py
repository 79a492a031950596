"""A cell on this host: attach to its shared memory, read, write, inject, step, replay."""
