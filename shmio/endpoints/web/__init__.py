"""The HTTP endpoint: the web page, and metrics of the instance for Prometheus."""
