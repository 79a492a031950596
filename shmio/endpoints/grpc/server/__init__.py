"""The gRPC server: listeners, TLS, the guard that checks every call, access control, and health."""
