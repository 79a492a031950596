"""Classic S7 as a connector: one data block of one controller."""

from __future__ import annotations

from shmio.connectors.base import Connector
from shmio.connectors.s7.client import S7Client
from shmio.connectors.s7.options import S7Options
from shmio.errors import ConfigError
from shmio.layout.model import Layout


class S7Connector(Connector):
    """Reads the whole block each cycle. A read of several PDUs is not one instant of the PLC (docs/how-to)."""

    Options = S7Options

    def __init__(self, options: S7Options, layout: Layout) -> None:
        number = options.dbNumber if options.dbNumber is not None else layout.number
        if number is None:
            raise ConfigError(f"dbNumber: this key is needed, for the layout {layout.name!r} has no number in its name")
        self._client = S7Client(options, number, layout.size)
        self._timeout_s = options.timeout / 1000

    @property
    def timeout_s(self) -> float:
        """``timeout``; connecting and reading have it each."""
        return self._timeout_s

    def connect(self) -> None:
        """Open a session."""
        self._client.connect()

    def read(self) -> bytes:
        """The whole block."""
        return self._client.read()

    def close(self) -> None:
        """Drop the session."""
        self._client.close()

    def describe(self) -> str:
        """Peer and session, as granted."""
        client = self._client
        return f"to {client.options.peer} DB{client.db_number} pdu={client.pdu_size} jobs={client.jobs}"
