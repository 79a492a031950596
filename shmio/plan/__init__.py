"""Plans an instance: determines the blocks and processes for a configuration, and checks the configuration."""
