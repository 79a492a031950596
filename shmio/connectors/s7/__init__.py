"""The S7 connector: reads and writes a data block of a Siemens controller over ISO-on-TCP.

``options`` has the configuration keys and ``pdu`` encodes and parses PDUs. ``block_read``,
``block_write``, ``block_size`` and ``mode`` are the operations, each with its requests and answers.
``window`` shares the granted jobs among them, ``transport`` is the socket, and ``client`` combines
all. ``explain`` has the texts of errors.
"""

from shmio.connectors.s7.client import S7Client
from shmio.connectors.s7.options import S7Options

__all__ = ["S7Client", "S7Options"]
