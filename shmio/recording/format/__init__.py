"""The messages and records of a recording (docs/reference/dump-format.md)."""
