"""The addresses of tag tables, for each protocol but S7: what a device calls a register."""
