"""Injections by gRPC clients of all wire versions."""
