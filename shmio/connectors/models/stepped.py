"""The loop that runs computed sources, and the inputs that they read from other sources.

In wall time, the loop computes each cycle of the source's schedule. In virtual time, the loop computes
each requested step.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Final, NamedTuple, Protocol

from shmio.connectors.base import Computed
from shmio.connectors.commands import CommandProcessor
from shmio.connectors.injections import Blocks, OwnerOf, newest
from shmio.connectors.models.state import PreparedSource, save_source
from shmio.connectors.output import Image, Output
from shmio.connectors.poll_loop import Counters, QualityLog, Schedule
from shmio.errors import PathError, SegmentError, ShmioError
from shmio.layout.topic import Topic, find, parse_topic
from shmio.layout.values.codec import Value
from shmio.layout.values.write import Write
from shmio.local.reading import holds_none, status_of
from shmio.local.state_requests import StateRequests
from shmio.model.clock import Clock
from shmio.model.statuses import trusted_codec
from shmio.segment import Block, BlockWriter, EventKind, Frame, Provenance, Quality, Record, Segment, Stamp
from shmio.segment.block import read_frames
from shmio.segment.clock import ClockPage, StepRequest

NO_DATA: Final = "no data yet"
_FEW: Final = 8
"""Number of frames that are read one after another; with more, only the newest one is read."""
_GOOD, _UNCERTAIN, _SIMULATED = Quality.GOOD, Quality.UNCERTAIN, Provenance.SIMULATED
"""Each step needs these, and looking up a member of an enum is slow."""
RESTARTED: Final = "the source's process was restarted during this step; it continues with the next step"


class Inputs:
    """Reads the registers of other sources that are connected to one source's inputs.

    If a source takes part in steps, its last frame before the present step counts, even if the
    source has already completed the step (the Jacobi method). Otherwise its newest frame counts.
    Use an object in one thread only.
    """

    def __init__(self, segment: Segment, connections: Mapping[str, Topic]) -> None:
        """Create the inputs.

        Args:
            segment: A segment that no other object uses, because reading refreshes it after
                reloads.
            connections: The topic of each input, by the input's path.

        """
        self._segment = segment
        self._connections = connections
        self._upstreams: list[_Upstream] = []
        self._wanted: list[_Wanted] | None = None  # None: not yet found, or not all of them

    def read(self, step: int | None, before_ns: int | None = None) -> tuple[dict[str, Value], str]:
        """Return the values of inputs by path, and why other inputs have no value.

        The reason is empty if all inputs have a value.

        Args:
            step: The present step; None in wall time.
            before_ns: The publish time before the step; None: it is read from the segment.

        """
        wanted, segment = self._wanted, self._segment
        if wanted is None or (segment.outdated and segment.refresh()):
            wanted = self._find_all()
        frames = [upstream.frame(step, before_ns) for upstream in self._upstreams]
        values: dict[str, Value] = {}
        missing: list[str] = []
        for path, topic, place, decode, problem in wanted:
            if decode is None:
                missing.append(f"input {path}: {problem}")
                continue
            frame, reason = frames[place]
            value = None if frame is None else decode(frame.image)
            if value is None or (type(value) is list and holds_none(value)):
                missing.append(f"input {path}{reason or self._upstreams[place].why_none(topic, frame)}")
            else:
                values[path] = value
        return values, "; ".join(missing)

    def _find_all(self) -> list[_Wanted]:
        """Find the sources and registers of all connections. Those that do not exist are searched for again."""
        self._segment.refresh()
        upstreams: dict[str, _Upstream] = {}
        wanted: list[_Wanted] = []
        for path, topic in self._connections.items():
            try:
                block = self._segment.blocks.get(topic.source)
                if block is None:
                    raise PathError(f"source {topic.source!r} no longer exists")
                decode = trusted_codec(find(block.layout, topic.path), block.layout).decode
            except (PathError, SegmentError) as error:
                wanted.append(_Wanted(path, topic, 0, None, str(error)))
                continue
            upstreams.setdefault(block.source, _Upstream(block))
            wanted.append(_Wanted(path, topic, list(upstreams).index(block.source), decode, ""))
        self._upstreams = list(upstreams.values())
        self._wanted = None if any(one.problem for one in wanted) else wanted
        return wanted


class _Wanted(NamedTuple):
    """A register that is connected to the input ``path``; ``decode`` is None if there is a problem.

    ``place`` is the index of its source.
    """

    path: str
    topic: Topic
    place: int
    decode: Callable[[bytes], Value] | None
    problem: str


class _Upstream:
    """A source whose registers are connected to inputs."""

    def __init__(self, block: Block) -> None:
        self._block = block
        self._is_stepped = block.attributes.stepped and block.playhead is None
        self._frames: list[Frame] = []  # the frame used last, and the later ones that have been read

    def frame(self, step: int | None, before_ns: int | None) -> tuple[Frame | None, str]:
        """Return the frame to use and "", or None and the end of a message why there is no usable frame."""
        block = self._block
        try:
            frame = block.latest() if step is None else self._before(step)
            if frame is None:
                return None, self._keeps(NO_DATA)
            now_ns = block.now_ns() if before_ns is None or not self._is_stepped else before_ns
            quality, reason = block.assess(frame, now_ns)
        except SegmentError as error:
            return None, f": {error}"
        if quality is Quality.BAD:
            return None, self._keeps(reason if frame.quality is Quality.BAD else "stale")
        return frame, ""

    def _before(self, step: int) -> Frame | None:
        """Return the newest frame before a step. Each frame is read only once."""
        block, frames = self._block, self._frames
        head = block.ring.head()
        last = frames[-1].number if frames else 0
        if 0 < head - last <= _FEW:
            frames += read_frames(block.ring, last + 1, head - last)
        if frames and frames[-1].number == head:
            for place in range(len(frames) - 1, -1, -1):
                if not block.came_with(frames[place], step):
                    del frames[:place]
                    return frames[0]
        found = newest(block, step)
        self._frames = [] if found is None else [found]
        return found

    def why_none(self, topic: Topic, frame: Frame | None) -> str:
        """Return the end of a message why a register has no value although its frame is good."""
        status = frame and status_of(self._block, find(self._block.layout, topic.path), frame)
        return self._keeps((status.reason if status else "") or "the bytes are not a valid value")

    def _keeps(self, reason: str) -> str:
        return f" keeps its value: {self._block.source}: {reason}"


def connected_inputs(source: Computed, block: Block, opened: Callable[[], Segment]) -> Inputs | None:
    """Return a reader of the values for a source's connected inputs; None if no input is connected.

    ``opened`` opens the segment a second time, because the reader must handle reloads independently
    of the rest of the process.
    """
    if not source.connections:
        return None
    segment = opened()
    return Inputs(
        segment,
        {path: parse_topic(topic, segment.blocks, block.source) for path, topic in source.connections.items()},
    )


class StepClock(Protocol):
    """The clock that the loop needs. Tests provide their own."""

    def now_ns(self) -> int:
        """Return the time of CLOCK_MONOTONIC in ns."""

    def wait_ns(self, duration_ns: int | None) -> bool:
        """Wait for a wake-up, at most ``duration_ns`` (None: without limit).

        Return whether the loop must stop.
        """

    def nudge(self) -> None:
        """Wake the loop. Any thread may call this."""


class PageClock:
    """The loop's clock in a running instance. It waits on the process's doorbell in the segment."""

    def __init__(self, page: ClockPage, slot: int) -> None:
        self._bell = page.slot_bell(slot)
        self._seen = self._bell.value()
        self._stopped = False

    now_ns = staticmethod(time.monotonic_ns)
    """Returns the time of CLOCK_MONOTONIC in ns."""

    def wait_ns(self, duration_ns: int | None) -> bool:
        """Wait for a wake-up, at most ``duration_ns`` (None: without limit).

        Return whether the loop must stop. If a wake-up comes while the loop is busy, the next wait
        returns at once.
        """
        if not self._stopped and (duration_ns is None or duration_ns > 0):
            self._seen = self._bell.wait(self._seen, -1 if duration_ns is None else duration_ns)
        return self._stopped

    def nudge(self) -> None:
        """Wake the loop. Any thread may call this."""
        self._bell.ring()

    def stop(self) -> None:
        """Stop the loop. Any thread may call this."""
        self._stopped = True
        self.nudge()


class SteppedLoop:
    """Runs one computed source: computes and publishes frames, and carries out writes.

    In virtual time, the loop publishes a frame for every step. If a step fails, the frame is bad and
    states the reason.
    """

    def __init__(
        self,
        source: Computed,
        writer: BlockWriter,
        schedule: Schedule,
        clock: StepClock,
        writable: Iterable[str] = (),
        *,
        allow_nonfinite: Iterable[str] = (),
        inputs: Inputs | None = None,
        owner_of: OwnerOf = lambda _: None,
        blocks: Blocks | None = None,
        crash: str = "",
    ) -> None:
        """Create the loop.

        Args:
            source: The computed source.
            writer: Writes the source's block.
            schedule: The times at which cycles are due in wall time.
            clock: The loop's clock.
            writable: Patterns of the registers that commands may write.
            allow_nonfinite: Patterns of the registers to which NaN and infinities may be written.
            inputs: Reads the source's connected inputs; None if no input is connected.
            owner_of: Returns the process that uses a command queue.
            blocks: Returns the blocks of all sources.
            crash: How the source's previous process ended, if it crashed.

        """
        self._source = source
        self._crash = crash
        source.attach(writer)
        self._writer = writer
        self._page = writer.block.clock
        writer.utc_ns = self._page.utc_ns
        self._began_ns = self._page.monotonic_ns(0)
        self._began_utc_ns = self._page.utc_ns(self._began_ns)
        self._from_start = self._schedule = schedule
        self._basis = Clock().basis  # the clock's basis for which the schedule is valid
        self._clock = clock
        self._inputs = inputs
        self._output = Output(writer, clock.now_ns)
        # Injections cannot reach a device here, so `armed` is not required.
        self.commands = CommandProcessor(
            self._output, writable, clock.now_ns, allow_nonfinite=allow_nonfinite, armed=True, owner_of=owner_of,
            blocks=blocks, accepted=clock.nudge,
        )  # fmt: skip
        self._quality_log = QualityLog(writer)
        self._handled = 0  # the last step computed or skipped
        self._time_ns: int | None = None  # instance time of the image computed last
        self._at: Stamp | None = None  # in virtual time, the times of frames; None: now
        self._published = False
        self.counters = Counters()
        self.state_requests: StateRequests | None = None
        """Requests to save and restore the state; None: there are none."""

    @property
    def note(self) -> str:
        """Why quality is not good; empty if it is good."""
        return self._quality_log.note

    def run(self) -> None:
        """Compute cycles and steps until the clock stops the loop, then publish a bad frame."""
        try:
            self.begin()
            page = self._page
            while not (self._live(request) if (request := page.step_request()).virtual else self._free_run()):
                pass
        finally:
            self.commands.stop()
            reason = "the source was stopped"
            self.commands.close(reason)
            self._fail(self._writer.cycle, reason)
            self._writer.event(Record(EventKind.STOPPED))
            self._source.close()

    def begin(self) -> None:
        """Continue from the last image of the source's previous process, if there is one."""
        last = self._writer.block.latest()
        if self._output.source_ns:
            self._source.resume(self._output.raw)
        self.commands.open()
        self.counters.connects += 1
        state = self._page.read()
        if not state.virtual:
            return
        crash, self._crash = self._crash, ""
        self._writer.cycle, self._handled = state.step, state.step
        self._stand(state.time_ns)
        self._time_ns = state.time_ns
        if state.stepping and last is None:
            self._handled -= 1  # a source without a frame takes part in the present step
        elif state.stepping and last is not None and last.cycle < state.step:
            self._fail(state.step, f"{RESTARTED} ({crash})" if crash else RESTARTED)
        else:
            self._show(state.step)

    # ---- wall time -----------------------------------------------------------------------------------------------

    def _free_run(self) -> bool:
        """Wait for the next cycle of the schedule and compute it.

        Return whether the loop must stop.
        """
        state = self._page.last_written()
        if state.virtual:
            return False
        if state.basis != self._basis:
            self._resume(state)
        self._at = self._writer.at_ns = None
        due = self._schedule.next(self._clock.now_ns())
        self.counters.overruns += due.skipped
        if self._crash:  # readers then know the reason, even if this process crashes too
            self._writer.cycle = max(0, due.cycle - 1)
            self._fail(self._writer.cycle, f"the source's process was restarted: {self._crash}")
            self._crash = ""
        while (now_ns := self._clock.now_ns()) < due.due_ns:
            wait_ns = due.due_ns - now_ns
            if self._source.prompt and self.commands.waiting:
                if now_ns >= self._output.next_ns:
                    self._writer.cycle = max(0, due.cycle - 1)
                    self._carry_out()
                    continue
                wait_ns = min(wait_ns, self._output.next_ns - now_ns)
            if self._clock.wait_ns(wait_ns):
                return True
            if self._page.last_written().basis != self._basis:
                return False
        if self._clock.wait_ns(0):
            return True
        if self._page.last_written().basis != self._basis:  # after now_ns(): see Coordinator.take_over
            return False
        if now_ns >= self._schedule.due_ns(due.cycle + 1):  # this thread was delayed while it waited
            self.counters.overruns += 1
            return False
        period_ns = self._writer.block.period_ns
        time_ns = (due.cycle - state.lead(period_ns)) * period_ns
        self._compute(due.cycle, time_ns, period_ns if self._time_ns is None else time_ns - self._time_ns)
        return False

    def _resume(self, state: Clock) -> None:
        """Follow the schedule again after virtual time has ended."""
        self._basis = state.basis
        self._schedule = self._from_start.moved(state.offset_ns, state.lead(self._writer.block.period_ns))

    # ---- virtual time --------------------------------------------------------------------------------------------

    def _live(self, request: StepRequest) -> bool:
        """Compute the requested step; between steps, carry out commands and publish new results.

        Then wait, and return whether the loop must stop.
        """
        _, stepping, step, time_ns, dt_ns = request
        if stepping and step != self._handled:
            self.step(step, time_ns, dt_ns)
        elif not stepping:
            self._handled = self._writer.cycle = step
            self._stand(time_ns)
            if self.state_requests is not None:
                self.state_requests.serve()
            if self._source.has_changed():
                self._show(step)
        wait_ns = None
        if self.commands.waiting:
            wait_ns = max(0, self._output.next_ns - self._clock.now_ns()) if self._source.prompt else 0
            if not wait_ns:
                self._carry_out()
        return self._clock.wait_ns(wait_ns)

    def step(self, number: int, time_ns: int, dt_ns: int) -> str:
        """Compute a requested step, whose times are in ns; return "", or why the step failed."""
        self._handled = number
        self._stand(time_ns)
        return self._compute(number, time_ns, dt_ns)

    def _stand(self, time_ns: int) -> None:
        """Give all frames and events the time ``time_ns`` of virtual time, until the next call."""
        at_ns = self._writer.at_ns = self._began_ns + time_ns
        self._at = Stamp(at_ns, time_ns, self._began_utc_ns + time_ns)

    def write_now(self) -> None:
        """Carry out the waiting commands. Call this between two steps."""
        if self.commands.waiting:
            self._carry_out()

    # ---- snapshots ---------------------------------------------------------------------------------------------------

    def save(self, name: str) -> bytes:
        """Return the source's state for the snapshot ``name``. Call this between two steps.

        Raises:
            SnapshotError: The state cannot be saved.
            ShmioError: The source's own code failed.

        """
        self.write_now()
        return save_source(
            self._source, self._output, self.commands, name, step=self._handled, computed_ns=self._time_ns
        )

    def check(self, data: bytes) -> None:
        """Check whether a state can be restored, without changing anything.

        Raises:
            SnapshotError: The state is damaged, or does not fit the source.

        """
        PreparedSource(self._source, self._output, self.commands, data)

    def restore(self, data: bytes, name: str) -> None:
        """Restore a state of the snapshot ``name``, and publish it. If this fails, publish a bad frame.

        Raises:
            SnapshotError: The state is damaged, or does not fit the source.
            ShmioError: The source's own code failed.

        """
        state = self._page.read()
        self._handled = self._writer.cycle = state.step
        self._stand(state.time_ns)
        try:
            prepared = PreparedSource(self._source, self._output, self.commands, data)
            saved = prepared.saved
            self._handled = self._writer.cycle = saved.step
            self._stand(saved.time_ns)
            self._time_ns = saved.computed_ns
            prepared.restore(self._writer, name)
        except ShmioError as error:
            self._fail(self._writer.cycle, f"the snapshot {name} was not restored: {error}")
            raise
        self._quality_log.update(saved.quality, saved.reason, saved.step)

    # ---- wall time and virtual time ------------------------------------------------------------------------------

    def _compute(self, cycle: int, time_ns: int, dt_ns: int) -> str:
        """Compute and publish one cycle or step; return why it failed, or ""."""
        self._writer.cycle, self._time_ns = cycle, time_ns
        self._published = False
        self.commands.release(cycle)
        self._carry_out()
        if self._published:
            return ""  # a prompt source published the frame when it was written
        at, counters, doubt = self._at, self.counters, ""
        asked_ns = self._writer.now_ns() if at is None else at.publish_ns
        counters.busy_since_ns = begun_ns = self._clock.now_ns()
        try:
            if self._inputs is not None:
                step, before_ns = (None, None) if at is None else (self._handled, at.publish_ns - dt_ns)
                values, doubt = self._inputs.read(step, before_ns)
                self._source.connect(values, doubt)
            raw = self._source.step(time_ns, dt_ns)
        except ShmioError as error:
            counters.failures += 1
            self._fail(cycle, str(error))
            return str(error) or "it gave no reason"
        finally:
            counters.busy_since_ns = 0
        counters.round_trip_us = (self._clock.now_ns() - begun_ns) // 1000
        self._publish(raw, asked_ns, doubt)
        return ""

    @property
    def _in_virtual_time(self) -> bool:
        return self._at is not None

    def _show(self, cycle: int) -> None:
        """Publish the present image without computing a step."""
        try:
            self._publish(self._source.begin(), self._writer.now_ns())
        except ShmioError as error:
            self._fail(cycle, str(error))

    def _carry_out(self) -> None:
        """Carry out all accepted commands."""
        if self.commands.settle():
            self.commands.carry_out(self._write)

    def _write(self, writes: Sequence[Write]) -> list[str]:
        """Write to the source.

        If the source is ``prompt``, publish a frame before the writes' outcomes.
        """
        refusals = self._source.write(writes)
        if self._source.prompt:
            self._publish(self._source.begin(), self._writer.now_ns())
        return refusals

    def _publish(self, raw: bytes, asked_ns: int, doubt: str = "") -> None:
        quality = _UNCERTAIN if doubt else _GOOD
        cycle, at = self._writer.cycle, self._at
        self._quality_log.update(quality, doubt, cycle)
        source_ns = time.time_ns() if at is None else at.utc_ns  # in virtual time, that of the step
        self._output.publish(Image(raw, cycle, source_ns, quality, _SIMULATED, doubt, asked_ns, None, at))
        self._published = True
        self.counters.polls += 1

    def _fail(self, cycle: int, reason: str) -> None:
        """Publish a bad frame; in wall time, only if the reason is new."""
        new = self._quality_log.update(Quality.BAD, reason, cycle)
        if new or self._in_virtual_time:
            raw, source_ns = self._output.raw, self._output.source_ns
            self._output.publish(Image(raw, cycle, source_ns, Quality.BAD, Provenance.SIMULATED, reason))
