"""Reads, writes, rewrites, compares and exports recordings (docs/reference/dump-format.md)."""
