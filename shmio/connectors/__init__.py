"""Connectors: one class for each protocol, one loop for all, a process for each source."""
