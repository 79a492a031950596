"""Values of registers from the live messages of any cells."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from shmio.config.fabric import matches_cell
from shmio.errors import ConfigError, PathError, RemoteError
from shmio.fabric.messages import Header, decode_entries, decode_header
from shmio.fabric.names import ROOT, CellName, source_of
from shmio.fabric.registry import CellEntry, Registry, Seen
from shmio.layout.glob import choose
from shmio.layout.model import Layout, Register
from shmio.layout.values.codec import codec
from shmio.local.reading import holds_none
from shmio.model.statuses import status_area, worse
from shmio.model.values import Provenance, Quality, Reading
from shmio.segment import Frame
from shmio.wording import listed

log = logging.getLogger("shmio.fabric")


class Watched(NamedTuple):
    """Registers of cells: a pattern for the names of cells, and a path or pattern within each of them."""

    cells: str
    path: str

    @classmethod
    def parse(cls, text: str) -> Watched:
        """Parse ``CELL/PATH``, such as ``plant1.*.*/cell/Outputs/13``.

        Raises:
            ConfigError: The text has another form.

        """
        cells, _, path = text.partition("/")
        if cells.count(".") != 2 or not all(cells.split(".")) or not path:
            raise ConfigError(
                f"{text!r} is not a cell and a path; write plant.line.cell/source/register, such as "
                "'plant1.*.*/cell/Outputs/13', where * stands for any characters"
            )
        return cls(cells, path)

    @property
    def subject(self) -> str:
        """The subject of the live messages that may have these registers."""
        parts = ("*" if set("*?[") & set(part) else part for part in self.cells.split("."))
        return f"{ROOT}.{'.'.join(parts)}.*.live"

    def matches(self, cell: str) -> bool:
        """Return whether the pattern matches the name of a cell."""
        return matches_cell(self.cells, cell)


def live_source(subject: str) -> tuple[str, str]:
    """Return the names of the cell and of the source that publish on a subject."""
    _, plant, line, cell, token, _ = subject.split(".")
    return str(CellName(plant, line, cell)), source_of(token)


class _Source:
    """The watched registers of a source with one layout, and when its last message came."""

    def __init__(self, name: str, layout: Layout, registers: Sequence[Register], stale_ns: int) -> None:
        self.name = name
        self.stale_s = stale_ns / 1e9
        self.layout = layout
        self.registers = [(register, codec(register, layout.byte_order)) for register in registers]
        self.came_s = time.monotonic()
        self.last: Sequence[Reading] = ()


class LiveReadings:
    """Turns live messages into the readings that have changed."""

    def __init__(self, registry: Registry, watched: Sequence[Watched]) -> None:
        self._registry = registry
        self._watched = watched
        self._sources: dict[tuple[str, str], dict[bytes, _Source | None]] = {}

    async def prepare(self) -> None:
        """Look up the registers in all present cells.

        Raises:
            ConfigError: No cell matches a pattern.
            PathError: No cell that matches a pattern has such a register.
            RemoteError: The registry is damaged.

        """
        cells = await self._registry.cells()
        for one in self._watched:
            chosen = [seen for seen in cells if one.matches(seen.entry.cell)]
            if not chosen:
                names = [seen.entry.cell for seen in cells]
                raise ConfigError(f"{one.cells}: the fabric has no such cell; {listed(names)}")
            problem: PathError | None = None
            for seen in chosen:
                try:
                    choose([one.path], await self._layouts(seen.entry))
                    break
                except PathError as error:
                    problem = problem or PathError(f"{seen.entry.cell}: {error}")
            else:
                raise problem or PathError(f"{one.path}: no cell has such a register")

    async def _layouts(self, entry: CellEntry) -> dict[str, Layout]:
        return {source.name: await self._registry.layout(source.layout) for source in entry.sources}

    async def take(self, subject: str, data: bytes) -> list[Reading]:
        """Return the readings of a message that differ from those before.

        Raises:
            ValueError: The message is malformed.

        """
        cell, name = live_source(subject)
        if not any(one.matches(cell) for one in self._watched):
            return []
        header = decode_header(data)
        known = self._sources.setdefault((cell, name), {})
        if header.layout not in known:
            found = await self._find(cell, name, header)
            known.clear()  # the source has another layout now
            known[header.layout] = found
        source = known[header.layout]
        if source is None:
            return []
        source.came_s = time.monotonic()
        changed: list[Reading] = []
        for entry in decode_entries(data):
            if isinstance(entry, Frame) and len(entry.raw) == source.layout.size:
                changed += _update(source, _readings(source, entry, header.age_ns))
        return changed

    async def _find(self, cell: str, name: str, header: Header) -> _Source | None:
        """Return the watched registers of a source; None if there are none."""
        seen: Seen | None = await self._registry.find(cell)
        entry = None if seen is None else seen.entry.source(name)
        if seen is None or entry is None:
            return None
        try:
            layouts = await self._layouts(seen.entry)
            layouts[name] = layout = await self._registry.layout_like(header.layout)
        except RemoteError as error:
            log.warning("%s: %s", cell, error)
            return None
        registers: dict[str, Register] = {}
        for one in self._watched:
            if one.matches(cell):
                registers |= _chosen(one.path, name, layouts)
        return _Source(f"{cell}/{name}", layout, list(registers.values()), entry.stale_ns) if registers else None

    def silent(self) -> list[Reading]:
        """Return bad readings of the sources that have sent nothing for longer than their stale age."""
        changed: list[Reading] = []
        for one in (source for known in self._sources.values() for source in known.values() if source):
            silence_s = time.monotonic() - one.came_s
            if silence_s > one.stale_s:
                reason = f"stale: no message for {silence_s:.1f} s"
                worst = [_with(last, Quality.BAD, reason) for last in one.last if last.quality is not Quality.BAD]
                changed += worst
                one.last = [_with(last, Quality.BAD, last.reason or reason) for last in one.last]
        return changed


def _chosen(path: str, source: str, layouts: Mapping[str, Layout]) -> dict[str, Register]:
    try:
        return {one.path: one for name, one in choose([path], layouts) if name == source}
    except PathError:
        return {}


def _readings(source: _Source, frame: Frame, late_ns: int) -> list[Reading]:
    age_ns = late_ns + 1000 * frame.delay_us
    quality, reason = frame.quality, frame.reason
    if quality is not Quality.BAD and age_ns > source.stale_s * 1e9:
        quality, reason = Quality.BAD, f"stale: the message is {age_ns / 1e9:.1f} s old"
    area = status_area(source.layout)
    found = []
    for register, decoder in source.registers:
        value = decoder.decode(frame.image) if frame.source_ns else None
        own, why, source_ns = quality, reason, frame.source_ns
        if source_ns and area is not None and (status := area.get(frame.raw, area.index(register))) is not None:
            own, why = worse(own, why, status)
            source_ns = status.source_ns or source_ns
        if own is not Quality.BAD and holds_none(value):
            own, why = Quality.BAD, f"the bytes are not a valid {register.type}"
        injected = frame.effective is not None and repr(decoder.decode(frame.raw)) != repr(value)
        provenance = str(Provenance.INJECTED if injected else frame.provenance)
        time_s = source_ns / 1e9 if source_ns else None
        found.append(Reading(source.name, register, value, own, why, provenance, time_s, age_ns / 1e9))
    return found


def _update(source: _Source, now: list[Reading]) -> list[Reading]:
    before, source.last = source.last, now
    if not before:
        return now
    return [new for old, new in zip(before, now, strict=True) if _state(old) != _state(new)]


def _state(reading: Reading) -> tuple[object, ...]:
    # The reason of a stale value contains its age: that part is ignored. repr makes NaNs equal.
    return repr(reading.value), reading.quality, reading.reason.partition(":")[0], reading.provenance


def _with(reading: Reading, quality: Quality, reason: str) -> Reading:
    return Reading(
        reading.source, reading.register, reading.value, quality, reason, reading.provenance, reading.source_time,
        reading.age_s,
    )  # fmt: skip
