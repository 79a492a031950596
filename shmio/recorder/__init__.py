"""The recorder writes the frames and events of an instance to `.mem` files.

docs/reference/dump-format.md describes their format.
"""
