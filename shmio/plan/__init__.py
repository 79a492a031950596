"""From a checked configuration to the processes to start: layouts, sources, injections, ports."""
