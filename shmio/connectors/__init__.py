"""Connectors, which read and write devices: one class for each protocol, run in one process for each source."""
