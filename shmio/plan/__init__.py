"""Plan an instance: turn a checked configuration into the processes to start."""
