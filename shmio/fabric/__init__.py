"""The fabric: joins instances on many hosts by NATS (docs/how-to/join-hosts.md).

The uplink (``shmio.endpoints.fabric``) publishes a cell, and mirrors (``shmio.connectors.fabric``)
reproduce its sources elsewhere. Both use the names, messages and connections of this package.
"""
