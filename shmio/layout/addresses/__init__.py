"""Addresses in tag tables, which tell where a device has a register; one module for each protocol but S7."""
