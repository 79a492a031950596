"""The HTTP endpoint: the web page, and the instance's metrics for Prometheus."""
