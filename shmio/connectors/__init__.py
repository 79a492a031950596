"""Connectors read and write devices: a class for each protocol, and a process for each source."""
