"""The gRPC server: listeners, TLS, the guard every call passes, access, health."""
