"""The HTTP endpoint: figures of the instance for Prometheus."""
