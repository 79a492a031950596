"""Encodes and decodes the messages and records of recordings (docs/reference/dump-format.md)."""
