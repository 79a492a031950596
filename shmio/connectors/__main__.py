"""Runs the process of one source."""

from __future__ import annotations

import logging
import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec

from shmio import control, worker
from shmio.connectors import registry
from shmio.connectors.base import Connector, Mirrored, Replayed
from shmio.connectors.injections import blocks_of, owner_of
from shmio.connectors.models.stepped import PageClock, SteppedLoop, connected_inputs
from shmio.connectors.poll_loop import Schedule, SourceLoop, WallClock
from shmio.errors import ConfigError, ConnectorError, ShmioError
from shmio.local.state_requests import StateRequests
from shmio.logs import rate_limited
from shmio.segment import Segment, State
from shmio.worker import BEAT_S, Reload, Worker

if TYPE_CHECKING:
    from shmio.connectors.fabric.loop import MirrorLoop
    from shmio.connectors.replay.loop import ReplayLoop

LOGGERS: Final = ("shmio.source", "shmio.source.mqtt", "shmio.fabric", "nats", "asyncio")
"""Loggers whose lines a device or another cell can cause in great number. The rate of these lines is limited."""
SWITCH_S = 0.0005  # with Python's default of 5 ms, other threads would delay the poll thread too long
RELOAD_S = 120.0
LAST_WORDS_S = 4.0  # less than the supervisor's grace period
REPLAY_TIMEOUT_S = 1.0
ATTEMPT_S = 15.0  # less than the time for which the supervisor waits until the process runs again
HANG_MARGIN_S = 30.0  # added to the time-out, because asyncio's look-up of a host name has no time-out


class _LoopHandle(NamedTuple):
    """A source's loop, the function that stops it, and the time-out of the source's methods in s."""

    loop: SourceLoop | SteppedLoop | ReplayLoop | MirrorLoop
    stop: Callable[[], None]
    timeout_s: float


def run(worker: Worker) -> None:
    """Run the poll loop and the commands in two threads, and send reports from the calling thread.

    So a blocked method of the source delays neither commands nor reports. If the supervisor writes
    a new configuration for a device, a new loop replaces the present one, and takes over the
    connection if possible.
    """
    sys.setswitchinterval(SWITCH_S)
    woken = threading.Event()
    worker.on_stop(woken.set)
    worker.on_reread(woken.set)
    with rate_limited(*LOGGERS):
        _run(worker, woken)


def _run(worker: Worker, woken: threading.Event) -> None:
    running = _Running(_loop_of(worker))
    worker.running()
    rate = _Rate()
    while not worker.stopping.is_set():
        woken.wait(BEAT_S)
        woken.clear()
        running.report(worker, rate)
        if isinstance(running.part.loop, SourceLoop) and (config := worker.revised()) is not None:
            part = _replaced(running, running.part.loop, worker, config, woken, rate)
            if part is None:
                return
            running = _Running(part)
            running.await_attempt(worker, rate)
            worker.running()
    running.stop()


class _Running:
    """The two threads of a loop."""

    def __init__(self, part: _LoopHandle) -> None:
        self.part = part
        loop = part.loop
        self.poll = threading.Thread(target=_guarded, args=(loop.run,), name="poll", daemon=True)
        self.commands = threading.Thread(target=_guarded, args=(loop.commands.run,), name="commands", daemon=True)
        self.poll.start()
        self.commands.start()

    def report(self, worker: Worker, rate: _Rate) -> None:
        """Report that the loop runs.

        Raises:
            ConnectorError: The loop has ended.

        """
        if not self.poll.is_alive() or not self.commands.is_alive():
            raise ConnectorError(
                "the source's poll loop or command thread ended unexpectedly; the log has the traceback"
            )
        loop = self.part.loop
        busy_s = _busy_s(loop.counters.busy_since_ns)
        if busy_s > self.part.timeout_s + HANG_MARGIN_S:
            return  # without a heartbeat, so that the supervisor replaces the process
        note = f"a cycle takes longer than {self.part.timeout_s:g} s" if busy_s > self.part.timeout_s else loop.note
        worker.report(self.counters(rate), note=note)

    def counters(self, rate: _Rate) -> tuple[int, ...]:
        """Return the counters for the process table."""
        counters = self.part.loop.counters
        return (
            counters.polls,
            counters.overruns,
            counters.failures,
            counters.connects,
            counters.round_trip_us,
            rate.update_mhz(counters.polls),
        )

    def await_attempt(self, worker: Worker, rate: _Rate) -> None:
        """Wait until the loop has taken over the connection, or has connected or failed, at most ``ATTEMPT_S``."""
        attempted = self.part.loop.attempted if isinstance(self.part.loop, SourceLoop) else threading.Event()
        deadline_s = time.monotonic() + ATTEMPT_S
        while not attempted.wait(BEAT_S) and time.monotonic() < deadline_s and not worker.stopping.is_set():
            self.report(worker, rate)
        self.report(worker, rate)

    def stop(self, meanwhile: Callable[[], None] = lambda: None) -> bool:
        """Stop the loop, and call ``meanwhile`` repeatedly while it ends; return whether it has ended."""
        self.part.stop()
        deadline_s = time.monotonic() + min(self.part.timeout_s + 0.5, LAST_WORDS_S)
        while self.poll.is_alive() and (left_s := deadline_s - time.monotonic()) > 0:
            self.poll.join(min(left_s, BEAT_S))
            meanwhile()
        self.commands.join(timeout=1.0)
        return not self.poll.is_alive() and not self.commands.is_alive()


def _replaced(
    running: _Running, loop: SourceLoop, worker: Worker, config: dict[str, Any], woken: threading.Event, rate: _Rate
) -> _LoopHandle | None:
    """Stop a loop, wait until the supervisor has changed the segment, and return the next loop.

    Return None if the process must stop. If the supervisor dies before it has changed the segment,
    the next loop continues with the present configuration.

    Raises:
        ConnectorError: The loop does not end.

    """
    block, reload = worker.segment.blocks[worker.name], Reload(worker, woken)
    loop.keep()
    if not running.stop(worker.report):
        raise ConnectorError("the device did not answer in time for the reload; the process starts again")
    worker.report(counters=running.counters(rate), note=loop.unkept)
    permitted = reload.permitted(lambda: block.retired)
    if worker.stopping.is_set():
        if loop.kept is not None:
            loop.kept.close()
        return None
    if permitted:
        worker.config = config
        worker.segment.refresh()
    return _loop_of(worker, loop)


def _loop_of(worker: Worker, predecessor: SourceLoop | None = None) -> _LoopHandle:
    """Create the loop that runs this source; ``predecessor`` is the loop that it replaces, if any."""
    segment, name = worker.segment, worker.config["connector"]
    found = registry.load(name)
    options = registry.convert_options(name, worker.config["options"])
    if issubclass(found, Replayed):
        return _replay_loop(worker, options)
    if issubclass(found, Mirrored):
        return _mirror_loop(worker, options)
    layout = segment.blocks[worker.name].layout
    if issubclass(found, Connector):
        layout = layout.base  # without registers over the block, which the device does not have
        found = found.for_layout(layout)
    source = found(options, layout)
    writer = segment.writer(worker.name)  # after the source: a configuration error must not change the segment
    schedule = Schedule(segment.header.started_ns, writer.block.period_ns)
    owners, blocks = partial(owner_of, segment), partial(blocks_of, segment)
    writable, allow = worker.config["writable"], worker.config["allow_nonfinite"]
    if isinstance(source, Connector):
        clock = WallClock()
        armed = writer.block.attributes.armed
        loop = SourceLoop(
            source, writer, schedule, clock, writable,
            allow_nonfinite=allow, armed=armed, owner_of=owners, blocks=blocks, predecessor=predecessor,
        )  # fmt: skip
        return _LoopHandle(loop, clock.stop, source.timeout_s)
    page_clock = PageClock(segment.clock, worker.slot.index)
    inputs = connected_inputs(source, writer.block, lambda: Segment.open(segment.instance))
    stepped = SteppedLoop(
        source, writer, schedule, page_clock, writable,
        allow_nonfinite=allow, inputs=inputs, owner_of=owners, blocks=blocks, crash=worker.slot.supervised.note,
    )  # fmt: skip

    stepped.state_requests = StateRequests(
        segment.clock, worker.slot.index, worker.name, Path(worker.config["snapshots"]), stepped
    )

    def stop() -> None:
        page_clock.stop()
        source.interrupt()

    return _LoopHandle(stepped, stop, source.timeout_s)


def _replay_loop(worker: Worker, options: Any) -> _LoopHandle:
    """Create the loop that plays a recording."""
    from shmio.connectors.replay.loop import ReplayLoop  # noqa: PLC0415  the other sources read no recordings
    from shmio.connectors.replay.source import Replay, begin  # noqa: PLC0415

    segment = worker.segment
    source = Replay(options, worker.name)
    if source.layout.hash != segment.blocks[worker.name].layout.hash:
        raise ConfigError(
            f"the recording of source {worker.name} now has a different layout; run shmio-supervisor reload"
        )
    block = segment.blocks[worker.name]
    beginning = begin(source, block, segment.header.started_ns, segment.blocks.values())
    clock = PageClock(segment.clock, worker.slot.index)
    loop = ReplayLoop(
        source,
        segment.writer(worker.name, beginning.at),
        beginning,
        clock,
        worker.config["writable"],
        allow_nonfinite=worker.config["allow_nonfinite"],
        owner_of=partial(owner_of, segment),
        blocks=partial(blocks_of, segment),
    )
    return _LoopHandle(loop, clock.stop, REPLAY_TIMEOUT_S)


def _mirror_loop(worker: Worker, options: Any) -> _LoopHandle:
    """Create the loop that reproduces a source of another cell."""
    from shmio.connectors.fabric.link import Link  # noqa: PLC0415  the other sources need no fabric
    from shmio.connectors.fabric.loop import ANSWER_S, MirrorLoop  # noqa: PLC0415
    from shmio.connectors.fabric.source import Mirror, Settings  # noqa: PLC0415

    segment = worker.segment
    mirror = Mirror(options, worker.name)
    settings = msgspec.convert(worker.config["fabric"], Settings)
    clock = PageClock(segment.clock, worker.slot.index)
    name = f"shmio {segment.instance}/{worker.name}"
    loop = MirrorLoop(
        mirror,
        segment.writer(worker.name),
        clock,
        lambda received, answered: Link(
            settings.access, mirror.cell, mirror.source, name, settings.sender, received, answered
        ),
        worker.config["writable"],
        allow_nonfinite=worker.config["allow_nonfinite"],
        armed=segment.blocks[worker.name].attributes.armed,
        owner_of=partial(owner_of, segment),
        blocks=partial(blocks_of, segment),
        names={**settings.names, worker.name: mirror.source},
        own_layout=worker.config["layout"] is not None,
        changed=partial(_ask_to_reload, segment.instance),
        ending=lambda: segment.supervisor[1] is State.STOPPING,
    )
    return _LoopHandle(loop, clock.stop, ANSWER_S)


def _ask_to_reload(instance: str) -> None:
    """Ask the supervisor to reload, so that it reads the new layout of a mirrored source."""

    def ask() -> None:
        try:
            control.request(control.socket_path(instance), control.Reload(), RELOAD_S)
        except ShmioError as error:
            logging.getLogger("shmio.source").warning("the supervisor did not reload: %s", error)

    threading.Thread(target=ask, name="reload", daemon=True).start()


def _guarded(run: Callable[[], None]) -> None:
    try:
        run()
    except Exception:
        logging.getLogger("shmio").exception("the source's thread failed")


def _busy_s(since_ns: int) -> float:
    return (time.monotonic_ns() - since_ns) / 1e9 if since_ns else 0.0


class _Rate:
    """Measures the rate of polls over about the last second, in polls per 1000 s."""

    def __init__(self) -> None:
        self._marks: list[tuple[float, int]] = []

    def update_mhz(self, polls: int) -> int:
        now = time.monotonic()
        self._marks.append((now, polls))
        while len(self._marks) > 2 and now - self._marks[1][0] >= 1.0:
            self._marks.pop(0)
        since, before = self._marks[0]
        return round(1000 * (polls - before) / (now - since)) if now > since else 0


if __name__ == "__main__":
    raise SystemExit(worker.main(run))
