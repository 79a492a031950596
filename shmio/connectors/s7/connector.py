"""The S7 connector: one data block of one controller."""

from __future__ import annotations

from collections.abc import Sequence

from shmio.connectors.base import Connector
from shmio.connectors.s7.client import LONGEST_WRITE_S, S7Client
from shmio.connectors.s7.options import S7Options
from shmio.errors import ConfigError
from shmio.layout.model import Layout
from shmio.layout.values.write import Write


class S7Connector(Connector):
    """Reads the whole block each cycle.

    A read of several PDUs does not show a single instant of the PLC.
    """

    Options = S7Options
    can_write = True

    def __init__(self, options: S7Options, layout: Layout) -> None:
        number = options.dbNumber if options.dbNumber is not None else layout.number
        if number is None:
            raise ConfigError(
                f"dbNumber: this key is needed, because the layout {layout.name!r} has no number in its name"
            )
        if layout.byte_order != "big":
            raise ConfigError(f"layout: {layout.name!r} is in little-endian byte order, a controller's block is not")
        self._client = S7Client(options, number, layout.size)
        self._timeout_s = max(options.timeout / 1000, LONGEST_WRITE_S)

    @property
    def timeout_s(self) -> float:
        """The longer of ``timeout`` and the limit for a batch of writes, in s."""
        return self._timeout_s

    @property
    def depth(self) -> int:
        """Reads that may be in flight with the granted jobs."""
        return self._client.depth

    @property
    def doubt(self) -> str:
        """Why values may not change (the PLC is in STOP); empty if there is no reason."""
        return self._client.doubt

    def connect(self) -> None:
        """Open a session."""
        self._client.connect()

    def read(self) -> bytes:
        """Read the whole block."""
        return self._client.read()

    def submit(self) -> None:
        """Request the whole block."""
        self._client.submit()

    def collect(self, until_ns: int) -> bytes | None:
        """Wait for the block of the oldest ``submit``."""
        return self._client.collect(until_ns)

    def write(self, writes: Sequence[Write]) -> list[str]:
        """Write bytes and single bits, in this order."""
        return self._client.write(writes)

    def close(self) -> None:
        """Drop the session."""
        self._client.close()

    def describe(self) -> str:
        """Return peer and session parameters as granted."""
        client = self._client
        granted = f"pdu={client.pdu_size} jobs={client.jobs} depth={client.depth}"
        return f"to {client.options.peer} DB{client.db_number} {granted}"
