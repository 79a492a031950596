"""Plan an instance: from a checked configuration to the processes to start."""
