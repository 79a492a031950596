"""The HTTP endpoint: the web page, and figures of the instance for Prometheus."""
