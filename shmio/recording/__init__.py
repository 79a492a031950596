"""What a recording holds, and reading it (docs/reference/dump-format.md). It is written by `shmio.recorder`."""
