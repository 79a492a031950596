"""Compiles layouts, finds their registers by path, and converts the registers' values. No I/O."""
