"""The S7 connector: reads and writes a data block of a Siemens controller over ISO-on-TCP.

``options`` is what the config can say. ``pdu`` and ``writepdu`` are the bytes; ``blockread``, ``blockwrite``, ``mode``
and ``blocksize`` are what is asked, each with the answers it expects; ``window`` has them share the jobs that the
controller granted; ``transport`` is the socket; ``client`` puts them together. ``explain`` has the words for what goes
wrong.
"""

from shmio.connectors.s7.client import S7Client
from shmio.connectors.s7.options import S7Options

__all__ = ["S7Client", "S7Options"]
