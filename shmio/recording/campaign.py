"""Derives declared injections from a recording: they repeat the recorded injections."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import msgspec

from shmio.config import Declaration
from shmio.model.values import NO_WRITER
from shmio.recording.dump import Dump
from shmio.segment.events import Event, EventKind
from shmio.segment.explain import Explained, Explainer, Place

NS = 1e9


@dataclass(slots=True)
class _HeldValue:
    """A value that a client gave to an injection, and the time at which the client gave it."""

    place: Place
    since_ns: int


@dataclass(slots=True)
class _RecordedInjection:
    """An injection in the recording. ``place`` is its number among the injections of its source."""

    place: int
    name: str
    since_ns: int
    declaration: Declaration | None
    """The declaration; None if a client gave the values."""
    priority: int = 0
    held: dict[str, _HeldValue] = field(default_factory=dict)
    """The last value that the client gave to each register, by path."""


@dataclass(slots=True)
class Derived:
    """Declarations that repeat the injections of a recording, in order of the sources.

    ``left_out`` has a message for each injection that cannot be repeated.
    """

    declarations: list[Declaration] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)

    @property
    def begin_s(self) -> float:
        """The earliest start of all declarations, in s.

        It is 0 if there are no declarations, or if a declaration has no start.
        """
        return min((one.start_s or 0.0 for one in self.declarations), default=0.0)

    def shifted(self, by_s: float) -> list[Declaration]:
        """Return the declarations with all starts and ends moved ``by_s`` seconds earlier."""
        return [
            msgspec.structs.replace(
                one,
                start_s=None if not (start_s := _round((one.start_s or 0.0) - by_s)) else start_s,
                end_s=None if one.end_s is None else _round(one.end_s - by_s),
            )
            for one in self.declarations
        ]


def derive(dump: Dump) -> Derived:
    """Derive declarations that repeat a recording's injections at the same instance times.

    A declared injection keeps its declaration and its seed, but lasts no longer than it did in the
    recording. Each value that a client gave to its injection over ``/out`` becomes an injection with
    the operation ``set``, which lasts until the client's next value. A client's injection over
    ``/in`` cannot be repeated, because its values depend on the writes of other clients.
    """
    found = Derived()
    for source in dump.sources:
        work = _Source(found)
        explainers: dict[int, Explainer] = {}
        for _, block, event in dump.events(source):
            if block is not None:
                explainer = explainers.setdefault(block.section, Explainer(source, block.layout))
                work.follow(event, explainer.explain(event))
        work.end()
    found.declarations = list(_named(found))
    return found


class _Source:
    def __init__(self, found: Derived) -> None:
        self._found = found
        self._injections: dict[int, _RecordedInjection] = {}
        self._declared: list[tuple[int, Declaration]] = []
        self._count = 0
        self._unknown: set[int] = set()

    def follow(self, event: Event, explained: Explained) -> None:
        if event.kind == EventKind.INJECTED and explained.definition is not None:
            self._create(event, explained)
        elif event.kind == EventKind.SHADOWED:
            self._shadow(event, explained)
        elif event.kind == EventKind.LIFTED and event.injection in self._injections:
            self._lift(self._injections.pop(event.injection), event)

    def _create(self, event: Event, explained: Explained) -> None:
        how = dict(explained.definition or {})
        declaration = None
        if event.writer == NO_WRITER:
            self._found.left_out.append(
                f"{event.text}: no client created this injection, but the configuration or a replayed recording"
            )
            return
        if "operation" in how:
            try:
                declaration = msgspec.convert(how, Declaration)
            except msgspec.ValidationError as error:
                self._found.left_out.append(f"{event.text}: {error}")
                return
        elif explained.direction == "in":
            self._found.left_out.append(
                f"{event.text or event.injection}: a client gave its values over /in, and they depended on other writes"
            )
            return
        priority = how.get("priority", 0)
        self._count += 1
        self._injections[event.injection] = _RecordedInjection(
            self._count, event.text, event.clock_ns, declaration, priority if isinstance(priority, int) else 0
        )

    def _shadow(self, event: Event, explained: Explained) -> None:
        injection = self._injections.get(event.injection)
        if injection is None:
            if event.injection not in self._unknown:
                self._unknown.add(event.injection)
                self._found.left_out.append(
                    f"{event.text or event.injection}: it was created before the recording began"
                )
            return
        for place in explained.places:
            before = injection.held.get(place.path)
            if not place.valued:
                continue
            if before is not None and before.place.value == place.value:
                continue
            if before is not None:
                self._set(injection, before, event.clock_ns)
            injection.held[place.path] = _HeldValue(place, event.clock_ns)

    def _lift(self, injection: _RecordedInjection, event: Event) -> None:
        for held in injection.held.values():
            self._set(injection, held, event.clock_ns)
        if injection.declaration is not None:
            self._declare(injection, injection.declaration, None if event.text == "over" else event.clock_ns)

    def end(self) -> None:
        """Add the declarations of the source. Injections that exist at the end get no end time."""
        for injection in self._injections.values():
            for held in injection.held.values():
                self._set(injection, held, None)
            if injection.declaration is not None:
                self._declare(injection, injection.declaration, None)
        self._declared.sort(key=lambda pair: pair[0])
        self._found.declarations += [one for _, one in self._declared]

    def _set(self, injection: _RecordedInjection, held: _HeldValue, until_ns: int | None) -> None:
        place = held.place
        value = place.plain
        if value is None or (isinstance(value, float) and not math.isfinite(value)):
            value = place.text
        name = injection.name or place.path.replace("/", "-")
        one = Declaration(name=name, target=place.path, operation="set", value=value, priority=injection.priority)
        self._declare(injection, one, until_ns, held.since_ns)

    def _declare(
        self, injection: _RecordedInjection, one: Declaration, until_ns: int | None, since_ns: int | None = None
    ) -> None:
        """Add a declaration, limited to a range of time.

        The method adds 1 ns to both times, because readers see a change only from the next cycle
        on.
        """
        since_s = (max(0, injection.since_ns if since_ns is None else since_ns) + 1) / NS
        if since_s > max(one.start_s or 0.0, 1 / NS):
            one = msgspec.structs.replace(one, start_s=_round(since_s))
        if until_ns is not None and (one.end_s is None or one.end_s > (until_ns + 1) / NS):
            one = msgspec.structs.replace(one, end_s=_round((until_ns + 1) / NS))
        if one.end_s is None or one.end_s > (one.start_s or 0.0):
            self._declared.append((injection.place, one))


def _named(found: Derived) -> Iterator[Declaration]:
    """Yield the declarations; rename each whose name another declaration already has.

    The random values of an injection depend on its name. If a new name changes them, add a message
    to ``left_out``.
    """
    seen: dict[str, int] = {}
    for one in found.declarations:
        count = seen[one.name] = seen.get(one.name, 0) + 1
        if count == 1:
            yield one
            continue
        name = f"{one.name}-{count}"
        if one.seed is not None and one.operation != "set":
            found.left_out.append(
                f"{name}: this injection was renamed, because {one.name} exists already; "
                "its random values change, because they depend on the name"
            )
        yield msgspec.structs.replace(one, name=name)


def _round(seconds: float) -> float:
    """Round a time to 1 ns, the resolution of recorded times."""
    return round(seconds, 9)
