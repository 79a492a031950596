"""The OPC UA endpoint: serves the instance as an OPC UA address space."""
