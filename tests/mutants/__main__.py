"""Breaks lines of the core at random, one at a time, and reports the faults that no test notices.

It works on a copy of the project. One process collects the tests there and forks for each fault, because importing
the modules for each fault would take too long. Faults in C, and in code that runs while a module is imported, need a
new process each. A fault counts as caught only if a test fails twice with it.
"""

from __future__ import annotations

import argparse
import ctypes
import os
import random
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import pytest

from tests.mutants.groups import GROUPS, expand
from tests.mutants.judging import Judge, Verdict
from tests.mutants.mutations import Mutant, mutants

PROJECT: Final = Path(__file__).parents[2]
EQUIVALENT: Final = "tests/mutants/equivalent.toml"
PR_SET_CHILD_SUBREAPER: Final = 36


def main() -> int:
    """Run the script; return 1 if an unexplained fault survived."""
    parser = argparse.ArgumentParser(prog="scripts/mutate", description=__doc__)
    parser.add_argument("--group", choices=GROUPS, action="append", help="default: all, one after the other")
    parser.add_argument("--count", type=int, default=25, help="faults for each group (default: 25)")
    parser.add_argument("--seed", type=int, default=1, help="determines which faults are made (default: 1)")
    parser.add_argument("--limit-s", type=float, default=300.0, help="time limit for the tests of one fault")
    parser.add_argument(
        "--only", metavar="TEXT", help="all faults whose FILE:LINE begins with this, instead of random ones"
    )
    parser.add_argument("--tests", nargs="+", metavar="PATH", help="run only these of the group's tests, to save time")
    parser.add_argument("--list", action="store_true", help="print the faults, run nothing")
    parser.add_argument("--here", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.list:
        for group in options.group or GROUPS:
            for mutant in _drawn(PROJECT, group, options):
                sys.stdout.write(f"{group}: {mutant.title}\n")
        return 0
    if not options.here:
        return max(_in_a_copy(group, options) for group in options.group or list(GROUPS))
    (group,) = options.group
    session = _Session(group, options)
    tests = options.tests or [str(path.relative_to(Path.cwd())) for path in expand(Path.cwd(), GROUPS[group].tests)]
    arguments = ["-q", "-q", "-p", "no:cacheprovider", "--numprocesses=0", f"--basetemp={Path.cwd() / 'forked'}"]
    pytest.main([*arguments, *tests], plugins=[session])
    return session.status


def _in_a_copy(group: str, options: argparse.Namespace) -> int:
    """Break one group in a copy of the project, which processes started by tests also import."""
    with tempfile.TemporaryDirectory(prefix="shmio-mutants-") as folder:
        tree = Path(folder)
        for name in ("shmio", "tests", "examples", "docs", "proto"):
            shutil.copytree(PROJECT / name, tree / name, symlinks=True, ignore=shutil.ignore_patterns("node_modules"))
        for name in (
            "pyproject.toml",
            "setup.py",
            "README.md",
            "MANIFEST.in",
            "LICENSE",
            "supervisor.toml",
            "db201.db",
        ):
            if (PROJECT / name).exists():
                shutil.copy2(PROJECT / name, tree / name)
        command = [sys.executable, "-m", "tests.mutants", "--group", group, "--count", str(options.count)]
        command += ["--seed", str(options.seed), "--limit-s", str(options.limit_s), "--here"]
        if options.only:
            command += ["--only", options.only]
        if options.tests:
            command += ["--tests", *options.tests]
        environment = os.environ | {"PYTHONPATH": folder, "PYTHONDONTWRITEBYTECODE": "1"}
        return subprocess.run(command, cwd=folder, env=environment, check=False).returncode


def _drawn(root: Path, group: str, options: argparse.Namespace) -> list[Mutant]:
    """Return a random fault of each line, in random order. With ``--only``, return all faults of those lines."""
    lines: dict[tuple[Path, int], list[Mutant]] = defaultdict(list)
    for path in expand(root, GROUPS[group].sources):
        for mutant in mutants(root, path.relative_to(root)):
            lines[mutant.path, mutant.line].append(mutant)
    if options.only:
        return [
            m
            for (path, line), found in sorted(lines.items())
            for m in found
            if f"{path}:{line}".startswith(options.only)
        ]
    chance = random.Random(options.seed)
    places = sorted(lines)
    chance.shuffle(places)
    return [chance.choice(lines[place]) for place in places]


class _Session:
    """A pytest plugin that tests mutants instead of running the tests once."""

    def __init__(self, group: str, options: argparse.Namespace) -> None:
        self._group = group
        self._options = options
        self.status = 2

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Test the mutants, after pytest has collected the tests."""
        if session.testsfailed:
            return False
        ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)  # adopt the orphans of tests
        capture: Any = session.config.pluginmanager.get_plugin("capturemanager")
        with capture.global_and_fixture_disabled():
            self.status = self._judge(session.items)
        return True

    def _judge(self, items: Sequence[pytest.Item]) -> int:
        options, root = self._options, Path.cwd()
        judge = Judge(options.limit_s)
        sources = [path.relative_to(root) for path in expand(root, GROUPS[self._group].sources)]
        _say(f"{self._group}: {len(items)} tests without a fault ...")
        for name in judge.learn(items, sources):
            _say(f"  left out, because it fails without a fault: {name}")
        drawn = _drawn(root, self._group, options)
        explained = _explained(root)
        caught, survived, equivalent = 0, list[Verdict](), 0
        for mutant in drawn:
            if caught + len(survived) + equivalent == (len(drawn) if options.only else options.count):
                break
            if (str(mutant.path), mutant.before, mutant.after) in explained:
                equivalent += 1
                _say(f"  explained  {mutant.title}")
                continue
            verdict = judge.judge(mutant)
            if verdict is None:
                continue
            if verdict.caught_by:
                caught += 1
                _say(f"  caught     {mutant.title}\n             by {verdict.caught_by} ({verdict.took_s:.1f} s)")
            else:
                survived.append(verdict)
                _say(f"  SURVIVED   {mutant.title}\n             {verdict.tests} tests ({verdict.took_s:.1f} s)")
        _say(f"{self._group}, seed {options.seed}: {caught} caught, {len(survived)} survived, {equivalent} explained")
        for verdict in survived:
            _say(f"  {verdict.mutant.title}")
        return 1 if survived else 0


def _explained(root: Path) -> set[tuple[str, str, str]]:
    """Return the faults that change no behaviour that matters, as (file, before, after)."""
    table = tomllib.loads((root / EQUIVALENT).read_text())
    return {(entry["file"], entry["before"], entry["after"]) for entry in table.get("mutant", ())}


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
