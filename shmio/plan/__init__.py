"""Plans an instance: turns a checked configuration into the processes to start."""
