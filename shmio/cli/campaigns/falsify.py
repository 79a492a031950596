"""``shmio-campaign falsify``: searches a campaign's ranges for values with which an expectation fails."""

from __future__ import annotations

import argparse
import math
import sys
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from shmio.campaigns.digests import of_configuration, of_file, of_layouts
from shmio.cli.campaigns.reports import attempt
from shmio.cli.campaigns.run import configuration_of, duration_of
from shmio.cli.campaigns.verdicts import UNDECIDED
from shmio.cli.common import say, say_json, stop_on_signals
from shmio.config.campaign import Campaign, CampaignFile, campaign_of, read_settings
from shmio.config.ranges import Point, Space
from shmio.config.read import located
from shmio.errors import ConfigError
from shmio.falsification.cases import store, tables_for
from shmio.falsification.falsify import Failure, Falsifier, check_space
from shmio.falsification.journal import Beginning, Journal, Line
from shmio.falsification.pool import Pool
from shmio.falsification.search import MAX_TRIALS, GridSearch, begin_search
from shmio.falsification.trial import Result
from shmio.judging.expectation import faults_of_texts
from shmio.lab import prepare_laboratory
from shmio.local.snapshot_file import file_of
from shmio.plan.processes import Plan
from shmio.version import __version__
from shmio.wording import counted, printable

if TYPE_CHECKING:
    from shmio.fabric.connection import Access
    from shmio.falsification.farm.pool import FarmPool

MAX_JOBS: Final = 64
MAX_FARM_JOBS: Final = 1024
SHOWN_FILES: Final = 10
EACH_S: Final = 0.2
"""Interval in s at which the progress line on a terminal is updated."""
LINES_S: Final = 10.0
"""Interval in s between two progress lines if standard error is not a terminal."""
FAILED = 1


def falsify(arguments: argparse.Namespace) -> int:
    """Search for values with which an expectation fails, simplify and store them, and print the result.

    Raises:
        ConfigError: The campaign or the configuration is invalid.
        MissingLibraryError: The library of the search strategy is not installed.
        RecordingError: A file cannot be written.

    """
    file: Path = arguments.campaign
    if arguments.trials > MAX_TRIALS:
        raise ConfigError(f"--trials {arguments.trials}: at most {MAX_TRIALS} are possible")
    most = MAX_JOBS if arguments.farm is None else MAX_FARM_JOBS
    if arguments.jobs > most:
        raise ConfigError(f"--jobs {arguments.jobs}: at most {most} are possible")
    if arguments.send and arguments.farm is None:
        raise ConfigError("--send: this option is only for --farm")
    access = None
    if arguments.farm is not None:
        from shmio.cli.campaigns.farm import farm_of  # noqa: PLC0415  only with a farm

        access = farm_of(arguments)
    read = CampaignFile(file)
    settings = read_settings(arguments.settings)
    read.refuse(faults_of_texts(read.expect))
    with located(file):
        read.space.check(settings)
        tables = read.space.at(settings)
        check_space(Space(tables))
        known = {key: value for key, value in tables.items() if key not in ("injection", "parameters")}
        campaign = campaign_of(known)
    config = arguments.config or configuration_of(file, campaign)
    if config is None:
        raise ConfigError(f"{file}: name the configuration with -c FILE, or with the key config of the campaign")
    instance = prepare_laboratory(config)
    space = Space(_complete(tables, arguments, campaign, instance))
    output = arguments.output or Path(f"{file.stem}-falsify")
    with stop_on_signals() as over:
        return _Command(arguments, space, config, instance, output, over, access).run()


def _complete(
    tables: Mapping[str, Any], arguments: argparse.Namespace, campaign: Campaign, instance: Plan
) -> dict[str, Any]:
    """Return the tables with all that a run depends on: duration, step, and a seed for each injection."""
    step_ms = arguments.step_ms or campaign.step_ms or min(block.period_ns for block in instance.blocks) / 1e6
    seed = arguments.seed or 0
    found = {**tables, "duration_s": duration_of(arguments, campaign), "step_ms": step_ms}
    if "injection" in tables:
        found["injection"] = [{**table, "seed": table.get("seed", seed)} for table in tables["injection"]]
    return found


class _Command:
    """A search with its output."""

    def __init__(
        self,
        arguments: argparse.Namespace,
        space: Space,
        config: Path,
        instance: Plan,
        output: Path,
        over: threading.Event,
        access: Access | None,
    ) -> None:
        self._access = access
        self._arguments, self._space, self._config, self._over = arguments, space, config, over
        self._instance, self._output = instance, output
        self._cases: list[Line] = []
        self._problems: list[str] = []
        tables = space.at({})
        self._duration_s: float = tables["duration_s"]
        self._step_s: float = tables["step_ms"] / 1000
        self._progress = _Progress(arguments.trials, silent=arguments.json)
        self._farm: FarmPool | None = None

    def run(self) -> int:
        """Search, and return the exit status."""
        arguments = self._arguments
        seed = arguments.seed or 0
        search = begin_search(arguments.search, self._space, seed, arguments.trials, arguments.jobs)
        grid = search.counts if isinstance(search, GridSearch) else None
        beginning = Beginning(
            __version__, arguments.search, seed, arguments.jobs, grid, self._space.at({}), self._duration_s,
            self._space.at({})["step_ms"], self._files(),
        )  # fmt: skip
        trials = min(arguments.trials, math.prod(grid)) if grid else arguments.trials
        with (
            self._pool() as pool,
            Journal(self._output, beginning, resume=arguments.resume) as self._journal,
        ):
            falsifier = Falsifier(
                self._space, search, pool, self._journal, self._over,
                duration_s=self._duration_s, step_s=self._step_s, shrink_runs=arguments.shrink,
            )  # fmt: skip
            self._falsifier, self._tally = falsifier, falsifier.tally
            try:
                if arguments.resume:
                    self._resume(falsifier, trials)
                self._say_beginning(trials)
                if arguments.all or not self._tally.failed:
                    falsifier.run(trials, self._on_trial, self._on_failure, to_end=arguments.all)
            finally:
                self._progress.clear()
        return self._finish()

    def _pool(self) -> Pool | FarmPool:
        """Return what runs the trials: processes of this host, or a farm."""
        arguments, campaign = self._arguments, self._arguments.campaign
        access = self._access
        if access is None:
            return Pool(self._config, campaign.parent, arguments.jobs, arguments.limit)
        from shmio.falsification.farm.bundle import make_bundle  # noqa: PLC0415  only with a farm
        from shmio.falsification.farm.environment import environment_of  # noqa: PLC0415
        from shmio.falsification.farm.pool import FarmPool  # noqa: PLC0415

        bundle = make_bundle(self._config, campaign, self._space.at({}), arguments.send)
        names = [*bundle.sizes]
        shown = ", ".join(names[:SHOWN_FILES]) + (f" and {len(names) - SHOWN_FILES} more" * (len(names) > SHOWN_FILES))
        files, size_bytes = counted(len(names), "file"), sum(bundle.sizes.values())
        self._tell(f"farm {access}: the workers get {files} of {bundle.root}, {size_bytes} bytes: {shown}")
        environment, problem = environment_of(bundle)
        if problem:
            self._tell(f"farm: the models do not start from these files alone; is one missing (--send)? {problem}")
        self._farm = FarmPool(access, bundle, environment, campaign.name, arguments.jobs, arguments.limit, self._tell)
        return self._farm

    @property
    def _workers(self) -> int | None:
        """Number of workers of the farm; None without a farm."""
        return None if self._farm is None else self._farm.workers

    def _tell(self, line: str) -> None:
        """Print a line about the farm."""
        self._progress.clear()
        say(line, sys.stderr)

    def _files(self) -> dict[str, str]:
        """Return the digests of what else the trials depend on."""
        found = [*of_configuration(self._config.resolve())]
        found += of_layouts({block.source: block.layout for block in self._instance.blocks})
        folder, tables = self._arguments.campaign.resolve().parent, self._space.at({})
        if "start" in tables:
            found.append(("snapshot", of_file(file_of(self._instance.snapshot_dir, tables["start"]))))
        for one in tables["expect"]:
            if "like" in one:
                found.append((f"like {one['like']}", of_file(folder / one["like"])))
        return dict(found)

    def _resume(self, falsifier: Falsifier, trials: int) -> None:
        unshrunk, self._cases = falsifier.replay(self._journal.lines(), trials)
        done = f"{counted(self._tally.done, 'trial')} and {counted(len(self._cases), 'case')}"
        say(f"{self._output}: {done} exist already", sys.stderr)
        self._progress.begin(self._tally.done, self._tally.simulated_s)
        for line in unshrunk:
            if line.point is not None and line.result is not None:
                falsifier.shrink(line.point, line.result, self._on_failure)

    def _say_beginning(self, trials: int) -> None:
        arguments = self._arguments
        if arguments.json:
            return
        ranges = ", ".join(one.name for one in self._space.dimensions)
        say(
            f"{arguments.campaign}: {trials} trials of {self._duration_s:g} s, {arguments.search}, "
            f"seed {arguments.seed or 0}, jobs {arguments.jobs}, ranges: {ranges}",
            sys.stderr,
        )
        size = math.prod(math.inf if one.count is None else one.count for one in self._space.dimensions)
        if size < trials:
            say(f"the ranges have only {size:.0f} points: --search grid tries each of them once", sys.stderr)

    def _on_trial(self, _point: Point, _result: Result, best: bool) -> None:
        fault = attempt(
            lambda: self._progress.at(self._falsifier, best=best, workers=self._workers), "the progress is not shown"
        )
        if fault:
            self._progress.stop()
            say(fault, sys.stderr)

    def _on_failure(self, failure: Failure) -> None:
        """Store a shrunk case, unless it is stored already."""
        arguments, folder = self._arguments, self._output
        tables = failure.case.tables(self._space)
        comparable = {key: tables.get(key) for key in ("injection", "parameters")}
        same = next((line.case for line in self._cases if line.shrunk == comparable), None)
        if same is None:
            name = f"case-{len({line.case for line in self._cases}) + 1:03}"
            failed = ", ".join(failure.result.failed)
            origin = f"trial {failure.trial} of shmio-campaign falsify, shrunk by {failure.runs} runs"
            comment = [
                f"A failing case of {arguments.campaign.name}: {origin}.",
                f"Failed: {failed}, robustness {failure.result.robustness:.6g}",
            ]
            concrete = tables_for(tables, arguments.campaign, self._config, folder / name)
            stored = store(folder, name, concrete, failure.result, comment, arguments.limit)
            self._progress.clear()
            if not arguments.json:
                say(f"trial {failure.trial} failed: {failed}: {stored.folder}, contents sha256 {stored.sha256}")
            if stored.problem:
                self._problems.append(f"{stored.folder}: {stored.problem}")
                say(self._problems[-1], sys.stderr)
        else:
            name = same
        line = Line(case=name, trial=failure.trial, shrunk=comparable)
        self._journal.add(line)
        self._cases.append(line)

    def _finish(self) -> int:
        """Print the summary, and return the exit status."""
        tally, arguments = self._tally, self._arguments
        best, unclear = tally.best, tally.unclear
        interrupted = self._over.is_set()
        status = FAILED if tally.failed else UNDECIDED if unclear is not None or interrupted else 0
        folders = [str(self._output / case) for case in dict.fromkeys(line.case for line in self._cases) if case]
        speed, factor = self._progress.speed(self._falsifier)
        if arguments.json:
            say_json({
                "trials": tally.done, "outcomes": tally.counts, "cases": folders, "interrupted": interrupted,
                "best": None if best is None else {
                    "trial": best.number, "robustness": best.robustness, "point": dict(tally.best_point),
                    "expectation": best.worst.name if best.worst else None,
                },
                "unclear": None if unclear is None else {"trial": unclear.number, "reason": _reason(unclear)},
                "trials_per_s": speed, "times_real_time": factor, "folder": str(self._output),
                "problems": self._problems, **({} if self._farm is None else {"workers": self._workers}),
            })  # fmt: skip
            return status
        counts = ", ".join(f"{count} {name}" for name, count in tally.counts.items()) or "none"
        say(f"{tally.done} trials, {speed:.1f}/s, {factor:.0f} times real time: {counts}")
        if best is not None:
            values = ", ".join(f"{name} = {_short(value)}" for name, value in tally.best_point.items())
            of = f" of {best.worst.name}" if best.worst else ""
            say(f"least robustness: {best.robustness:.6g}{of}, trial {best.number}: {values}")
        for folder in folders:
            say(f"repeat it: shmio-campaign run {folder}/campaign.toml --lab")
        if unclear is not None:
            say(f"trial {unclear.number} was {unclear.status}: {_reason(unclear)}", sys.stderr)
        if interrupted:
            say(f"the search was interrupted; continue with --resume (and -o {self._output})", sys.stderr)
        return status


def _reason(result: Result) -> str:
    """Return why a trial has no verdict."""
    if result.reason:
        return result.reason
    return next((f"{one.name}: {one.reason}" for one in result.expectations if str(one.outcome) == "inconclusive"), "")


def _short(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


class _Progress:
    """Shows the progress on standard error: in one line on a terminal, else in a line now and then."""

    def __init__(self, trials: int, *, silent: bool) -> None:
        self._trials, self._silent = trials, silent
        self._terminal = sys.stderr.isatty()
        self._next_s = time.monotonic() + EACH_S
        self._shown = False
        self.begin(0, 0.0)

    def begin(self, done: int, simulated_s: float) -> None:
        """Set what had been done before, and begin to measure the time."""
        self._begun_s, self._before, self._simulated_s = time.monotonic(), done, simulated_s

    def speed(self, falsifier: Falsifier) -> tuple[float, float]:
        """Return trials a second, and how many times as fast as real time they are.

        The time for shrinking does not count.
        """
        tally = falsifier.tally
        taken_s = max(time.monotonic() - self._begun_s - falsifier.shrinking_s, 1e-9)
        return (tally.done - self._before) / taken_s, (tally.simulated_s - self._simulated_s) / taken_s

    def at(self, falsifier: Falsifier, *, best: bool, workers: int | None) -> None:
        """Show the progress, if it is time to. ``workers`` is the number of workers of the farm, if any."""
        now_s = time.monotonic()
        if self._silent or (now_s < self._next_s and (self._terminal or not best)):
            return
        self._next_s = now_s + (EACH_S if self._terminal else LINES_S)
        tally = falsifier.tally
        speed, factor = self.speed(falsifier)
        text = f"{tally.done} of {self._trials} trials, {speed:.1f}/s, {factor:.0f} times real time"
        if tally.best is not None:
            text += f", least robustness {tally.best.robustness:.6g} (trial {tally.best.number})"
        if tally.failed:
            text += f", {tally.failed} failed"
        if workers is not None:
            text += f", {workers} worker" + "s" * (workers != 1)
        if not self._terminal:
            say(text, sys.stderr)
            return
        self._shown = True
        with suppress(OSError):
            sys.stderr.write(f"\r{printable(text)}\x1b[K")
            sys.stderr.flush()

    def stop(self) -> None:
        """Show nothing from now on."""
        self._silent = True

    def clear(self) -> None:
        """Remove the line from a terminal."""
        if self._shown:
            self._shown = False
            with suppress(OSError):
                sys.stderr.write("\r\x1b[K")
                sys.stderr.flush()
