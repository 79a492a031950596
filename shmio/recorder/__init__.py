"""The recorder writes frames and events of an instance to `.mem` files (docs/reference/dump-format.md)."""
