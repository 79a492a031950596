"""Convert the tag lists of other vendors' tools to tag tables; one file for each format."""
