"""Fuzzes what reads bytes from the network or from files of others: ``parsers.py`` lists the parsers.

A finding is an unexpected exception, more than ``--cpu-s`` seconds of processor time, or more
memory than ``--memory-mb``. The script saves its input to a file; to repeat it, name that file and
its parser on the command line.

The inputs are valid ones with damage. With ``--guided``, atheris makes those of the layout compiler,
and watches what code each input reaches.
"""

from __future__ import annotations

import argparse
import importlib
import itertools
import logging
import math
import resource
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from types import FrameType

from tests.fuzz import layout_checks, page_calls
from tests.fuzz.layout_inputs import FRAGMENTS, MAX_INPUT, seeds
from tests.fuzz.parsers import PARSERS, Parser

TURN_S = 1.0
"""A parser is fuzzed for this time, then the next one."""


class TooSlow(BaseException):
    """An input exceeded its processor time."""


def guarded(name: str, check: Callable[[bytes], None], cpu_s: float) -> Callable[[bytes], None]:
    """Return a parser's check with a limit of processor time.

    The new check saves the input of a finding, and exits.
    """

    def expire(_signal: int, _frame: FrameType | None) -> None:
        raise TooSlow

    signal.signal(signal.SIGVTALRM, expire)

    def run(data: bytes) -> None:
        signal.setitimer(signal.ITIMER_VIRTUAL, cpu_s)
        try:
            check(data)
        except BaseException as error:
            signal.setitimer(signal.ITIMER_VIRTUAL, 0)
            if isinstance(error, KeyboardInterrupt):
                raise
            with tempfile.NamedTemporaryFile(prefix=f"fuzz-{name}-", suffix=".bin", delete=False) as file:
                file.write(data)
            traceback.print_exc()
            sys.stderr.write(
                f"finding: {type(error).__name__}; repeat it by: scripts/fuzz --parser {name} {file.name}\n"
            )
            raise SystemExit(1) from None
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)

    return run


class Campaign:
    """The fuzzing of one parser, and what it has done so far."""

    def __init__(self, name: str, parser: Parser, seed: int, cpu_s: float) -> None:
        self.name, self.share = name, parser.share
        self.count, self.spent_s, self.slowest_s = 0, 0.0, 0.0
        self._inputs = parser.inputs(seed)
        self._run = guarded(name, parser.check, cpu_s)

    def turn(self, until_s: float, count: float) -> None:
        """Try inputs until the time, or until ``count`` have been tried in all turns."""
        begun = time.monotonic()
        while self.count < count and time.monotonic() < until_s:
            before = time.process_time()
            self._run(next(self._inputs))
            self.slowest_s = max(self.slowest_s, time.process_time() - before)
            self.count += 1
        self.spent_s += time.monotonic() - begun


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the script; return 0 if nothing was found."""
    parser = argparse.ArgumentParser(prog="fuzz", description="Fuzz the parsers of hostile input.")
    parser.add_argument("inputs", nargs="*", type=Path, metavar="INPUT", help="check only these saved inputs")
    parser.add_argument("--parser", action="append", choices=PARSERS, metavar="NAME", help=f"{', '.join(PARSERS)}")
    parser.add_argument(
        "--for",
        dest="seconds",
        type=float,
        metavar="SECONDS",
        help="time limit in all (default: 60; none with --count)",
    )
    parser.add_argument("--count", type=int, help="inputs for each parser; --for may end the run earlier")
    parser.add_argument(
        "--seed", type=int, default=int(time.time()), help="seed of the inputs (default: the current time)"
    )
    parser.add_argument(
        "--cpu-s", type=float, default=20.0, help="processor time that one input may take (default: 20)"
    )
    parser.add_argument(
        "--memory-mb", type=int, default=2048, help="limit of the process's address space (default: 2048; 0: none)"
    )
    parser.add_argument(
        "--guided", action="store_true", help="make inputs for the layout compiler with atheris (extra 'fuzz')"
    )
    options = parser.parse_args(arguments)
    if options.seconds is None:
        options.seconds = 60.0 if options.count is None else math.inf
    if options.guided:
        return guide(options)
    if options.inputs and len(options.parser or ()) != 1:
        parser.error("name the one parser of these inputs: --parser NAME")
    if options.memory_mb:
        resource.setrlimit(resource.RLIMIT_AS, (options.memory_mb << 20, resource.getrlimit(resource.RLIMIT_AS)[1]))
    logging.disable()  # parsers log what they refuse
    names = options.parser or list(PARSERS)
    if options.inputs:
        run = guarded(names[0], PARSERS[names[0]].check, options.cpu_s)
        for path in options.inputs:
            run(path.read_bytes())
        return 0
    campaigns = [Campaign(name, PARSERS[name], options.seed, options.cpu_s) for name in names]
    count = math.inf if options.count is None else options.count
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    end_s = time.monotonic() + options.seconds
    with suppress(KeyboardInterrupt):  # Ctrl-C ends the run early
        for campaign in itertools.cycle(campaigns):
            turn_s = min(TURN_S, options.seconds / sum(one.share for one in campaigns)) * campaign.share
            campaign.turn(min(end_s, time.monotonic() + turn_s), count)
            if time.monotonic() >= end_s or all(one.count >= count for one in campaigns):
                break
    for one in campaigns:
        sys.stdout.write(f"{one.name}: {one.count} inputs in {one.spent_s:.0f} s; slowest {one.slowest_s:.2f} s\n")
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10
    sys.stdout.write(f"seed {options.seed}: nothing found; peak {peak_mb} MB\n")
    return 0


def guide(options: argparse.Namespace) -> int:
    """Let atheris make the inputs; it exits the process at the end."""
    atheris = importlib.import_module("atheris")
    for name in [name for name in sys.modules if name.startswith("shmio.layout") or name == layout_checks.__name__]:
        del sys.modules[name]
    with atheris.instrument_imports(include=["shmio.layout"]):
        check = importlib.import_module(layout_checks.__name__).check
    with tempfile.TemporaryDirectory(prefix="fuzz-layout-") as corpus:
        for index, seed in enumerate(seeds()):
            (Path(corpus) / f"seed{index}").write_bytes(seed)
        dictionary = Path(corpus) / "dictionary.txt"
        words = ("".join(f"\\x{byte:02x}" for byte in fragment.encode()) for fragment in FRAGMENTS)
        dictionary.write_text("".join(f'"{word}"\n' for word in words))
        limits = [f"-rss_limit_mb={options.memory_mb}"]
        limits += [f"-max_total_time={int(options.seconds)}"] if options.seconds < math.inf else []
        limits += [f"-runs={options.count}"] if options.count is not None else []
        limits += [f"-max_len={MAX_INPUT}", f"-dict={dictionary}", f"-seed={options.seed}", corpus]
        atheris.Setup(["fuzz", *limits], guarded("layout", check, options.cpu_s))
        atheris.Fuzz()
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    finally:
        page_calls.close()
