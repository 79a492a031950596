"""Runs the sources of an instance in this process, in virtual time, without a supervisor.

The laboratory uses the same code as an instance: the loop, the commands and the injections of each
source work on a segment that only this process can use. So a recording is the same as that of an
instance with ``clock = "stepped"`` in its configuration.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final, Self, cast

from shmio.campaigns.live import LiveRun
from shmio.campaigns.live import Plan as RunPlan
from shmio.connectors import registry
from shmio.connectors.base import Computed
from shmio.connectors.injections import blocks_of, owner_of
from shmio.connectors.models.stepped import SteppedLoop, connected_inputs
from shmio.connectors.poll_loop import Schedule
from shmio.errors import ConfigError, ShmioError, TimeError
from shmio.judging.source import Rows
from shmio.local.attach import Attachment
from shmio.local.snapshots import Refusals
from shmio.local.time_control import Coordinator, Step
from shmio.model.clock import check_step
from shmio.plan.prepare import prepare
from shmio.plan.processes import Job, Plan
from shmio.recorder.recorder import AttachedFiles, ConfigFiles
from shmio.segment import Segment
from shmio.wording import unknown

COMMANDS_S: Final = 2.0
"""Maximum time in s that :meth:`Laboratory.close` waits for the end of each thread."""


def prepare_laboratory(file: Path) -> Plan:
    """Return a plan for laboratories from a configuration. One plan can serve any number of laboratories.

    Args:
        file: The ``supervisor.toml``. Only its sources and injections are used: emulators, endpoints
            and the recorder are not started.

    Returns:
        The plan, for :class:`Laboratory`.

    Raises:
        ConfigError: The configuration has faults, or a source that cannot be computed in this process.
        LayoutError: A layout cannot be compiled.

    """
    plan = prepare(file, writes_files=False).plan
    if not plan.blocks:
        raise ConfigError(f"{file}: the configuration has no [[source]]")
    for index, job in enumerate(job for job in plan.jobs if job.kind == "source"):
        name = job.config["connector"]
        if name == "remote" or not issubclass(registry.load(name), Computed):
            raise ConfigError(
                f'{file}: source[{index}].connector: source {job.name!r} has connector = "{name}", but a laboratory '
                "has only sources that are computed in its process, such as simulation and memory; "
                "use shmio-campaign run, which runs a whole instance"
            )
    return plan


class Laboratory:
    """An instance in this process, whose time is virtual from the start. Close it after use.

    Its clock starts at 0, and moves only when you step a cell from :meth:`attach`.
    """

    def __init__(self, plan: Plan, parameters: Mapping[str, Mapping[str, object]] | None = None) -> None:
        """Create the instance, and its models.

        Args:
            plan: The plan from :func:`prepare_laboratory`.
            parameters: Parameters of models, by source and name. They override those of the
                configuration.

        Raises:
            ConfigError: A model cannot be created, or a parameter does not exist.
            SegmentError: There is not enough memory.

        """
        self.plan = plan
        self.moving = threading.RLock()
        """Held while a source's loop runs."""
        self.stepping = False
        """True while a step is computed."""
        self._segment = Segment.private(plan.instance, plan.blocks, plan.processes, mode=plan.mode)
        self.page = self._segment.clock
        """The clock page, which the loops read."""
        self._others: list[Segment] = []
        self._threads: list[threading.Thread] = []
        self._sources: dict[str, Computed] = {}
        self.loops: dict[str, SteppedLoop] = {}
        """The loop of each source."""
        try:
            jobs = [job for job in plan.jobs if job.kind == "source"]
            names = [job.name for job in jobs]
            for source in parameters or ():
                if source not in names:
                    raise ConfigError(unknown("source", source, names))
            for job in jobs:
                self.loops[job.name] = self._loop(job, (parameters or {}).get(job.name))
            for loop in self.loops.values():
                loop.begin()
        except BaseException:
            self.close()
            raise

    def _loop(self, job: Job, parameters: Mapping[str, object] | None) -> SteppedLoop:
        """Create a source as its own process would, and start the thread of its commands."""
        segment, section = self._segment, job.config
        options: dict[str, Any] = section["options"]
        if parameters is not None:
            options = options | {"parameters": options.get("parameters", {}) | dict(parameters)}
        made = registry.load(section["connector"])(
            registry.convert_options(section["connector"], options), segment.blocks[job.name].layout
        )
        source = cast("Computed", made)  # prepare_laboratory has checked it
        self._sources[job.name] = source
        writer = segment.writer(job.name)
        clock = _LabClock(self)
        loop = clock.loop = SteppedLoop(
            source,
            writer,
            Schedule(segment.header.started_ns, writer.block.period_ns),
            clock,
            section["writable"],
            allow_nonfinite=section["allow_nonfinite"],
            inputs=connected_inputs(source, writer.block, self.open),
            owner_of=partial(owner_of, segment),
            blocks=partial(blocks_of, segment),
        )
        thread = threading.Thread(target=loop.commands.run, name=f"commands of {job.name}", daemon=True)
        self._threads.append(thread)
        thread.start()
        return loop

    def inputs(self, source: str) -> frozenset[str] | None:
        """Return the paths of the registers that a source's model reads; None if the source has no model."""
        found = self._sources[source]
        return None if found.prompt else frozenset(found.inputs)

    def open(self) -> Segment:
        """Open the segment once more, writable, as another process would; :meth:`close` closes it."""
        segment = self._segment.again()
        self._others.append(segment)
        return segment

    def attach(self, segment: Segment | None = None) -> Attachment:
        """Return a cell that is attached to the laboratory, as :func:`shmio.attach` does for an instance.

        Args:
            segment: The segment to use, from :meth:`open`; None: open the segment once more.

        """
        segment = segment or self.open()
        return Attachment(segment, _LabCoordinator(self, segment), _LabStates(self), lambda: self.plan.snapshot_dir)

    def prepare(self, plan: RunPlan, seen: Callable[[Mapping[str, Rows]], None] = lambda _rows: None) -> LiveRun:
        """Return a run of a campaign that has not begun yet.

        Args:
            plan: The plan of the run.
            seen: Called with the new values of the signals, by source, in the order of time.

        Raises:
            ConfigError: An expectation is invalid.

        """
        attachments: AttachedFiles = ConfigFiles(self.plan.config_file)
        return LiveRun(self.open(), plan, attachments, seen, self.attach)

    def run(self, plan: RunPlan, over: threading.Event | None = None) -> LiveRun:
        """Run a campaign, judge it and record it, as ``shmio-campaign run`` does on an instance.

        Args:
            plan: The plan of the run.
            over: Set this event to end the run; None: the run cannot be ended early.

        Returns:
            The run, with its verdicts; :attr:`LiveRun.problem` has an error after its start.

        Raises:
            ConfigError: An expectation or an injection is invalid, or the plan's ``real_time`` is true.
            CommandError: A source refuses an injection.
            RecordingError: The file of the recording cannot be created.
            SnapshotError: The snapshot cannot be restored.

        """
        work = self.prepare(plan)
        work.run(over or threading.Event())
        return work

    def close(self) -> None:
        """End all sources, and release the memory."""
        for loop in self.loops.values():
            loop.commands.stop()
        for thread in self._threads:
            thread.join(COMMANDS_S)
        for source in self._sources.values():
            source.close()
        for segment in self._others:
            segment.close()
        self._segment.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _LabClock:
    """The clock of a source's loop that does not run by itself: the laboratory calls the loop's methods."""

    loop: SteppedLoop

    def __init__(self, lab: Laboratory) -> None:
        self._lab = lab

    now_ns = staticmethod(time.monotonic_ns)
    """Returns the time of CLOCK_MONOTONIC in ns."""

    def wait_ns(self, duration_ns: int | None) -> bool:  # noqa: ARG002
        """Return True without waiting, because the loop must not run by itself."""
        return True

    def nudge(self) -> None:
        """Carry out accepted commands; if a step is in progress, wait for its end first."""
        with self._lab.moving:
            if not self._lab.stepping:
                self.loop.write_now()


class _LabCoordinator(Coordinator):
    """Moves the time of a laboratory: each step runs the loops of the sources, one after another."""

    def __init__(self, lab: Laboratory, segment: Segment) -> None:
        super().__init__(segment)
        self._lab = lab

    def step(self, dt_ns: int | None = None) -> Step:
        """Compute a step.

        Raises:
            TimeError: A source failed, or another program owns time.
            ValueRangeError: The length is not between 1 us and 1 h.

        """
        return self.steps(dt_ns, 1)

    def steps(self, dt_ns: int | None, count: int) -> Step:
        """Compute ``count`` steps, up to the first one that fails; return the last one.

        Raises:
            TimeError: A source failed, or another program owns time.
            ValueRangeError: The length is not between 1 us and 1 h.

        """
        lab, page = self._lab, self._lab.page
        moving, begin_step, loops = lab.moving, page.begin_step, tuple(lab.loops.items())
        with self._lock:
            if not self.owns:
                self.take_over(steps=True)
            before = page.last_written()
            dt_ns = before.step_size_ns if dt_ns is None else dt_ns
            check_step(dt_ns)
            step, time_ns, done, problem = before.step, before.time_ns, before.done, ""
            end = step + count
            try:
                while step < end and not problem:
                    step, time_ns, problem = step + 1, time_ns + dt_ns, "it was cancelled"
                    with moving:  # between two steps, other threads carry out commands
                        lab.stepping = True
                        try:
                            begin_step(before, step, time_ns, dt_ns, done)
                            problems = []
                            for name, loop in loops:
                                if why := loop.step(step, time_ns, dt_ns):
                                    problems.append(f"{name}: {why}")
                            problem = "; ".join(problems)
                        finally:
                            lab.stepping = False
                    done = done if problem else step
            finally:
                note = f"step {step} failed: {problem}" if problem else ""
                ended = before._replace(step=step, time_ns=time_ns, dt_ns=dt_ns, done=done, stepping=False, note=note)
                page.write(ended, ring=False)
            if problem:
                raise TimeError(f"step {step}: {problem}")
            return Step(step, time_ns, dt_ns)

    def announce(self) -> None:
        """Do nothing, because no other process follows time."""


class _LabStates:
    """The states of a laboratory's sources, for snapshots."""

    def __init__(self, lab: Laboratory) -> None:
        self._lab = lab

    def names(self) -> tuple[list[str], Refusals]:
        """Return the sources; all take part."""
        return list(self._lab.loops), {}

    def save(self, name: str, names: list[str], work: Path) -> tuple[dict[str, bytes], Refusals]:  # noqa: ARG002
        """Return the states of the sources."""
        states: dict[str, bytes] = {}
        return states, self._each(names, lambda one, loop: states.update({one: loop.save(name)}))

    def check(self, name: str, states: Mapping[str, bytes], work: Path) -> Refusals:  # noqa: ARG002
        """Check the states."""
        return self._each(states, lambda one, loop: loop.check(states[one]))

    def restore(self, name: str, states: Mapping[str, bytes], work: Path) -> Refusals:  # noqa: ARG002
        """Restore the states."""
        return self._each(states, lambda one, loop: loop.restore(states[one], name))

    def _each(self, names: Iterable[str], call: Callable[[str, SteppedLoop], object]) -> Refusals:
        refusals: Refusals = {}
        with self._lab.moving:
            for one in names:
                try:
                    call(one, self._lab.loops[one])
                except ShmioError as error:
                    refusals[one] = str(error)
        return refusals
