"""Code that tests and benchmarks share: faults on the wire, ports. Never imported at run time."""
