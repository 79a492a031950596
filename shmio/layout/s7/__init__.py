"""Values in the memory of an S7 controller: their addresses, and their conversion. Pure."""
