"""Notices that a data block in the controller is not the one that its layout describes. No I/O.

S7-300 and S7-400 report a block's length, checksum and time of compilation. The connector asks for
them at the start of each session and once a minute, and compares them with the last answer.
S7-1200 and S7-1500 refuse this question. With these, the connector notices only a block that is too
short, when it reads the block.
"""

from __future__ import annotations

import datetime as dt
import logging
import time
from collections.abc import Iterable, Mapping, Sequence
from typing import Final, NamedTuple

from shmio.connectors.s7.explain import RefusedError, block_name, names_of
from shmio.connectors.s7.query import Query
from shmio.connectors.s7.userdata import BLOCK_INFO, BlockInfo, block_data, parse_block

INTERVAL_NS: Final = 60_000_000_000
MAX_BLOCKS: Final = 200
"""Maximum number of blocks of a tag table that are watched for changes."""
_MOST_CHANGES: Final = 5  # largest number of reports about changes of checksum or time only

log = logging.getLogger("shmio.source")


class ExpectedBlock(NamedTuple):
    """A data block as a layout or a tag table describes it."""

    db_number: int
    name: str
    """The name of the layout; empty for a block of a tag table, which is known only by its number."""
    size: int
    """Number of bytes of the layout; for a tag table, number of bytes up to the end of the last register."""
    ends: Sequence[tuple[int, str]]
    """For each register, in the order of addresses, the offset after its last byte, and its name."""
    whole: bool
    """True if the layout describes the whole block, and not only some addresses."""

    def beyond(self, size: int) -> list[str]:
        """Return the names of the registers that do not fit in a block of ``size`` bytes."""
        return [name for end, name in self.ends if end > size]


class BlockChangeMonitor(Query):
    """Asks for information about each block in turn, and reports blocks that were changed."""

    optional = True

    def __init__(self, blocks: Iterable[ExpectedBlock]) -> None:
        """Create a monitor of these blocks; it watches only the first ``MAX_BLOCKS``."""
        super().__init__(BLOCK_INFO, INTERVAL_NS)
        self._blocks = list(blocks)[:MAX_BLOCKS]
        self._round: list[ExpectedBlock] = []  # blocks to ask for in this round, the next one last
        self._refused: set[int] = set()  # numbers of blocks for which this session got a refusal
        self._last: dict[int, tuple[BlockInfo, float]] = {}
        self._changes: dict[int, int] = {}
        self._doubts: dict[int, str] = {}
        self.supported = bool(self._blocks)

    @property
    def doubts(self) -> Mapping[int, str]:
        """A text about the change of each block that may no longer fit its layout, by block number."""
        return self._doubts

    def data(self) -> bytes:
        """Return the data of the request for the next block."""
        if not self._round:
            self._round = [block for block in reversed(self._blocks) if block.db_number not in self._refused]
        return block_data(self._round[-1].db_number)

    def answered(self, data: bytes) -> None:
        """Compare the information about a block with what was known before, and go on to the next block."""
        block = self._round[-1]
        self._compare(block, parse_block(data, block.db_number))
        self._continue()

    def refused(self, refusal: RefusedError) -> None:  # noqa: ARG002 - that it is refused says enough
        """Go on to the next block; once all blocks are refused, ask again only in the next session."""
        self._refused.add(self._round[-1].db_number)
        self._continue()

    def given_up(self, why: str) -> None:
        """Log that shmio will not notice changes, and why."""
        log.debug("shmio will not notice a change of a block, because the controller %s", why)

    def lost(self, *, alive: bool = True) -> None:
        """Forget the open question. The next session begins with the first block."""
        self._round.clear()
        self._refused.clear()
        super().lost(alive=alive)

    def _continue(self) -> None:
        self._round.pop()
        if self._round:
            self.ask_now()
        elif len(self._refused) == len(self._blocks):
            self.skip()

    def _compare(self, block: ExpectedBlock, info: BlockInfo) -> None:
        known = self._last.get(block.db_number)
        self._last[block.db_number] = info, time.time()
        if known is None:
            self._compare_first(block, info)
            return
        before, seen_s = known
        if info == before:
            return
        doubt = ""
        if info.size and info.size != before.size:
            text = f"it had {before.size} bytes and now has {info.size}"
            if _fits(block, info.size):
                text += ", as in its layout" if block.whole else ""
            else:
                text += _misfit(block, info.size)
                doubt = f"{block_name(block.db_number, block.name)} was changed in the controller: {text}"
        else:
            doubt = self._doubts.get(block.db_number, "")
            changes = self._changes[block.db_number] = self._changes.get(block.db_number, 0) + 1
            if changes > _MOST_CHANGES:
                return
            text = f"it has {info.size} bytes as before, but another checksum or time of compilation"
        if doubt:
            self._doubts[block.db_number] = doubt
        else:
            self._doubts.pop(block.db_number, None)
        since = dt.datetime.fromtimestamp(seen_s, dt.UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
        log.warning(
            "%s was changed in the controller since %s: %s; compare the layout with the block",
            block_name(block.db_number, block.name), since, text,
        )  # fmt: skip

    def _compare_first(self, block: ExpectedBlock, info: BlockInfo) -> None:
        """Log a wrong length when the first information about a block arrives.

        A block may be longer than a tag table needs, but not longer than a layout.
        """
        if info.size and not _fits(block, info.size):
            log.warning(
                "%s has %d bytes in the controller%s; compare the layout with the block",
                block_name(block.db_number, block.name), info.size, _misfit(block, info.size),
            )  # fmt: skip


def _fits(block: ExpectedBlock, size: int) -> bool:
    """Return whether a block of ``size`` bytes has the described length.

    A block that is described as a whole may be padded by one byte.
    """
    return block.size <= size <= block.size + 1 if block.whole else block.size <= size


def _misfit(block: ExpectedBlock, size: int) -> str:
    what = "but its layout has" if block.whole else "but its registers need"
    gone = block.beyond(size)
    return f", {what} {block.size}" + (f"; beyond its end: {names_of(gone)}" if gone else "")
