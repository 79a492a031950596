"""The S7 connector: reads a data block of a Siemens controller over ISO-on-TCP.

``options`` is what the config can say, ``pdu`` the bytes, ``blockread`` the order of requests and answers,
``client`` the socket.
"""

from shmio.connectors.s7.client import S7Client
from shmio.connectors.s7.options import S7Options

__all__ = ["S7Client", "S7Options"]
