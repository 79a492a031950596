"""Convert between a register's bytes and Python values, text and S7 literals."""
