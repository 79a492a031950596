"""A cell that a test runs, judges and records: what the fixture ``cell`` of the pytest plugin yields."""

from __future__ import annotations

import argparse
import os
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from itertools import groupby
from math import ceil
from pathlib import Path
from typing import Any, Final

from shmio import control
from shmio.campaigns.live import BUFFER_BYTES, GOOD_S, LOOK_S, MAX_STEPS, frames_of
from shmio.cli.campaigns.reports import Reports
from shmio.cli.campaigns.verdicts import lines
from shmio.cli.instance.control import stop
from shmio.cli.instance.detach import start
from shmio.cli.instance.emulator import disturb
from shmio.config import Expectation
from shmio.config.campaign import Campaign as CampaignFile
from shmio.config.campaign import parse_campaign
from shmio.config.declaration import shifted
from shmio.config.expectation import expectation_faults
from shmio.config.read import convert
from shmio.errors import ConfigError, NotRunningError, RecordingError, ShmioError
from shmio.judging.judge import Judge
from shmio.judging.report import fault_of
from shmio.judging.verdict import Outcome
from shmio.layout.model import NUMBERS
from shmio.layout.values.codec import Value
from shmio.local.attach import Attachment
from shmio.local.injection import Campaign
from shmio.model.values import Outcome as WriteOutcome
from shmio.recorder.file_output import Output
from shmio.recorder.instance_follower import InstanceEntry, InstanceFollower, StartPositions
from shmio.recorder.recorder import CLOSE_S, ConfigFiles, Recorder
from shmio.recording.injection_times import InjectionTimes
from shmio.segment import Block, Event, Frame, Quality, Segment, running_instances
from shmio.segment.block import Layouts
from shmio.testing.own_configuration import LOGS, OwnConfiguration

BY: Final = "pytest"
RECORDING: Final = "recording.mem"
REPORT: Final = "report.html"
MAX_PLOTS: Final = 32
"""Maximum number of registers that the report of a failed test plots besides those of expectations."""


class CellUnderTest:
    """A running instance of a test.

    Besides the methods here, ``cell.attachment`` has all that :func:`shmio.attach` offers.
    """

    def __init__(self, segment: Segment, configuration: OwnConfiguration, title: str, cleanup: ExitStack) -> None:
        self.folder = configuration.file.parent
        """The instance's own folder, with its logs and its recording."""
        self.virtual = configuration.virtual
        """True if time is virtual: only :meth:`run_for` advances it."""
        self._segment, self._title = segment, title
        self.attachment = cleanup.enter_context(Attachment(segment))
        """The instance, as :func:`shmio.attach` returns it."""
        self._cleanup = cleanup
        self._await_good()
        self._tap = InstanceFollower(segment, StartPositions(first=False))
        self._recording = ExitStack()
        cleanup.callback(self._recording.close)
        self._recorder = self._recording.enter_context(_recording(self._tap, self.folder, configuration.file))
        self._last: dict[int, tuple[Block, Frame]] = {}
        for block in segment.blocks.values():
            if (frame := block.latest()) is not None:
                self._last[block.section] = (block, frame)
        self._frames: list[tuple[Block, Frame]] = list(self._last.values())
        self._begin = 0  # index of the first frame of the last run
        self._injections = InjectionTimes()
        self._expected = 0
        self._unmet: tuple[Expectation, int] | None = None  # the failed expectation, and its first frame
        self._touched: dict[str, None] = {}
        self._never = threading.Event()

    # -- values ----------------------------------------------------------------------------------------------------

    def __getitem__(self, path: str) -> Value:
        """Return the value of a register, as consumers see it.

        Raises:
            PathError: There is no such register.
            QualityError: The value is bad.

        """
        self._touched[path] = None
        return self.attachment[path]

    def write(self, values: Mapping[str, object]) -> list[WriteOutcome]:
        """Write registers, and return when the outcomes are known.

        Raises:
            CommandError: The source refuses a value.

        """
        self._touched |= dict.fromkeys(values)
        return self.attachment.write(values)

    def inject(self, target: str | Sequence[str], operation: str = "set", **keys: Any) -> Campaign:
        """Inject values until the end of the test, unless the keys end the injection earlier.

        Args:
            target: The register, or several.
            operation: The operation of an ``[[injection]]``.
            keys: The other keys of the ``[[injection]]``, such as ``value``, ``for_s`` or ``when``.
                Times count from now.

        Returns:
            The injection, which a ``with`` statement lifts at the end of its block.

        Raises:
            ConfigError: A key is wrong.
            CommandError: The source refuses the injection.

        """
        name = keys.pop("name", f"injection-{len(self._injections.spans) + 1}")
        table = {"name": name, "target": target if isinstance(target, str) else list(target), "operation": operation}
        declared = parse_campaign({"injection": [table | keys]})
        now_s = self.attachment.clock.present_ns / 1e9
        return self.attachment.declare([shifted(one, now_s) for one in declared])

    def disturb(self, emulator: str, answers: control.Answers, delay_ms: float = 0.0) -> None:
        """Change how an emulator with ``faults = true`` answers: ok, delay, corrupt, hang or refuse.

        Args:
            emulator: Name of the emulator.
            answers: How it answers from now on; ``ok`` ends all faults.
            delay_ms: For ``delay``, the delay of each answer, in ms.

        Raises:
            ControlError: There is no such emulator, or it cannot have faults.

        """
        disturb(self._segment, emulator, answers, delay_ms)

    # -- time and expectations -------------------------------------------------------------------------------------

    def run_for(self, duration_s: float, step_s: float | None = None) -> None:
        """Let the cell run for a time, which the next calls of :meth:`expect` judge.

        Args:
            duration_s: Duration on the instance's clock, in s.
            step_s: Length of a step of virtual time; default: the shortest period of the sources.

        Raises:
            TimeError: A step failed.
            NotRunningError: The instance has stopped.

        """
        self._take()
        self._begin = len(self._frames)
        self._frames += self._last.values()  # so that a change in the first frame is seen
        if self.virtual:
            blocks = self._segment.blocks.values()
            step_s = step_s or min(block.period_ns for block in blocks) / 1e9
            room = min(block.ring.slot_count for block in blocks) // 4
            left = ceil(duration_s / step_s - 1e-9)
            while left > 0:
                count = max(1, min(left, MAX_STEPS, room))
                self.attachment.step(step_s, count)
                left -= count
                self._take()
            return
        until_s = time.monotonic() + duration_s
        while (rest_s := until_s - time.monotonic()) > 0:
            self._never.wait(min(self._tap.pause_s, rest_s))
            if not self._segment.shared.current():
                raise NotRunningError(
                    f"instance {self._segment.instance!r} has stopped; its logs: {self.folder / LOGS}"
                )
            self._take()

    def expect(self, formula: str | None = None, *, since_start: bool = False, **keys: Any) -> None:
        """Fail the test unless the cell met an expectation during the last :meth:`run_for`.

        Args:
            formula: A formula of signal temporal logic. Its times count from the start of the last
                :meth:`run_for`.
            since_start: True to judge all frames since the start of the test, and not only the last
                run.
            keys: In place of a formula, the keys of another form of ``[[expect]]``, such as
                ``never``, or ``when``, ``within_s`` and ``then``.

        Raises:
            AssertionError: The expectation failed, or the run does not decide it.
            ConfigError: The expectation is invalid.

        """
        __tracebackhide__ = True
        table = {"name": f"expectation-{self._expected + 1}"} | keys
        expectation = _expectation(table if formula is None else table | {"formula": formula})
        begin = 0 if since_start else self._begin
        (verdict,) = self._judged([expectation], begin).verdicts
        self._expected += 1
        if verdict.outcome is not Outcome.PASSED:
            self._unmet = expectation, begin
            what = "\n".join(lines(verdict))
            raise AssertionError(f"{formula or ' '.join(f'{key} = {value!r}' for key, value in keys.items())}\n{what}")

    # -- evidence --------------------------------------------------------------------------------------------------

    def keep(self) -> str:
        """End the recording, write a report with plots, and return a text with the paths of both."""
        found = []
        for what, file, write in (
            ("recording", RECORDING, self._close_recording),
            ("plots", REPORT, self._report),
        ):
            path = self.folder / file
            try:
                warnings = write(path)
            except Exception as error:  # noqa: BLE001  evidence may not change the test's result
                warnings = [str(error) if isinstance(error, ShmioError) else fault_of(error)]
            found += [f"not complete: {warning}" for warning in warnings]
            if path.exists():
                found.append(f"{f'{what}:':<10} {path}")
        return "\n".join([*found, f"logs:      {self.folder / LOGS}"])

    def _close_recording(self, _file: Path) -> list[str]:
        try:
            self._take()
        finally:
            self._recording.close()
        return []

    def _report(self, file: Path) -> list[str]:
        shown, begin = ([self._unmet[0]], self._unmet[1]) if self._unmet is not None else ([], 0)
        for path in list(self._touched)[:MAX_PLOTS]:
            block, register = self.attachment.resolve(path)
            name = f"{block.source}/{register.path}"
            if not register.dims and (register.type in NUMBERS or register.type == "BOOL"):
                text = f"always({name} or not {name})" if register.type == "BOOL" else f"always({name} = {name})"
                shown.append(_expectation({"name": f"signal-{len(shown) + 1}", "formula": text, "text": name}))
        reports = Reports(argparse.Namespace(report=file, junit=None))
        judge = self._judged(shown, begin, reports)
        facts = [("instance", self._segment.instance), ("recording", str(self.folder / RECORDING))]
        return reports.write(judge, self._title, facts, f"pytest {self._title}", self._injections.spans)

    def _judged(self, expectations: Sequence[Expectation], begin: int, reports: Reports | None = None) -> Judge:
        blocks = self._segment.blocks
        stale_ns = {source: block.stale_ns for source, block in blocks.items()}
        judge = Judge(expectations, Layouts(blocks), stale_ns)
        seen = (reports or Reports(argparse.Namespace(report=None, junit=None))).collector(lambda: judge)
        for source in judge.sources:
            frames = [(block, frame) for block, frame in self._frames[begin:] if block.source == source]
            for _, some in groupby(frames, lambda pair: pair[0].section):
                found = list(some)
                block = found[0][0]
                # Each run repeats the last frame before it: remove such duplicates.
                own = list({frame.number: frame for _, frame in found}.values())
                judge.follow(source, block.layout, block.stale_ns)
                judge.add(source, frames_of(own, block.layout.size, raws=judge.needs_raw(source)))
        seen(judge.turn())
        seen(judge.finish())
        return judge

    def _take(self) -> None:
        """Record the new entries, and store their frames."""
        more = True
        while more:
            entries, more = self._tap.take()
            self._recorder.put(entries)
            for entry in entries:
                if isinstance(entry, InstanceEntry):
                    continue
                block = entry.follower.block
                if isinstance(entry.item, Event):
                    self._injections.follow(block.source, entry.item)
                elif isinstance(entry.item, Frame):
                    self._last[block.section] = block, entry.item
                    self._frames.append((block, entry.item))

    def _await_good(self) -> None:
        """Wait until all sources are good, at most ``GOOD_S``: a test may be about a bad source."""
        until_s, never = time.monotonic() + GOOD_S, threading.Event()
        while time.monotonic() < until_s and not never.wait(LOOK_S):
            frames = [(block, block.latest()) for block in self._segment.blocks.values()]
            if all(frame is not None and block.assess(frame)[0] is not Quality.BAD for block, frame in frames):
                return


@contextmanager
def running_cell(file: Path, folder: Path, title: str, *, real_time: bool = False) -> Iterator[CellUnderTest]:
    """Run a separate instance of a configuration during a ``with`` block.

    Args:
        file: The configuration.
        folder: An empty folder for the instance.
        title: Title of the report.
        real_time: True to run in real time even if virtual time is possible.

    Raises:
        ConfigError: The configuration is wrong.
        ControlError: The instance does not start.

    """
    with ExitStack() as cleanup:
        configuration = OwnConfiguration(file, folder, cleanup, real_time=real_time)
        start(configuration.file, "live")
        segment = cleanup.enter_context(Segment.open(configuration.name, writable=True))
        cleanup.callback(_stop, configuration.name)
        yield CellUnderTest(segment, configuration, title, cleanup)


def _stop(instance: str) -> None:
    if instance not in running_instances():  # the test has stopped it
        return
    with Segment.open(instance) as segment:
        supervisor = segment.supervisor[0]
        stop(segment)
    with suppress(ChildProcessError):
        os.waitpid(supervisor, 0)  # start() does not wait for it


@contextmanager
def _recording(tap: InstanceFollower, folder: Path, configuration: Path) -> Iterator[Recorder]:
    file = folder / RECORDING
    output = Output(
        file, os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600), limit_bytes=BUFFER_BYTES
    )
    recorder = Recorder(tap, output, by=BY, attachments=ConfigFiles(configuration))
    try:
        yield recorder
    finally:
        recorder.end()
        closed = output.close(CLOSE_S)
    if not closed:
        raise RecordingError(f"{file}: {output.problem or 'it is not complete yet'}")


def _expectation(table: Mapping[str, Any]) -> Expectation:
    (expectation,) = convert({"expect": [dict(table)]}, CampaignFile).expect
    for fault in expectation_faults([expectation]):
        raise ConfigError(fault)
    return expectation
