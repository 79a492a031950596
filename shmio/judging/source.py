"""Turns the frames of a source into pieces of the signals that formulas read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from shmio.injection.exact import Numbers, integers, split
from shmio.judging.operators import Input
from shmio.judging.pieces import FAR_NS, NO_TIMES, NOTHING, Piece, Times, Values
from shmio.layout.model import Layout, Register
from shmio.layout.values.codec import scalar_codec
from shmio.layout.values.frame_codec import FrameCodec
from shmio.model.statuses import status_registers

MAX_TROUBLES: Final = 1000
"""Maximum number of spans of unknown values that are stored for each source, with their reasons."""
_BAD: Final = 2 << 30  # the least status code that is bad
_UNCERTAIN: Final = 1 << 30


class Frames(NamedTuple):
    """Consecutive frames of one block.

    Attributes:
        number: Numbers of the frames, uint64, shape (n,). A gap means that frames were missed.
        clock_ns: The instance's clock when each frame was published, int64, shape (n,).
        quality: 0 bad, 1 uncertain, 2 good; uint8, shape (n,).
        delay_us: Maximum age of each image when it was published, uint32, shape (n,).
        images: The images that consumers saw, uint8, shape (n, size).
        raws: The images that the source delivered, of the same shape; None if they are unknown, or
            the same as ``images``.
    """

    number: npt.NDArray[np.uint64]
    clock_ns: npt.NDArray[np.int64]
    quality: npt.NDArray[np.uint8]
    delay_us: npt.NDArray[np.uint32]
    images: npt.NDArray[np.uint8]
    raws: npt.NDArray[np.uint8] | None = None


@dataclass(frozen=True, slots=True)
class Signal:
    """An input of a formula: a register, and the aspect of it that the formula reads.

    Attributes:
        source: Name of the source.
        path: Path of the register within the source.
        aspect: ``value``: the value as consumers see it; ``raw``: as the source delivered it;
            ``quality``: 0 bad, 1 uncertain, 2 good; ``age``: the value's age in s, directly before
            the next frame came.
    """

    source: str
    path: str
    aspect: str = "value"

    @property
    def name(self) -> str:
        """The signal, as formulas write it."""
        path = f"{self.source}/{self.path}"
        return path if self.aspect == "value" else f"{self.aspect}({path})"


class Trouble(NamedTuple):
    """A span of time in which values of a source are unknown, and the reason. Times are in ns."""

    begin_ns: int
    end_ns: int
    reason: str


class Rows(NamedTuple):
    """Values of all signals of a source.

    Attributes:
        time: The moments from which the values hold, in ns, int64, shape (n,).
        values: The values, NaN where unknown, float64, shape (signals, n).
        end: The moment, in ns, at which the last values end, exclusive.
        rests: What the values of a 64-bit integer lack to be exact, by the index of the signal.
    """

    time: Times
    values: Values
    end: int
    rests: Mapping[int, Values] = MappingProxyType({})

    def exact(self, index: int) -> Numbers:
        """Return the values of a signal, with all digits of integers."""
        values = self.values[index]
        return integers(values, self.rests[index]) if index in self.rests else values


class _Decoder:
    """Decodes those registers of a block that formulas read."""

    def __init__(
        self, layout: Layout, registers: Mapping[str, Register], signals: Sequence[Signal], wide: Sequence[int]
    ) -> None:
        self.layout = layout
        self._wide = wide
        self._signals = signals
        self._registers = registers
        self._statuses: dict[str, str] = {}
        unique: dict[str, Register] = {}
        for path, register in registers.items():
            unique[register.path] = register
            for status in status_registers(layout, [register], times=False):
                unique[status.path] = status
                self._statuses[path] = status.path
        self._codec = FrameCodec(Layout("", None, layout.size, False, tuple(unique.values()), layout.byte_order))

    def decode(self, frames: Frames) -> Values:
        """Return the values of the signals, of shape (signals, n). Ages are those at publication.

        Further rows have what the values of wide signals lack to be exact.
        """
        decoded = {"value": self._codec.decode(frames.images)}
        decoded["raw"] = decoded["value"]
        if frames.raws is not None and any(signal.aspect == "raw" for signal in self._signals):
            decoded["raw"] = self._codec.decode(frames.raws)
        found = np.zeros((len(self._signals) + len(self._wide), len(frames.number)))
        rests = dict(zip(self._wide, found[len(self._signals) :], strict=True))
        bad = frames.quality == 0
        for index, (row, signal) in enumerate(zip(found, self._signals, strict=False)):
            if signal.aspect == "age":
                row[:] = frames.delay_us / 1e6
                continue
            register = self._registers.get(signal.path)
            if register is None:
                row[:] = 0 if signal.aspect == "quality" else np.nan
                continue
            columns = decoded["raw" if signal.aspect == "raw" else "value"]
            status = self._statuses.get(signal.path)
            code = None if status is None else columns[status]
            if signal.aspect == "quality":
                row[:] = np.minimum(frames.quality, 2)
                if code is not None:
                    np.minimum(row, np.where(code < _UNCERTAIN, 2, np.where(code < _BAD, 1, 0)), out=row)
                continue
            column = columns[register.path]
            if _is_wide(register):
                row[:], rest = split(column.astype(np.int64) if column.dtype.kind == "m" else column)
                if index in rests:
                    rests[index][:] = rest
                else:  # a reload has changed the type
                    row[rest != 0] = np.nan
            elif column.dtype.kind == "m":
                row[:] = np.where(np.isnat(column), np.nan, column.astype(np.int64))
            else:
                row[:] = column
            row[bad if code is None else bad | (code >= _BAD)] = np.nan
        return found


def _is_wide(register: Register) -> bool:
    """Return whether a register is a 64-bit integer, which a float may not represent."""
    return register.type != "BOOL" and scalar_codec(register.element).plain in ("q", "Q")


class _Waiting(NamedTuple):
    """Decoded frames, in order; :func:`_ordered` makes their times strictly ascending."""

    time: Times
    values: Values
    bad: npt.NDArray[np.bool_]
    missed: npt.NDArray[np.bool_]
    """Whether frames were missed before each frame."""
    fresh_ns: npt.NDArray[np.int64]
    """How long each frame is not stale, in ns."""

    @property
    def last(self) -> _Waiting:
        """The last frame."""
        return _Waiting(self.time[-1:], self.values[:, -1:], self.bad[-1:], self.missed[-1:], self.fresh_ns[-1:])


class Source:
    """The signals of one source.

    A value holds from its frame until the next frame. It is unknown while the quality is bad, once
    it is stale, and in gaps where frames were missed.
    """

    def __init__(self, name: str, signals: Sequence[Signal]) -> None:
        self.name = name
        self.signals = tuple(signals)
        self.inputs = tuple(Input() for _ in signals)
        """The node of each signal."""
        self.troubles: list[Trouble] = []
        """The first spans of time in which values are unknown, with the reasons."""
        self._noted: dict[str, int] = {}  # the index of the last trouble for each reason
        self.origin_ns: int | None = None
        """Instance time of the first frame, in ns; None before that frame."""
        self.newest_ns = 0
        """Instance time of the newest frame, in ns."""
        self.frames = 0
        """Number of frames that were added."""
        self.rows = _no_rows(len(signals))
        """The values that the last turn made known."""
        self._decoder: _Decoder | None = None
        self.wide = False
        """True if a signal has been a 64-bit integer, which a float may not represent."""
        self._wide: tuple[int, ...] = ()  # signals that have a further row, with what a float lacks
        self._stale_ns = FAR_NS
        self._number: int | None = None
        self._left_out = False
        self._waiting: list[_Waiting] = []
        self._held: _Waiting | None = None  # the last frame, until it is known how long it holds
        self._begun = False
        self._ages = np.array([signal.aspect == "age" for signal in signals])
        self._qualities = np.array([signal.aspect == "quality" for signal in signals])

    @property
    def needs_raw(self) -> bool:
        """True if a formula reads values of this source as delivered, without injections."""
        return any(signal.aspect == "raw" for signal in self.signals)

    def follow(self, layout: Layout, registers: Mapping[str, Register], stale_ns: int) -> None:
        """Set the block that the next frames come from.

        Args:
            layout: The layout of the block.
            registers: The registers of the signals, by path. If one is missing, its values are
                unknown.
            stale_ns: Age in ns from which a frame is stale.
        """
        self.wide = self.wide or any(map(_is_wide, registers.values()))
        if self._decoder is None:
            self._wide = tuple(
                index
                for index, signal in enumerate(self.signals)
                if signal.aspect in ("value", "raw") and signal.path in registers and _is_wide(registers[signal.path])
            )
            more = np.zeros(len(self._wide), bool)
            self._ages, self._qualities = np.append(self._ages, more), np.append(self._qualities, more)
        self._decoder = _Decoder(layout, registers, self.signals, self._wide)
        self._stale_ns = stale_ns
        self._number = None

    def add(self, frames: Frames) -> None:
        """Add the next frames. If several frames have the same time, the last one counts."""
        if not len(frames.number) or self._decoder is None:
            return
        time, number = frames.clock_ns, frames.number
        if self.origin_ns is None:
            self.origin_ns = int(time[0])
        self.newest_ns = max(self.newest_ns, int(time.max()))
        self.frames += len(number)
        missed = np.empty(len(number), bool)
        missed[0] = self._number is not None and int(number[0]) != self._number + 1
        missed[1:] = number[1:] != number[:-1] + np.uint64(1)
        self._number = int(number[-1])
        fresh_ns = np.maximum(self._stale_ns - 1000 * frames.delay_us.astype(np.int64), 0) + 1
        self._waiting.append(_Waiting(time, self._decoder.decode(frames), frames.quality == 0, missed, fresh_ns))

    def turn(self, origin_ns: int, end_ns: int | None = None) -> None:
        """Set ``rows`` and the output of each input to the values that the added frames make known.

        Args:
            origin_ns: Start of the judged time.
            end_ns: End of the judged time if no more frames follow; else None.
        """
        rows = self._known(end_ns)
        if len(rows.time) and not self._begun:
            rows = _from(rows, origin_ns)
            self._begun = len(rows.time) > 0
        count = len(rows.time) if end_ns is None else len(rows.time) - 1
        shown = rows.values[: len(self.signals), :count]
        rests = {index: rows.values[at, :count] for at, index in enumerate(self._wide, len(self.inputs))}
        self.rows = Rows(rows.time[:count], shown, rows.end if end_ns is None else end_ns, rests)
        for index, node in enumerate(self.inputs):
            values = rows.values[index]
            if index in self._wide:
                values = integers(values, rows.values[len(self.inputs) + self._wide.index(index)])
            node.out = Piece(rows.time, values, values, rows.end) if len(rows.time) else NOTHING

    def _known(self, end_ns: int | None) -> Rows:
        """Return the values up to the last frame; with ``end_ns``, up to the end, and unknown after it."""
        if self._waiting:
            self._waiting[0].missed[0] |= self._left_out
            whole = _joined(self._waiting if self._held is None else [self._held, *self._waiting])
            self._held, self._left_out = _ordered(whole)
            self._waiting = []
        held = self._held
        if held is None or (end_ns is None and len(held.time) < 2):
            return _no_rows(len(self._ages))
        if end_ns is None:
            time, following, values = held.time[:-1], held.time[1:], held.values[:, :-1]
            self._held = held.last
        else:
            time, following, values = held.time, np.append(held.time[1:], end_ns), held.values
            self._held = None
        count, end = len(time), int(following[-1])
        bad, fresh_ns = held.bad[:count], held.fresh_ns[:count]
        lasted = following - time
        if self._ages.any():
            values = values.copy()
            values[self._ages] += lasted / 1e9
        if bad.any():
            self._note(time[bad], following[bad], f"the quality of {self.name} is bad")
        missed = np.append(held.missed[1:], False)[:count]
        stale = ~missed & (lasted > fresh_ns)
        if missed.any() or stale.any():
            time, values = self._with_unknown(
                time, values, following, missed, np.where(missed, 1, fresh_ns), missed | stale
            )
        if end_ns is not None:
            time, values, end = np.append(time, end_ns), np.column_stack((values, self._unknown(1))), FAR_NS
        return Rows(time, values, end)

    def _with_unknown(
        self,
        time: Times,
        values: Values,
        following: Times,
        missed: npt.NDArray[np.bool_],
        after_ns: npt.NDArray[np.int64],
        chosen: npt.NDArray[np.bool_],
    ) -> tuple[Times, Values]:
        """Return the values, which become unknown ``after_ns`` after each chosen frame, until the next frame."""
        begin = time[chosen] + after_ns[chosen]
        for why, some in ((f"frames of {self.name} were missed", missed), (f"{self.name} is stale", chosen & ~missed)):
            self._note((time + after_ns)[some], following[some], why)
        unknown = self._unknown(len(begin))
        unknown[self._ages] = values[:, chosen][self._ages]
        order = np.argsort(np.append(time, begin), kind="stable")
        return np.append(time, begin)[order], np.column_stack((values, unknown))[:, order]

    def _unknown(self, count: int) -> Values:
        """Return unknown values: NaN, and bad quality."""
        found = np.full((len(self._ages), count), np.nan)
        found[self._qualities] = 0
        return found

    def _note(self, begin: Times, end: Times, reason: str) -> None:
        for first, last in zip(begin[:MAX_TROUBLES].tolist(), end[:MAX_TROUBLES].tolist(), strict=True):
            before = self._noted.get(reason)
            if before is not None and self.troubles[before].end_ns >= first:
                self.troubles[before] = self.troubles[before]._replace(end_ns=last)
            elif len(self.troubles) < MAX_TROUBLES:
                self._noted[reason] = len(self.troubles)
                self.troubles.append(Trouble(first, last, reason))


def _no_rows(signals: int) -> Rows:
    return Rows(NO_TIMES, np.empty((signals, 0)), 0)


def _from(rows: Rows, origin_ns: int) -> Rows:
    """Return the values from a moment on."""
    if rows.end <= origin_ns:
        return Rows(NO_TIMES, rows.values[:, :0], 0)
    first = max(0, int(rows.time.searchsorted(origin_ns, "right")) - 1)
    time = rows.time[first:].copy()
    time[0] = max(int(time[0]), origin_ns)
    return Rows(time, rows.values[:, first:], rows.end)


def _joined(waiting: list[_Waiting]) -> _Waiting:
    if len(waiting) == 1:
        return waiting[0]
    return _Waiting(*(np.concatenate(columns, axis=-1) for columns in zip(*waiting, strict=True)))


def _ordered(waiting: _Waiting) -> tuple[_Waiting, bool]:
    """Return the frames with strictly ascending times, and whether frames after the last of them were left out.

    Of frames with the same time, the last one counts. If the clock goes back, frames are left out
    until it has caught up, and count as missed.
    """
    time = waiting.time
    if (time[1:] > time[:-1]).all():
        return waiting, False
    back = time < np.maximum.accumulate(time)
    forward = np.flatnonzero(~back)
    new = time[forward[1:]] > time[forward[:-1]]
    first, kept = forward[np.append(True, new)], forward[np.append(new, True)]  # of each time, the first and the last
    lost = np.cumsum(waiting.missed | back)
    missed = lost[first] > np.append(0, lost[kept[:-1]])
    found = _Waiting(time[kept], waiting.values[:, kept], waiting.bad[kept], missed, waiting.fresh_ns[kept])
    return found, bool(back[kept[-1] :].any())
