"""Connectors, which read and write devices. Each protocol has a class, and each source has a process."""
