"""Sources without a device: a model computes their registers, in the source or in a client."""
