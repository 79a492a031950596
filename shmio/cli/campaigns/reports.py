"""Writes the reports of a judged campaign."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from shmio.config import Declaration
from shmio.config.folder import unwritable
from shmio.errors import ConfigError
from shmio.files import replace_file
from shmio.judging.judge import Judge
from shmio.judging.report import Drawn, Report, Span, fault_of, html, junit
from shmio.judging.source import Rows, Signal
from shmio.judging.trace import Traces

MAX_PLOTS: Final = 500
"""Maximum number of plots in a report; further plots are left out."""


def check_place(option: str, file: Path | None) -> None:
    """Check that the file of an option can be written, before the work whose result it gets.

    Raises:
        ConfigError: Its folder cannot be written or created, or there is a folder in the file's place.

    """
    if file is None:
        return
    try:
        if file.is_dir():
            raise ConfigError(f"{option} {file}: this is a folder; name a file")
        if file.exists() and not file.is_file():  # a device or a pipe
            return
        folder = file.resolve().parent
    except OSError as error:
        raise ConfigError(f"{option} {file}: {error.strerror}; name another file") from None
    if obstacle := unwritable(folder):
        raise ConfigError(f"{option} {file}: {obstacle.reason}")


def attempt(show: Callable[[], object], what: str) -> str:
    """Call a function that only shows a verdict. Return why it failed, which must not cost the verdict, or ""."""
    try:
        show()
    except Exception as error:  # noqa: BLE001  whatever is wrong with the display
        return f"{what}: {fault_of(error)}"
    return ""


class Reports:
    """The reports that the command line asks for. They collect signals only if a report has plots."""

    def __init__(self, arguments: argparse.Namespace) -> None:
        """Create the reports. ``arguments.report`` and ``arguments.junit`` are the files to write, or None."""
        self._html: Path | None = arguments.report
        self._junit: Path | None = arguments.junit
        self._traces: Traces | None = None
        self._no_plots = ""

    def check(self) -> None:
        """Check, before the run, that the files can be written.

        Raises:
            ConfigError: One of the files cannot be written.

        """
        check_place("--report", self._html)
        check_place("--junit", self._junit)

    def collector(self, judge: Callable[[], Judge]) -> Callable[[Mapping[str, Rows]], None]:
        """Return a function that collects the signals' new values for the plots.

        Args:
            judge: Returns the judge. The first call of the returned function calls it.
        """
        if self._html is None:
            return lambda _rows: None

        def collect(rows: Mapping[str, Rows]) -> None:
            if self._traces is None:
                found = judge()
                signals = {source: found.signals(source) for source in found.sources}
                self._traces = Traces(signals, {one for _, one in _plotted(found)})
            self._traces.add(rows)

        def seen(rows: Mapping[str, Rows]) -> None:
            if not self._no_plots:
                self._no_plots = attempt(lambda: collect(rows), "it has no plots")

        return seen

    def write(
        self,
        judge: Judge,
        title: str,
        facts: Sequence[tuple[str, str]],
        command: str,
        injections: Sequence[Span],
        declared: Sequence[Declaration] = (),
    ) -> list[str]:
        """Write the reports that the command line asks for, each on its own, whatever is wrong with another.

        Args:
            judge: The judge, after the end of the run.
            title: The heading.
            facts: Names and values to show, such as the seed and digests.
            command: The command line that repeats the run.
            injections: When injections were active.
            declared: The injections of the campaign, with their seeds.

        Returns:
            Warnings: what the reports lack, or why a file could not be written. They begin with the
            option and the file.

        """
        warnings: list[str] = []
        report = Report(
            title, facts, command, judge.begin_ns, judge.end_ns or 1, judge.verdicts, [[] for _ in judge.verdicts],
            injections, declared,
        )  # fmt: skip

        def write_html(file: Path) -> None:
            def warn(text: str) -> None:
                warnings.append(f"--report {file}: {text}")

            drawn: list[list[Drawn]] = [[] for _ in report.verdicts]
            fault = self._no_plots or attempt(lambda: self._draw(judge, drawn), "it has no plots")
            if fault:
                warn(fault)
            page = html(replace(report, signals=drawn), warn)
            _write(file, page.encode("utf-8", "replace"))

        for option, file, write in (
            ("--report", self._html, write_html),
            ("--junit", self._junit, lambda file: _write(file, junit(report))),
        ):
            if file is None:
                continue
            try:
                write(file)
            except OSError as error:
                warnings.append(f"{option} {file}: it cannot be written: {error.strerror}")
            except Exception as error:  # noqa: BLE001  a report may cost no verdict
                warnings.append(f"{option} {file}: it cannot be made: {fault_of(error)}")
        return warnings

    def _draw(self, judge: Judge, drawn: list[list[Drawn]]) -> None:
        """Add the plots of the signals that each expectation reads."""
        if self._traces is None:
            return
        for index, one in _plotted(judge):
            plot, limits = self._traces.plot(one), judge.limits(index, one)
            drawn[index].append(Drawn(one, plot, judge.troubles(one.source), limits))


def _plotted(judge: Judge) -> list[tuple[int, Signal]]:
    """Return the plots of a report: pairs of an expectation's index and a signal that it reads."""
    return [(index, one) for index in range(len(judge.verdicts)) for one in judge.read_by(index)][:MAX_PLOTS]


def _write(file: Path, data: bytes) -> None:
    """Write a file, in a new folder if need be. An older file is replaced only by a complete one."""
    file.resolve().parent.mkdir(parents=True, exist_ok=True)
    if file.exists() and not file.is_file():  # a device or a pipe
        file.write_bytes(data)
    else:
        replace_file(file.resolve(), data, private=False)
