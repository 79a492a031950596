"""The S7 connector for layouts, which reads and writes one data block."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from shmio.connectors.base import Connector
from shmio.connectors.request_count import CycleRequests
from shmio.connectors.s7 import pdu
from shmio.connectors.s7.block_check import BlockChangeMonitor, ExpectedBlock
from shmio.connectors.s7.blocks import BlockRead, BlockWrite, SizeProbe, waves
from shmio.connectors.s7.explain import OUT_OF_RANGE, RefusedError, explain_size
from shmio.connectors.s7.request_count import NOTE, by_pdu_size
from shmio.connectors.s7.session import MAX_DEPTH, REGISTER_OPTIONS, Read, S7Options, S7Session
from shmio.errors import ConfigError, ConnectorError
from shmio.layout.model import Layout
from shmio.layout.values.write import Write, covering

__all__ = ["S7Client", "S7Connector", "S7Options"]


class S7Client(S7Session):
    """Reads and writes one data block of one controller."""

    def __init__(self, options: S7Options, db_number: int, size: int) -> None:
        """Create a client, without connecting, for ``size`` bytes of data block ``db_number``.

        Raises:
            ConfigError: S7 cannot address such a block.

        """
        if not 1 <= size <= pdu.MAX_BLOCK_SIZE:
            raise ConfigError(f"DB{db_number} has {size} bytes, but S7 reads blocks of 1 to {pdu.MAX_BLOCK_SIZE} bytes")
        if not 1 <= db_number <= 65535:
            raise ConfigError(f"DB{db_number}: data blocks are numbered 1 to 65535")
        super().__init__(options)
        self.db_number = db_number
        self.size = size
        self._bits: bytes | None = None  # those that registers have; None: all

    def _reads(self) -> list[Read]:
        chunk = self._chunk(self.pdu_size)
        first = BlockRead(self.db_number, self.size, chunk)
        depth = min(max(1, self.jobs // first.count), MAX_DEPTH)
        return [first, *(BlockRead(self.db_number, self.size, chunk) for _ in range(depth - 1))]

    def _chunk(self, pdu_size: int) -> int:
        """Return the largest number of data bytes in a request."""
        return min(pdu_size - pdu.READ_OVERHEAD, self.options.packetSize or self.size, self.size)

    def _waves(self, writes: Sequence[Write], outcomes: list[str]) -> Iterator[BlockWrite]:
        return waves(self.db_number, self.pdu_size, writes, outcomes, self._bits)

    def _explained(self, refusal: RefusedError, deadline_ns: int) -> RefusedError:
        """Return the refusal of a read. If the block is too short, the text gives its real length."""
        if refusal.code != OUT_OF_RANGE:
            return refusal
        probe = SizeProbe(self.db_number, self.size, self.pdu_size)
        try:
            while probe.found is None:
                probe.begin()
                self._window.add(probe, urgent=True)
                self._flush()
                self._finish(probe, deadline_ns)
        except (ConnectorError, OSError, EOFError):
            return refusal
        return RefusedError(self._explain_size(probe.found), OUT_OF_RANGE)

    def _explain_size(self, found: int) -> str:
        """Return a message for a block that has only ``found`` bytes."""
        return explain_size(self.db_number, self.size, found)


class S7Connector(S7Client, Connector):
    """The connector ``s7``: reads and writes the data block that a layout describes."""

    Options = S7Options
    can_write = True
    cannot_browse = (
        "an S7 controller does not tell the names in its blocks; export the data block as .db, or the PLC tags for "
        "shmio-layout import, from TIA Portal. If the CPU has an OPC UA server, browse opc.tcp://HOST:4840"
    )
    register_options = REGISTER_OPTIONS

    @classmethod
    def for_layout(cls, layout: Layout) -> type[Connector]:
        """Return this class, or the class of connectors for tag tables if registers have addresses."""
        if not layout.addressed:
            return cls
        from shmio.connectors.s7.table import S7TableConnector  # noqa: PLC0415  data blocks do not need it

        return S7TableConnector

    def __init__(self, options: S7Options, layout: Layout) -> None:
        number = options.dbNumber if options.dbNumber is not None else layout.number
        if options.every:
            raise ConfigError(
                "every: a data block is read as a whole; to read some registers less often, use a tag table with "
                "addresses"
            )
        if number is None:
            raise ConfigError(
                f"dbNumber: this key is needed, because the layout {layout.name!r} has no number in its name"
            )
        if layout.byte_order != "big":
            raise ConfigError(f"layout: {layout.name!r} is little-endian, but a controller's block is big-endian")
        super().__init__(options, number, layout.size)
        self._bits = covering(layout.own, layout.size, padding=False)
        ends = [(register.offset + register.size, register.path) for register in layout.registers]
        self._described = ExpectedBlock(number, layout.name, layout.size, ends, whole=True)
        self._watch = BlockChangeMonitor([self._described])
        self._add_query(self._watch)

    @property
    def doubt(self) -> str:
        """Why values may be frozen or may not fit the layout; empty if there is no reason for doubt."""
        return "; ".join(filter(None, (*self._watch.doubts.values(), super().doubt)))

    def _explain_size(self, found: int) -> str:
        gone = self._described.beyond(found)
        return explain_size(self.db_number, self.size, found, self._described.name, gone)

    def describe(self) -> str:
        """Return, for the log, the peer and the parameters of the session."""
        return f"to {self.options.peer} DB{self.db_number} pdu={self.pdu_size} jobs={self.jobs} depth={self.depth}"

    def cycle_requests(self) -> CycleRequests:
        """Return the number of requests that read the block, for each PDU size that a controller may grant."""
        requests = by_pdu_size(lambda pdu_size: -(-self.size // self._chunk(pdu_size)))
        return CycleRequests(f"bytes 0 to {self.size - 1} of DB{self.db_number}", requests, NOTE)
