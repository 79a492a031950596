"""Finds the tests that notice a fault. It runs them in forks, or in new processes."""

from __future__ import annotations

import ctypes
import os
import re
import select
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import pytest

from tests.mutants.functions import Change, change, watch
from tests.mutants.mutations import Mutant

MEMORY_BYTES: Final = 2 << 30
"""Maximum memory of a test process. A fault that needs more counts as caught."""
LOOK_S: Final = 0.2
SLOWEST_S: Final = 20.0
"""Minimum time-out of a test; the time-out is at least ten times its duration without a fault."""
PR_SET_PDEATHSIG: Final = 1
NATIVE: Final = "tests/native/"
"""Tests whose child processes run only C."""
STARTS: Final = {"subprocess.Popen", "os.posix_spawn", "os.fork", "os.exec"}


@dataclass
class Known:
    """What a run without a fault showed about one test."""

    took_s: float = 0.0
    passed: bool = True
    starts_processes: bool = False
    calls: set[tuple[str, int]] = field(default_factory=set)
    """File and first line of each function of the core that the test called."""


@dataclass(frozen=True)
class Verdict:
    """The result for one mutant. ``caught_by``: the test that failed twice, or empty."""

    mutant: Mutant
    caught_by: str
    tests: int
    took_s: float


class Judge:
    """Runs the tests on one mutant at a time, in the copy of the project in the current folder."""

    def __init__(self, limit_s: float) -> None:
        self._tree = Path.cwd()
        self._limit_s = limit_s
        self._items: dict[str, pytest.Item] = {}
        self._known: dict[str, Known] = {}

    def learn(self, items: Sequence[pytest.Item], sources: Iterable[Path]) -> list[str]:
        """Run all tests once without a fault. Return those that fail, which are then left out."""
        self._items = {item.nodeid: item for item in items}
        files = [self._tree / source for source in sources if source.suffix == ".py"]
        log = self._forked(list(self._items), lambda: None, 3600.0, files)
        for name in self._items:
            self._known[name] = Known(passed=False)
        name = ""
        for line in log:
            kind, _, rest = line.partition(" ")
            if kind == "begin":
                name = rest
                self._known[name] = Known()
            elif kind == "call":
                file, _, first = rest.rpartition(":")
                self._known[name].calls.add((file, int(first)))
            elif kind == "starts":
                self._known[name].starts_processes = True
            elif kind == "fail":
                self._known[name].passed = False
            elif kind == "took":
                self._known[name].took_s = float(rest)
        return [name for name, known in self._known.items() if not known.passed]

    def judge(self, mutant: Mutant) -> Verdict | None:
        """Run the tests on a mutant. None: it does not compile."""
        begun_s = time.monotonic()
        broken, whole = self._tree / mutant.path, self._tree / "whole"
        shutil.copy2(broken, whole)
        broken.write_text(mutant.source)
        try:
            if mutant.path.suffix != ".py" and not self._build():
                return None  # the extension was not replaced
            changed = None
            if mutant.path.suffix == ".py":
                changed = change(whole.read_text(), mutant.source, broken)
            names, run = self._plan(changed, broken)
            suspect = self._first_failure(run(names, self._limit_s))
            caught = suspect if suspect and self._first_failure(run([suspect], self._limit_s)) else ""
            if suspect and not caught:  # it may have failed by chance, so the other tests decide
                names = names[names.index(suspect) + 1 :]
                suspect = self._first_failure(run(names, self._limit_s))
                caught = suspect if suspect and self._first_failure(run([suspect], self._limit_s)) else ""
        finally:
            shutil.copy2(whole, broken)
            if mutant.path.suffix != ".py":
                self._restore_build()
        return Verdict(mutant, caught, len(names), time.monotonic() - begun_s)

    def _plan(self, changed: Change | None, broken: Path) -> tuple[list[str], Callable[[list[str], float], list[str]]]:
        """Return the tests to run, and the function that runs them.

        The tests of the changed module come first, then the fastest.
        """

        def turn(name: str) -> tuple[bool, float]:
            return Path(name.partition("::")[0]).stem != f"test_{broken.stem}", self._known[name].took_s

        usable = sorted((name for name in self._known if self._known[name].passed), key=turn)
        python = [name for name in usable if not name.startswith(NATIVE)]
        if changed is None:
            return python if broken.suffix == ".py" else usable, self._anew
        lines = changed.lines
        covering = [
            name
            for name in usable
            if any(file == str(broken) and first in lines for file, first in self._known[name].calls)
        ]
        if not covering:  # called only while a module is imported, or in other processes
            return python, self._anew
        beyond = [name for name in python if self._known[name].starts_processes and name not in covering]

        def run(names: list[str], limit_s: float) -> list[str]:
            def apply() -> None:
                if not changed.apply(broken):
                    raise RuntimeError(f"{changed.old.co_qualname} of {broken} is not loaded")

            return self._forked(names, apply, limit_s, ())

        return covering + beyond, run

    @staticmethod
    def _first_failure(log: Iterable[str]) -> str:
        """Return the first test that failed or did not end. An empty result means that all passed."""
        begun = ""
        for line in log:
            kind, _, name = line.partition(" ")
            if kind == "begin":
                begun = name
            elif kind == "fail":
                return name
            elif kind == "end":
                return ""
        return begun

    # -- in a fork -----------------------------------------------------------------------------------------------------

    def _forked(self, names: list[str], apply: Callable[[], None], limit_s: float, traced: Sequence[Path]) -> list[str]:
        log = self._tree / "log"
        log.write_text("")
        pid = os.fork()
        if pid == 0:
            status = 1
            try:
                apply()
                self._run(names, log, traced)
                status = 0
            except BaseException as error:  # noqa: BLE001 - the parent reports it
                with log.open("a") as lines:
                    lines.write(f"broken {error!r}\n")
            finally:
                os._exit(status)
        _wait(pid, limit_s)
        _end_all()
        told = log.read_text().splitlines()
        if broken := [line for line in told if line.startswith("broken ")]:
            raise RuntimeError(broken[0])
        return told

    def _run(self, names: list[str], log: Path, traced: Sequence[Path]) -> None:
        """Run the tests in the child until one fails.

        With ``traced`` files, run all tests, and log their calls to functions of these files.
        """
        os.setsid()
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
        items = [self._items[name] for name in names]
        with log.open("a", buffering=1) as lines:
            plugins = items[0].config.pluginmanager if items else None
            if plugins is not None:
                plugins.unregister(plugins.get_plugin("terminalreporter"))
            told = _Told(lines.write)
            called = watch(traced) if traced else set()
            if traced:
                sys.addaudithook(told.audit)
            for number, item in enumerate(items):
                following = items[number + 1] if number + 1 < len(items) else None
                took_s = self._known[item.nodeid].took_s if self._known else SLOWEST_S
                item.add_marker(pytest.mark.timeout(max(SLOWEST_S, 10 * took_s)), append=False)
                told.begin(item.nodeid)
                if number == 0:
                    item.config.pluginmanager.register(told)
                begun_s = time.monotonic()
                item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
                lines.write(f"took {time.monotonic() - begun_s:.3f}\n")
                lines.writelines(f"call {file}:{first}\n" for file, first in tuple(called))
                called.clear()
                told.flush()
                if told.failed and not traced:
                    return
            lines.write("end\n")

    # -- in a new process ----------------------------------------------------------------------------------------------

    def _anew(self, names: list[str], limit_s: float) -> list[str]:
        """Run the tests in a new process, for faults in C or in code that runs at import."""
        arguments = self._tree / "names"
        arguments.write_text("\n".join(names))
        command = [sys.executable, "-m", "pytest", "-x", "-v", "--tb=no", "-p", "no:cacheprovider", "--numprocesses=0"]
        command += [
            f"--timeout={max(SLOWEST_S, *(10 * self._known[name].took_s for name in names)):g}",
            f"--basetemp={self._tree / 'anew'}",
            f"@{arguments}",
        ]
        popen = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
        )
        timer = threading.Timer(limit_s, popen.kill)
        timer.start()
        output = popen.communicate()[0]
        timer.cancel()
        timer.join()
        _end_all()
        log = []
        for line in output.splitlines():
            if match := re.match(r"(tests/\S+::.*?) (PASSED|FAILED|ERROR|SKIPPED)?(\s|$)", line):
                log.append(f"begin {match[1]}")
                if match[2] in {"FAILED", "ERROR"}:
                    log.append(f"fail {match[1]}")
        if popen.returncode == 0:
            log.append("end")
        elif not log:
            log.append(f"begin {names[0]}")  # collecting failed
        return log

    # -- the C extension -----------------------------------------------------------------------------------------------

    def _build(self) -> bool:
        command = [
            sys.executable,
            "setup.py",
            "-q",
            "build_ext",
            "--force",
            "--build-temp",
            "temp",
            "--build-lib",
            "lib",
        ]
        if subprocess.run(command, capture_output=True, check=False).returncode:
            return False
        for built in (self._tree / "lib").rglob("*.so"):
            place = built.relative_to(self._tree / "lib")
            whole = self._tree / "built" / place
            whole.parent.mkdir(parents=True, exist_ok=True)
            (self._tree / place).replace(whole)
            built.replace(self._tree / place)
        return True

    def _restore_build(self) -> None:
        for built in list((self._tree / "built").rglob("*.so")):
            built.replace(self._tree / built.relative_to(self._tree / "built"))


class _Told:
    """A pytest plugin that logs which test fails, and whether it starts processes."""

    def __init__(self, write: Callable[[str], object]) -> None:
        self._write = write
        self._name = ""
        self.failed = False
        self._starts = False

    def begin(self, name: str) -> None:
        self._name = name
        self._write(f"begin {name}\n")

    def audit(self, event: str, _arguments: object) -> None:
        """Handle an audit event of the interpreter: note whether the test starts a process."""
        self._starts |= event in STARTS

    def flush(self) -> None:
        """Write what is known to the log at the end of a test."""
        if self._starts:
            self._starts = False
            self._write("starts\n")

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Log a failed phase of a test."""
        if report.failed:
            self.failed = True
            self._write(f"fail {self._name}\n")


def _wait(pid: int, limit_s: float) -> None:
    """Wait for a process; kill it if it exceeds its time or memory."""
    until_s = time.monotonic() + limit_s
    descriptor = os.pidfd_open(pid)
    try:
        while not select.select([descriptor], [], [], LOOK_S)[0]:
            resident = int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
            if time.monotonic() > until_s or resident > MEMORY_BYTES:
                signal.pidfd_send_signal(descriptor, signal.SIGKILL)
                break
    finally:
        os.close(descriptor)
    os.waitpid(pid, 0)


def _end_all() -> None:
    """Kill the processes that a test left running. As orphans they are children of this process."""
    while True:
        found = [int(pid) for path in Path("/proc/self/task").glob("*/children") for pid in path.read_text().split()]
        if not found:
            break
        for pid in found:
            try:
                os.kill(pid, signal.SIGKILL)
                os.waitpid(pid, 0)
            except (ProcessLookupError, ChildProcessError):
                continue
