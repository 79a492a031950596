"""The OPC UA endpoint: serves the instance as an address space."""
