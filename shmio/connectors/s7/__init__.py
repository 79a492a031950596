"""The S7 connector: reads and writes a data block of a Siemens controller over ISO-on-TCP.

``connector`` has the keys and the client. ``transport`` is the socket with its requests in flight,
``pdu`` encodes and parses PDUs. ``blocks`` and ``mode`` are the operations, each with its requests
and answers. ``explain`` has the texts of refusals.
"""

from shmio.connectors.s7.connector import S7Client, S7Options

__all__ = ["S7Client", "S7Options"]
