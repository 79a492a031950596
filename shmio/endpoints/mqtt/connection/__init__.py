"""Connections to the broker: connecting, retrying, and reading and writing the socket."""
