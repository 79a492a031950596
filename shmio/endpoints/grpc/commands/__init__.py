"""Commands from gRPC clients: paths resolved, values sent to sources, outcomes returned."""
