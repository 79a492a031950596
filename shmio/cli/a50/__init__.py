"""The A50 example that ``shmio-supervisor init`` writes; data only."""
