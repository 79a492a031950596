"""Read recordings, and their format (docs/reference/dump-format.md). `shmio.recorder` writes them."""
