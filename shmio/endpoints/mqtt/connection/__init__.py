"""Connections to the broker: connecting, retrying, reading and writing the socket."""
