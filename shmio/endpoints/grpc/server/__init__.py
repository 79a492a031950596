"""The gRPC server: listeners, TLS, the guard that checks each call, access control, and health."""
