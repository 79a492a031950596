"""Sources without a device: memory, and models that run in the source's process or in a client."""
