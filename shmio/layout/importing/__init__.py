"""Convert tag lists of other vendors' tools to tag tables. Each format has a module."""
