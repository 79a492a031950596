"""The uplink, which publishes the cell in the fabric, and the embedded NATS server."""
