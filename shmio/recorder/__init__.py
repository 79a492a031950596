"""Writes recordings: `.mem` files with every frame and event of an instance (docs/reference/dump-format.md)."""
