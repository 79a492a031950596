"""Virtual time for gRPC clients: stepping, playing, and the delivery of each step."""
