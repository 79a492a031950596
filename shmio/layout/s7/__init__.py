"""Addresses and conversion of values in the memory of an S7 controller. No I/O."""
