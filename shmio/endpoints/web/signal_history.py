"""The history of registers in a recording, reduced for a plot, part by part.

A part has batches as in ``signals.py``, each with one register. The number of a batch is the
register's index in the request. A NaN between two samples means that frames are missing there.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

from shmio.endpoints.web.signals import HEAD, LEAST_GAP_NS, check_plottable, numbers
from shmio.errors import PathError
from shmio.layout.model import Register
from shmio.model.statuses import status_registers
from shmio.model.values import Provenance, Quality
from shmio.recording.columns import record_codec
from shmio.recording.decimation import Decimator, Samples
from shmio.recording.dump import Dump
from shmio.recording.reading.batch import Batch
from shmio.recording.reading.part import DumpBlock
from shmio.segment import EventKind
from shmio.segment.explain import Explainer, kind_of

PART_S: Final = 0.1
"""Time in s after which a part ends."""
PART_BYTES: Final = 16 << 20
"""Size of the frames, in bytes, after which a part ends."""
PART_FRAMES: Final = 20_000
"""Number of frames after which a part ends."""
MAX_PATHS: Final = 3
"""Maximum number of paths that are listed for an event."""
MAX_EXPLAINED: Final = 64
"""Maximum number of registers that are searched for those that an event is about."""
NEAR_NS: Final = 50_000_000
"""Precision, in ns, with which the log time of a frame is found."""
GAP_NS: Final = 1_000
"""Time in ns between the last frame before a gap and the mark of the gap."""


class Signal(NamedTuple):
    """A register of a recording: its path with the source, and the register in each block that has it."""

    path: str
    source: str
    registers: dict[DumpBlock, Register]

    @property
    def newest(self) -> Register:
        """The register, in the last block that has it."""
        return next(reversed(self.registers.values()))


class Window(NamedTuple):
    """A range of time, in ns of UTC, and the number of columns into which a plot divides it."""

    from_ns: int
    to_ns: int
    columns: int


class MarkedEvent(msgspec.Struct, omit_defaults=True):
    """The first event in a column of a plot, and the number of events in the column."""

    time_s: float
    source: str
    kind: str
    by: str
    text: str
    paths: list[str]
    more: int = 0
    """Number of the event's paths that are not listed."""
    count: int = 1


class Part(msgspec.Struct):
    """A part of the history: batches, events, and the share of the work that is done by now."""

    batches: list[bytes]
    events: list[MarkedEvent]
    share: float
    reduced: bool = False
    """True if frames have been left out so far, because the plot does not need them."""
    damage: list[str] = []
    """Messages about places that could not be read. Only the last part has them."""


def signals_of(dump: Dump, paths: Sequence[str]) -> list[Signal]:
    """Return the registers with these paths.

    Raises:
        PathError: There is no such register, or it cannot be plotted.
    """
    found = []
    for path in paths:
        chosen = dump.select([path])
        if any(len(registers) != 1 for registers in chosen.values()):
            raise PathError(f"{path}: this names several registers; choose one of them")
        registers = {block: some[0] for block, some in chosen.items()}
        for register in registers.values():
            check_plottable(register)
        found.append(Signal(path, next(iter(registers)).source, registers))
    return found


def signal_history(dump: Dump, signals: Sequence[Signal], window: Window, damage: Sequence[str] = ()) -> Iterator[Part]:
    """Yield the history of registers in a window of log times, and then the events of their sources.

    Args:
        dump: The recording.
        signals: The registers; if empty, only the events of all sources are yielded.
        window: The window.
        damage: Messages about places of the recording that could not be read. More may be added
            during the work.

    """
    sources = list(dict.fromkeys(signal.source for signal in signals))
    turns = len(sources) + 1
    for turn, source in enumerate(sources):
        of_source = {index: signal.registers for index, signal in enumerate(signals) if signal.source == source}
        for part in _History(dump, of_source, window).parts(source):
            part.share = (turn + part.share) / turns
            yield part
    for part in events(dump, sources or dump.sources, window):
        part.share = (turns - 1 + part.share) / turns
        yield part
    yield Part([], [], 1.0, damage=list(damage))


def past(dump: Dump, signals: Sequence[Signal], window: Window, utc_ns: int) -> Iterator[Part]:
    """Yield the history of registers of one source, on the time scale of live plots.

    Args:
        dump: A recording of this run.
        signals: The registers, all of one source.
        window: The window, on the time scale of live plots.
        utc_ns: Difference between UTC and CLOCK_MONOTONIC, in ns, as for a feed in ``signals.py``.

    """
    source = signals[0].source

    def times(batch: Batch) -> npt.NDArray[np.int64]:
        return batch.head["publish_ns"] + utc_ns

    begin_ns, _ = _log_times(dump, source, window.from_ns - utc_ns)
    _, end_ns = _log_times(dump, source, window.to_ns - utc_ns)
    work = _History(dump, {index: signal.registers for index, signal in enumerate(signals)}, window, times)
    yield from work.parts(source, begin_ns, end_ns)


def first_time(dump: Dump, source: str) -> int | None:
    """Return when the first recorded frame of a source was published; None if there is no frame.

    The time is in ns of CLOCK_MONOTONIC.
    """
    for _, batch in dump.batches(source):
        return int(batch.head["publish_ns"][0])
    return None


def _log_times(dump: Dump, source: str, publish_ns: int) -> tuple[int, int]:
    """Return log times before and after a time of CLOCK_MONOTONIC, at most ``NEAR_NS`` apart.

    Log time follows the instance's clock, which may have been stepped. From frame to frame, neither
    log time nor CLOCK_MONOTONIC goes back.
    """
    low, high = dump.begin_ns - 1, dump.end_ns
    while high - low > NEAR_NS:
        middle = (low + high) // 2
        latest = dump.latest(source, middle)
        if latest is None or latest.item.publish_ns <= publish_ns:
            low = middle
        else:
            high = latest.time_ns
    return low, high


class _History:
    """Reads the frames of one source, and reduces them for a plot."""

    def __init__(
        self,
        dump: Dump,
        wanted: dict[int, dict[DumpBlock, Register]],
        window: Window,
        times: Callable[[Batch], npt.NDArray[np.int64]] = lambda batch: batch.time_ns,
    ) -> None:
        self._dump, self._wanted, self._window, self._times = dump, wanted, window, times
        self._decimators = {index: Decimator(*window) for index in wanted}
        self._sent_s = dict.fromkeys(wanted, math.nan)
        self._waiting: list[tuple[Batch, Batch | None]] = []
        self._block: DumpBlock | None = None
        self._number = self._time_ns = 0
        """Number and time of the last frame; 0 at the start. In a new block, the number starts at 0 again."""

    def parts(self, source: str, from_ns: int | None = None, to_ns: int | None = None) -> Iterator[Part]:
        """Yield the parts. They include the last frame before the window and the first frame after it."""
        begin_ns = self._window.from_ns if from_ns is None else from_ns
        end_ns = self._window.to_ns if to_ns is None else to_ns
        before = self._dump.latest(source, begin_ns)
        first_ns = begin_ns if before is None else before.time_ns
        started_s, size, count = time.monotonic(), 0, 0
        for block, batch in self._including_next(source, first_ns, end_ns):
            if block is not self._block:
                yield from self._flushed(0.0)
                self._block, self._number = block, 0
            self._waiting.append((batch, self._raw(source, batch)))
            size, count = size + batch.records.nbytes, count + len(batch)
            if size >= PART_BYTES or count >= PART_FRAMES or time.monotonic() - started_s >= PART_S:
                done = (int(batch.time_ns[-1]) - first_ns) / max(1, end_ns - first_ns)
                yield from self._flushed(min(1.0, done))
                started_s, size, count = time.monotonic(), 0, 0
        yield from self._flushed(1.0)
        reduced = any(one.reduced for one in self._decimators.values())
        yield Part([self._batch(index, one.end()) for index, one in self._decimators.items()], [], 1.0, reduced)

    def _including_next(self, source: str, from_ns: int, to_ns: int) -> Iterator[tuple[DumpBlock, Batch]]:
        yield from self._dump.batches(source, from_ns, to_ns)
        for block, batch in self._dump.batches(source, to_ns + 1):
            yield block, batch[:1]
            return

    def _raw(self, source: str, batch: Batch) -> Batch | None:
        """Return a batch's frames as the source delivered them; None if readers saw these same values."""
        if not (batch.head["flags"] & 1).any():
            return None
        for _, raw in self._dump.batches(source, int(batch.time_ns[0]), int(batch.time_ns[-1]), raw=True):
            if np.array_equal(raw.head["number"], batch.head["number"]):
                return raw
        return None

    def _flushed(self, share: float) -> Iterator[Part]:
        waiting, self._waiting = self._waiting, []
        block = self._block
        if not waiting or block is None:
            return
        some = [batch for batch, _ in waiting]
        records = np.concatenate([batch.records for batch in some])
        raw = None
        if any(other is not None for _, other in waiting):
            raw = np.concatenate([(batch if other is None else other).records for batch, other in waiting])
        times = np.maximum.accumulate(np.concatenate([[self._time_ns], *map(self._times, some)]))[1:]
        head = np.concatenate([batch.head for batch in some])
        before = self._number or self._number_before(block, int(some[0].time_ns[0]), int(head["number"][0]))
        numbers_before = np.concatenate(([before], head["number"][:-1]))
        times_before = np.concatenate(([self._time_ns or times[0]], times[:-1]))
        longest_ns = max(block.stale_ns, 3 * block.period_ns, LEAST_GAP_NS)
        gaps = np.flatnonzero((head["number"] != numbers_before + 1) | (times - times_before > longest_ns))
        if not self._number and self._time_ns:
            gaps = np.union1d(gaps, [0])  # the first frame of another block
        self._number, self._time_ns = int(head["number"][-1]), int(times[-1])
        gap_times = np.minimum(times_before[gaps] + GAP_NS, times[gaps])
        batches = []
        for index, registers in self._wanted.items():
            found = self._samples(block, registers.get(block), records, raw, head, times)
            found = Samples(
                np.insert(found.time_ns, gaps, gap_times),
                np.insert(found.values, gaps, math.nan),
                np.insert(found.injected, gaps, False),
            )
            batches.append(self._batch(index, self._decimators[index].add(found)))
        yield Part([batch for batch in batches if batch], [], share)

    @staticmethod
    def _number_before(block: DumpBlock, time_ns: int, number: int) -> int:
        """Return the number of the frame before the first one that is read."""
        return block.after.get("frames", number - 1) if time_ns == block.first_ns else number - 1

    def _samples(
        self,
        block: DumpBlock,
        register: Register | None,
        records: npt.NDArray[np.uint8],
        raw: npt.NDArray[np.uint8] | None,
        head: npt.NDArray[Any],
        times: npt.NDArray[np.int64],
    ) -> Samples:
        """Return all samples of a register in some frames of a block."""
        injected = head["provenance"] == Provenance.INJECTED
        if register is None:  # a reload has removed or added it
            return Samples(times, np.full(len(times), math.nan), injected)
        layout = block.layout
        status = status_registers(layout, [register], times=False)
        codec = record_codec((register, *status), layout.size, layout.byte_order)
        decoded = codec.decode(records)
        shown = decoded[register.path]
        values = numbers(shown)
        bad = (head["quality"] == int(Quality.BAD)) | (head["source_ns"] == 0)
        for one in status:
            bad |= decoded[one.path] >> 30 >= 2  # the severity is bad
        values[bad] = math.nan
        if raw is not None:
            original = codec.decode(raw)[register.path]
            injected = injected | ((shown != original) & ((shown == shown) | (original == original)))  # noqa: PLR0124  not both NaN
        return Samples(times, values, injected)

    def _batch(self, index: int, samples: Samples) -> bytes:
        if not len(samples.time_ns):
            return b""
        times = samples.time_ns / 1e9
        head = HEAD.pack(index, len(times), self._sent_s[index])
        self._sent_s[index] = float(times[-1])
        marks = np.where(samples.injected, int(Provenance.INJECTED), int(Provenance.LIVE)).astype(np.uint8)
        return head + times.astype("<f8").tobytes() + samples.values.astype("<f8").tobytes() + marks.tobytes()


def events(dump: Dump, sources: Collection[str], window: Window) -> Iterator[Part]:
    """Yield the progress, and finally the first event in each column.

    Args:
        dump: The recording.
        sources: The sources whose events count.
        window: The window, and its number of columns.
    """
    width_ns = max(1, (window.to_ns - window.from_ns) // max(1, window.columns))
    explainers: dict[DumpBlock, Explainer] = {}
    found: dict[int, MarkedEvent] = {}
    started_s = time.monotonic()
    for time_ns, block, event in dump.events(sources, window.from_ns, window.to_ns):
        if block is not None:
            if block not in explainers:
                explainers[block] = Explainer(block.source, block.layout, MAX_EXPLAINED)
            explained = explainers[block].explain(event)
            column = (time_ns - window.from_ns) // width_ns
            if explained.partial:
                continue
            if column in found:
                found[column].count += 1
            else:
                paths = [place.path for place in explained.places]
                text = f"{event.quality} {event.text}".strip() if event.kind == EventKind.QUALITY else event.text
                found[column] = MarkedEvent(
                    time_ns / 1e9, block.source, kind_of(event), explained.by, text, paths[:MAX_PATHS],
                    max(0, len(paths) - MAX_PATHS),
                )  # fmt: skip
        if time.monotonic() - started_s >= PART_S:
            yield Part([], [], (time_ns - window.from_ns) / max(1, window.to_ns - window.from_ns))
            started_s = time.monotonic()
    yield Part([], list(found.values()), 1.0)
