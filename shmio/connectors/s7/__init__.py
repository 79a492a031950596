"""The S7 connector: reads and writes data of a Siemens controller over ISO-on-TCP.

``connector`` reads a data block as a layout describes it, and ``table`` reads the addresses of a
tag table. Both build on ``session``, which also has the configuration keys. ``transport`` has the
socket and the requests in flight. ``pdu`` and ``userdata`` encode and parse PDUs. ``blocks``,
``mode``, ``cpu`` and ``block_check`` have the operations, each with its requests and answers.
``explain`` has the error messages for refusals.
"""

from shmio.connectors.s7.connector import S7Client, S7Options

__all__ = ["S7Client", "S7Options"]
