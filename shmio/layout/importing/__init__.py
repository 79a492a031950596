"""Convert tag lists of other vendors' tools to tag tables; one module for each format."""
