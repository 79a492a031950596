"""Recordings (docs/reference/dump-format.md): read, write, rewrite, compare and export them."""
