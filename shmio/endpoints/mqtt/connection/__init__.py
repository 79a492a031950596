"""Connections to the broker: making and retrying them, and reading and writing their sockets."""
