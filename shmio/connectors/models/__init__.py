"""Sources without a device: their registers are computed by a model, here or elsewhere."""
