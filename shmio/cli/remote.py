"""An instance that is accessed through gRPC."""

from __future__ import annotations

import argparse
import queue
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from functools import cached_property
from typing import Any

import msgspec

from shmio.cli.cell import Campaign, CampaignEvent, Change, Selected, Shadow
from shmio.cli.readings import choose
from shmio.client import BlockLayout, Client, Happening, Outcome, Update, connect
from shmio.client import Campaign as ClientCampaign
from shmio.client import Shadow as ClientShadow
from shmio.config import Declaration
from shmio.config.address import UNIX, Address
from shmio.errors import ConfigError, NotRunningError, PathError, RemoteError, ShmioError, UnknownClientError
from shmio.layout.model import Layout, Register
from shmio.layout.types import element_type
from shmio.layout.values.codec import Value
from shmio.local.reading import Reading
from shmio.local.replays import ReplayRequest
from shmio.model.clock import Clock
from shmio.model.injection import Running
from shmio.model.replay_status import Playing
from shmio.segment import Quality
from shmio.segment.standing_injections import StandingInjection


@contextmanager
def connected(options: argparse.Namespace) -> Iterator[Remote]:
    """Connect to the instance that the options name.

    Raises:
        ConfigError: The options also name a local instance, or the address is invalid.
        OSError: A file cannot be read.
        ValueRangeError: The token would go to another host in plain text.
        UnknownClientError: The instance requires a token; the message has the option for it.

    """
    if options.config is not None or options.instance is not None:
        raise ConfigError("--host names the instance already: leave out -c and --instance")
    if not options.host.startswith(UNIX):
        Address.parse(options.host)
    token = options.token_file.read_text().strip() if options.token_file else None
    with connect(
        options.host,
        ca=options.ca,
        certificate=options.certificate,
        key=options.key,
        token=token,
        token_in_plain_text=options.token_in_plain_text,
    ) as client:
        try:
            yield Remote(client)
        except UnknownClientError as error:
            if options.token_file is not None:
                raise
            raise UnknownClientError(f"{error}; here by --token-file FILE, which has the token alone") from None


class Remote:
    """A client as a :class:`shmio.cli.cell.Cell`."""

    def __init__(self, client: Client) -> None:
        self._client = client

    @cached_property
    def _layouts(self) -> dict[str, Layout]:
        return {source: _layout(found) for source, found in self._client.layouts().items()}

    @property
    def sources(self) -> list[str]:
        """Names of the sources."""
        return list(self._layouts)

    def layout(self, source: str) -> Layout:
        """Return the layout of a source; PathError if there is no such source."""
        if source not in self._layouts:
            raise PathError(f"no source {source!r}; there are: {', '.join(self._layouts)}")
        return self._layouts[source]

    def readings(self, patterns: Sequence[str], chosen: Sequence[Selected]) -> list[Reading]:
        """Return the present readings of ``chosen``; those of one source come from one frame."""
        found = self._client.read(*patterns).updates
        readings = []
        for one in chosen:
            update = found.get(one.source)
            if update is None or one.register.path not in update.table.places:
                raise NotRunningError(f"{one.path}: a reload has taken it away")
            readings.append(_reading(update, update.table.places[one.register.path]))
        return readings

    def news(self, patterns: Sequence[str]) -> Iterator[Change]:
        """Yield the present readings of all that the patterns name, then each change.

        RemoteError: the instance has ended; NotRunningError: a reload has removed a source or a register.
        """
        chosen = choose(self, patterns)
        width = max(len(one.path) for one in chosen)
        shown: dict[str, tuple[object, ...]] = {}
        for update in self._client.subscribe(*patterns):
            if update.ended:
                raise NotRunningError(f"{update.reason}: a reload has taken it away")
            state = update.quality, update.reason.partition(":")[0]  # a stale reason holds the age
            table = update.table
            everything = update.whole or update.marked or shown.get(table.source) != state
            shown[table.source] = state
            for place in range(len(table.registers)) if everything else table.changed(update.changes):
                what = Selected(table.source, _register(table.registers[place]))
                now = _reading(update, place)
                seen = repr(now.value), now.quality, now.reason.partition(":")[0]
                if shown.get(what.path) != seen:
                    shown[what.path] = seen
                    yield Change(what, now, width)

    def write(self, values: Mapping[str, object], timeout_s: float | None) -> list[Outcome]:
        """Write registers of one source as one command."""
        return self._client.write(values, timeout_s)

    @contextmanager
    def _lay(self, shadow: ClientShadow) -> Iterator[Shadow]:
        with shadow:
            yield _RemoteShadow(shadow)

    def inject(self, *paths: str, priority: int, keep: bool, name: str) -> AbstractContextManager[Shadow]:
        """Start an injection for the duration of a ``with`` block, or permanently with ``keep``."""
        return self._lay(self._client.inject(*paths, priority=priority, keep=keep, name=name, originals=False))

    @contextmanager
    def declare(self, declarations: Sequence[Declaration], *, keep: bool) -> Iterator[Campaign]:
        """Start all declared injections or none, for a ``with`` block or permanently."""
        with self._client.declare(map(msgspec.to_builtins, declarations), keep=keep) as campaign:
            yield _RemoteCampaign(campaign)

    def injections(self) -> dict[str, tuple[StandingInjection, ...]]:
        """Return the present injections by source, innermost first."""
        found: dict[str, tuple[StandingInjection, ...]] = {}
        for one in self._client.injections():
            standing = StandingInjection(
                one.number, one.direction, one.priority, one.keep, one.name, one.writer, one.pid,
                one.ranges, None if one.running is None else _running(one.running),
            )  # fmt: skip
            found[one.source] = (*found.get(one.source, ()), standing)
        return found

    def lift(self, source: str, number: int) -> None:
        """Remove an injection."""
        self._client.lift(source, number)

    def lift_all(self) -> list[tuple[str, StandingInjection]]:
        """Remove all injections, and return them with their sources."""
        return [
            (one.source, StandingInjection(one.number, "", 0, False, one.name, 0, 0, ()))
            for one in self._client.lift_all()
        ]

    @property
    def clock(self) -> Clock:
        """The state of the instance's clock."""
        return self._client.clock()

    def real_sources(self) -> list[str]:
        """Return the names of the sources that steps do not affect; version 0.1 reports none."""
        return [one["name"] for one in self._client.status()["processes"] if one.get("real_time")]

    def step(self, dt_s: float | None, count: int) -> None:
        """Advance the clock by ``count`` steps of ``dt_s`` each."""
        with self._client.steps(count, dt_s) as steps:
            for _ in steps:
                pass

    def play(self, rate: float, dt_s: float | None) -> None:
        """Let the clock advance by itself at ``rate`` times real time."""
        self._client.play(rate, dt_s)

    def pause(self) -> None:
        """Stop the clock."""
        self._client.pause()

    def release(self) -> None:
        """Return the clock to real time."""
        self._client.release()

    def replay(self, wanted: ReplayRequest) -> list[Playing]:
        """Control the replayed sources if anything is requested, and return their states."""
        wish = msgspec.to_builtins(wanted)  # what is wanted alone
        return self._client.replay(**wish)


class _RemoteShadow:
    def __init__(self, shadow: ClientShadow) -> None:
        self.number = shadow.number
        self._shadow = shadow

    def set(self, values: Mapping[str, object]) -> list[Outcome]:
        return self._shadow.set(values)


class _RemoteCampaign:
    """A :class:`shmio.cli.cell.Campaign` over gRPC; a thread reads its events."""

    def __init__(self, campaign: ClientCampaign) -> None:
        self._names = {one.number: one.name for one in campaign.declared}
        self._left = set(self._names)
        self._told: queue.SimpleQueue[Happening | ShmioError] = queue.SimpleQueue()
        unheard = set(self._names)
        while unheard:  # that each was laid is told with the first answer
            happening = next(campaign)
            unheard.discard(happening.number)
            self._told.put(happening)
        threading.Thread(target=self._read, args=(campaign,), daemon=True).start()  # it ends with the stream

    def _read(self, campaign: ClientCampaign) -> None:
        try:
            for happening in campaign:
                self._told.put(happening)
        except ShmioError as error:
            self._told.put(error)

    @property
    def stands(self) -> bool:
        """Whether any injection remains."""
        return bool(self._left)

    def news(self) -> list[CampaignEvent]:
        """Return the events since the last call; RemoteError if the instance has ended."""
        found = []
        while not self._told.empty():
            one = self._told.get()
            if isinstance(one, ShmioError):
                raise one
            if one.what == "lifted":
                self._left.discard(one.number)
            text = one.text or self._names[one.number]
            found.append(CampaignEvent(one.clock_ns / 1e9, one.cycle, one.source, one.number, one.what, text))
        return found


def _running(found: Running[Mapping[str, Any]]) -> Running[Declaration]:
    declaration = msgspec.convert(found.declaration, Declaration)
    return Running(declaration, found.state, found.seed, found.runs, found.cycle, found.time_ns)


def _layout(found: BlockLayout) -> Layout:
    return Layout(
        found.name,
        found.number,
        found.size,
        found.optimized,
        tuple(map(_register, found.registers)),
        "big" if found.big_endian else "little",
    )


def _register(found: Any) -> Register:
    if element_type(found.type) is None:
        raise RemoteError(f"{found.path}: it has the type {found.type!r}, which this version does not know")
    return Register(
        found.path, found.type, found.dims, found.offset, found.bit, found.size, found.count, found.comment,
        found.initial,
    )  # fmt: skip


def _reading(update: Update, place: int) -> Reading:
    """Return the reading of one register of an update."""
    table = update.table
    value: Value = None
    if update.source_ns:
        found = table.value(place)
        value = found.tolist() if hasattr(found, "tolist") else found
    path = table.registers[place].path
    quality, reason = update.quality_of(path)
    return Reading(
        value,
        quality,
        reason,
        str(update.provenance_of(path)),
        update.source_ns / 1e9 if update.source_ns else None,
        round(update.age_ns / 1e9, 6) if update.age_ns or quality is not Quality.BAD else None,
    )
