"""What tests and benchmarks share: faults on the wire, ports. Never imported by the rest of shmio."""
