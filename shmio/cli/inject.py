"""``shmio inject``: overrides single values, or runs a campaign file, for as long as the command runs."""

from __future__ import annotations

import argparse
import queue
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import msgspec

from shmio.cli.common import dumps, seconds, seed_number, stop_on_signals
from shmio.cli.set import Pairs
from shmio.config import Declaration
from shmio.config.declaration import shifted, with_seed
from shmio.errors import CommandError, PathError, ShmioError, ValueRangeError
from shmio.layout.model import Layout
from shmio.layout.topic import Topic, look_up, parse_topic
from shmio.layout.values.codec import Value
from shmio.layout.values.typed import read_value
from shmio.layout.values.write import Write, paths_of
from shmio.model.cell import Campaign, Cell
from shmio.model.event import Event, EventKind
from shmio.model.injection import InjectionEvent
from shmio.model.values import NO_WRITER
from shmio.wording import printable, unknown

TURN_S: Final = 0.2
"""Interval in s at which the command checks for events, signals and the end of its time."""
SEED_BITS: Final = 32
_REPLACING: Final = (EventKind.STARTED, EventKind.REMOVED, EventKind.RESTORED)
"""Kinds of the events after which a source may have other injections, without an event about each."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``inject``."""
    parser.epilog = (
        "An injection over PATH or PATH/out shows VALUE to consumers. An injection over PATH/in gives VALUE to the "
        "device, instead of what others write. VALUE is JSON or an S7 literal. Without PATH, this command lists the "
        "present injections."
    )
    parser.add_argument("pairs", nargs="*", action=Pairs, metavar="PATH VALUE", help="register or array element")
    parser.add_argument("--file", type=Path, metavar="CAMPAIGN.toml", help="inject what a campaign file declares")
    parser.add_argument(
        "--seed", type=seed_number, metavar="N", help="seed for those injections of the file that have none"
    )
    parser.add_argument(
        "--from-now", action="store_true", help="count the times in the file from now, not from the start"
    )
    parser.add_argument("--list", action="store_true", help="list the present injections (default without PATH)")
    how_long = parser.add_mutually_exclusive_group()
    how_long.add_argument(
        "--for", dest="for_s", type=seconds, metavar="S", help="lift the injections after this many seconds"
    )
    parser.add_argument(
        "--priority",
        type=int,
        default=0,
        metavar="N",
        help="of several injections over one register, the one with the highest priority is outermost (default: 0)",
    )
    parser.add_argument("--name", default="", help="the name of the injection in the list")
    how_long.add_argument("--keep", action="store_true", help="keep the injection until you lift it by its number")
    parser.add_argument("--lift", metavar="NUMBER", type=int, help="lift one injection, of any program")
    parser.add_argument("--lift-all", action="store_true", help="lift all injections of all sources")


def execute(cell: Cell, options: argparse.Namespace) -> int:
    """Start, list or lift injections.

    Raises:
        PathError: A path names no register.
        ValueRangeError: A value does not fit its register.
        CommandError: The options contradict each other, a source refused the injection, or somebody
            else lifted it.
        NotRunningError: The instance has stopped.
    """
    if options.lift_all or options.lift is not None:
        return _lift(cell, options)
    if options.file is not None:
        if options.pairs:
            raise CommandError("give --file, or PATH VALUE, not both")
        return run_campaign(cell, options)
    if options.list or not options.pairs:
        _list(cell, as_json=options.json)
        return 0
    wanted: dict[tuple[str, str], dict[str, Value]] = {}
    layouts = cell.layouts()
    for path, text in options.pairs:
        topic, value = _read(layouts, path, text)
        wanted.setdefault((topic.source, topic.direction or "out"), {})[f"{topic.source}/{topic.path}"] = value
    with ExitStack() as stack:
        watch = None if options.keep else stack.enter_context(_Watch(cell, [source for source, _ in wanted]))
        created: dict[tuple[str, int], str] = {}
        for (source, direction), values in wanted.items():
            paths = [f"{path}/{direction}" for path in values]
            shadow = stack.enter_context(
                cell.inject(*paths, priority=options.priority, keep=options.keep, name=options.name)
            )
            for path, outcome in zip(paths, shadow.set(values), strict=True):
                if not outcome.done:
                    raise CommandError(f"{path}: {outcome.text}")
            created[source, shadow.number] = f"{shadow.number}: {', '.join(map(printable, paths))}"
            print(created[source, shadow.number], flush=True)
        if watch is not None:
            watch.wait(created, options.for_s)
    return 0


def _read(layouts: Mapping[str, Layout], path: str, text: str) -> tuple[Topic, Value]:
    """Return what a path names, and the value to inject there.

    Raises:
        PathError: The path names no register.
        ValueRangeError: The value does not fit the register.

    """
    topic = parse_topic(path, layouts, next(iter(layouts)) if len(layouts) == 1 else None)
    if topic.source not in layouts:
        raise PathError(f"{path}: {unknown('source', topic.source, layouts)}")
    register = look_up(layouts[topic.source], topic)
    try:
        return topic, read_value(text, register)
    except ValueRangeError as error:
        raise ValueRangeError(f"{path}: {str(error).removeprefix(f'{register.path}: ')}") from None


class _Watch:
    """Waits while the injections of this command exist, and notices if they end before it lifts them.

    Leave the ``with`` block after the injections were lifted, so that no signal interrupts that.
    """

    def __init__(self, cell: Cell, sources: Sequence[str]) -> None:
        self._cell = cell
        self._sources = list(dict.fromkeys(sources))
        self._left: dict[tuple[str, int], str] = {}
        self._lifted: list[str] = []
        self._error: ShmioError | None = None
        self._thread = threading.Thread(target=self._follow, daemon=True)

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            self._over = stack.enter_context(stop_on_signals())
            self._events = stack.enter_context(self._cell.events(*self._sources))  # from before the injections
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._events.close()
        if self._thread.ident is not None:
            self._thread.join()
        self._stack.close()

    def wait(self, created: Mapping[tuple[str, int], str], for_s: float | None) -> None:
        """Wait for Ctrl-C, SIGTERM or SIGHUP, for at most ``for_s`` seconds; None sets no limit.

        Args:
            created: A text for each injection, by source and number.
            for_s: Longest time in s.

        Raises:
            CommandError: Somebody else lifted injections.
            NotRunningError: The instance has stopped.

        """
        self._left.update(created)
        self._thread.start()
        self._over.wait(for_s)
        self._over.set()  # what is lifted from now on, this command lifts
        if self._error is not None:
            raise self._error
        if self._lifted and self._left:
            raise CommandError(f"{len(self._lifted)} of {len(created)} injections were lifted before the command ended")
        if self._lifted:
            raise CommandError(self._lifted[-1])  # the others were printed

    def _follow(self) -> None:
        """Set ``over`` when no injection is left, or when the instance stops."""
        try:
            for event in self._events:
                if self._over.is_set():
                    return
                if event.kind == EventKind.LIFTED:
                    self._drop(event.source, event.injection, event)
                if event.missed or event.kind in _REPLACING:
                    self._drop_absent(event)
                if not self._left:
                    return
        except ShmioError as error:
            if not self._over.is_set():
                self._error = error
        finally:
            self._over.set()

    def _drop_absent(self, event: Event) -> None:
        """Drop the injections of a source that have ended without an event, as in a block that a reload replaced."""
        source = event.source
        removed = event.kind == EventKind.REMOVED
        present = () if removed else {one.number for one in self._cell.injections(source)}
        for number in [number for of, number in self._left if of == source and number not in present]:
            self._drop(source, number, event if removed else None)

    def _drop(self, source: str, number: int, event: Event | None) -> None:
        """Take note that one of the injections has ended, and say so at once if others remain."""
        if (created := self._left.pop((source, number), None)) is None:
            return
        said = "" if event is None else printable(event.text)
        where = said if said.startswith("lifted") else "lifted"
        text = f"{created} was {where}{f' by {event.sender}' if event is not None and event.by else ''}"
        if said and where != said:
            text += f": {said}"
        if self._left:
            print(text, file=sys.stderr, flush=True)
        self._lifted.append(text)


def _lift(cell: Cell, options: argparse.Namespace) -> int:
    if options.lift_all:
        lifted = [(one.source, one.number, one.name) for one in cell.lift_all()]
    else:
        lifted = [(one.source, one.number, one.name) for one in cell.injections() if one.number == options.lift]
        if not lifted:
            raise CommandError(f"there is no injection {options.lift}; shmio inject lists the injections")
        for source, number, _ in lifted:
            cell.lift(source, number)
    for source, number, name in lifted:
        print(f"{number}: lifted from {source}{f' ({printable(name)})' if name else ''}")
    return 0


def _list(cell: Cell, *, as_json: bool) -> None:
    """Print the present injections with their registers."""
    found: list[dict[str, Any]] = []
    present = cell.injections()
    layouts = cell.layouts() if present else {}
    for one in present:
        bits = (Write(offset, mask, bytes(size)) for offset, size, mask in one.ranges)
        over = [f"{one.source}/{path}" for path in paths_of(layouts[one.source], bits)]
        fields = msgspec.to_builtins(one)
        if one.running is not None:  # so that local and remote cells give the same order of keys
            declaration = msgspec.convert(one.running.declaration, Declaration)
            fields["running"]["declaration"] = msgspec.to_builtins(declaration)
        found.append(
            {
                "source": one.source,
                **{key: value for key, value in fields.items() if key not in ("ranges", "source")},
                "registers": over,
            }
        )
    if as_json:
        print(dumps(found))
        return
    for one, one_found in zip(present, found, strict=True):
        paths = _targets(one_found)
        more = f" and {len(paths) - 3} more" if paths[3:] else ""
        keep = ", kept" if one_found["keep"] else ""
        other = "supervisor.toml" if one.writer == NO_WRITER else "a program"
        by = f"pid {one.pid}" if one.pid else other
        if one.endpoint == "fabric" and one.pid:
            by = "a program of another cell"
        elif one.cell:
            by += f" of {one.cell}"
        elif one.endpoint:
            by = one.endpoint
        print(
            f"{one_found['id']}  {', '.join(map(printable, paths[:3]))}{more} /{one_found['direction']}, "
            f"priority {one_found['priority']}, {by}{keep}{_running(one_found.get('running'))}  "
            f"{printable(one_found['name'])}".rstrip()
        )


def _targets(one_found: dict[str, Any]) -> list[str]:
    """Return the paths of an injection.

    For a declared injection, these are the patterns in its declaration.
    """
    running = one_found.get("running")
    if running is None:
        return list(one_found["registers"])
    target = running["declaration"]["target"]
    texts = [target] if isinstance(target, str) else target
    return [text.removesuffix(f"/{one_found['direction']}") for text in texts]


def _running(running: dict[str, Any] | None) -> str:
    """Return the state of a declared injection as text."""
    if running is None:
        return ""
    times = f" since cycle {running['cycle']}, run {running['runs']}" if running["state"] == "active" else ""
    return f", {running['declaration']['operation']}, seed {running['seed']}: {running['state']}{times}"


def run_campaign(cell: Cell, options: argparse.Namespace) -> int:
    """Run a campaign until all its injections have ended, its time is up, or a signal arrives.

    With ``--keep``, return as soon as the campaign has started.

    Raises:
        ConfigError: The campaign file is invalid. Nothing was started.
        CommandError: A source refused an injection, or the start time of an injection has passed.
            Nothing was started.

    """
    import secrets  # noqa: PLC0415  the other verbs need no random numbers, and it loads OpenSSL

    from shmio.config.campaign import read_campaign  # noqa: PLC0415  only for a file

    seed = secrets.randbits(SEED_BITS) if options.seed is None else options.seed
    read = read_campaign(options.file)
    declarations = [with_seed(declaration, seed) for declaration in read]
    now_s = cell.clock().present_ns / 1e9
    if options.from_now:
        declarations = [shifted(declaration, now_s) for declaration in declarations]
    else:
        _refuse_past(declarations, now_s)
    with stop_on_signals() as over, cell.declare(declarations, keep=options.keep) as campaign:
        if any(declaration.seed is None for declaration in read):
            line = dumps({"seed": seed}) if options.json else f"seed {seed}: --seed {seed} repeats this run"
            print(line, flush=True)
        clock = cell.clock()
        if clock.virtual and not clock.playing and any(one.start_s or one.end_s for one in declarations):
            stands = f"time is paused at {clock.present_ns / 1e9:.3f} s"
            print(f"{stands}; start_s and end_s wait until shmio step moves time", file=sys.stderr, flush=True)
        _follow(campaign, over, options)
    return 0


def _follow(campaign: Campaign, over: threading.Event, options: argparse.Namespace) -> None:
    """Print events until no injection is left, the time is up, or a signal arrives."""
    deadline_s = None if options.for_s is None else time.monotonic() + options.for_s
    names = {(one.source, one.number): one.name for one in campaign.declared}
    awaited = set(names)
    while awaited:  # each injection first reports its creation
        event = next(campaign)
        awaited.discard((event.source, event.number))
        _print_event(event, names, as_json=options.json)
    if options.keep:
        return
    waiting: queue.SimpleQueue[InjectionEvent | ShmioError | None] = queue.SimpleQueue()
    threading.Thread(target=_queue, args=(campaign, waiting), daemon=True).start()  # the thread ends with the campaign
    while True:
        ended = over.is_set() or (deadline_s is not None and time.monotonic() > deadline_s)
        while not waiting.empty():
            one = waiting.get()
            if one is None:
                return
            if isinstance(one, ShmioError):
                raise one
            _print_event(one, names, as_json=options.json)
        if ended:
            return
        over.wait(TURN_S)


def _queue(campaign: Campaign, waiting: queue.SimpleQueue[InjectionEvent | ShmioError | None]) -> None:
    """Put a campaign's events into a queue, then the error that ended it, if any, and then None."""
    try:
        for event in campaign:
            waiting.put(event)
    except ShmioError as error:
        waiting.put(error)
    waiting.put(None)


def _refuse_past(declarations: Sequence[Declaration], now_s: float) -> None:
    """Refuse an injection whose time has passed, because it would have no effect.

    Raises:
        CommandError: The time of an injection has passed.

    """
    for one in declarations:
        if one.end_s is not None and one.end_s <= now_s:
            raise CommandError(
                f"the time of injection {one.name!r} has passed: its end_s is {one.end_s:g}, but the instance's clock "
                f"is at {now_s:.3f} s; --from-now counts the file's times from now"
            )


def _print_event(event: InjectionEvent, names: Mapping[tuple[str, int], str], *, as_json: bool) -> None:
    """Print an event as a line: time, cycle, injection, and what happened."""
    source, number, time_s = event.source, event.number, event.clock_ns / 1e9
    text = event.text or names[source, number]
    if as_json:
        what = {"cycle": event.cycle, "source": source, "id": number, "what": event.what, "text": text}
        print(dumps({"time_s": time_s, **what}), flush=True)
        return
    line = f"{time_s:11.3f} s  cycle {event.cycle}  {number} {event.what}: {text}"
    print(printable(line), flush=True)
