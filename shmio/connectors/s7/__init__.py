"""The S7 connector: reads and writes a data block of a Siemens controller over ISO-on-TCP.

``connector`` has the configuration keys and the client. ``transport`` has the socket and the
requests in flight. ``pdu`` encodes and parses PDUs. ``blocks`` and ``mode`` are the operations,
each with its requests and answers. ``explain`` has the error messages for refusals.
"""

from shmio.connectors.s7.connector import S7Client, S7Options

__all__ = ["S7Client", "S7Options"]
