"""Fuzzes the layout compiler, the layout document and the codec.

A finding is an unexpected exception, more than ``--cpu-s`` seconds of processor time, or more
memory than ``--memory-mb``. The script saves its input to a file; to repeat it, name that file on
the command line.

The inputs are mutations of the golden files. With ``--guided``, atheris makes them, and watches
what code each input reaches.
"""

from __future__ import annotations

import argparse
import importlib
import itertools
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

from tests.fuzz import layout_checks
from tests.fuzz.layout_inputs import FRAGMENTS, MAX_INPUT, Mutator, seeds


class TooSlow(BaseException):
    """An input exceeded its processor time."""


def guarded(check: Callable[[bytes], None], cpu_s: float) -> Callable[[bytes], None]:
    """Return the check with a limit of processor time.

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
            with tempfile.NamedTemporaryFile(prefix="fuzz-layout-", suffix=".bin", delete=False) as file:
                file.write(data)
            traceback.print_exc()
            sys.stderr.write(f"finding: {type(error).__name__}; its input is {file.name}\n")
            raise SystemExit(1) from None
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)

    return run


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the script; return 0 if nothing was found."""
    parser = argparse.ArgumentParser(prog="fuzz-layout", description="Fuzz the layout compiler and codec.")
    parser.add_argument("inputs", nargs="*", type=Path, metavar="INPUT", help="check only these saved inputs")
    parser.add_argument("--seconds", type=float, help="time limit (default: 20; none with --count)")
    parser.add_argument("--count", type=int, help="number of inputs; --seconds may end the run earlier")
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
        "--guided", action="store_true", help="make inputs with atheris (extra 'fuzz'), guided by coverage"
    )
    options = parser.parse_args(arguments)
    if options.seconds is None:
        options.seconds = 20.0 if options.count is None else math.inf
    if options.guided:
        return guide(options)
    if options.memory_mb:
        resource.setrlimit(resource.RLIMIT_AS, (options.memory_mb << 20, resource.getrlimit(resource.RLIMIT_AS)[1]))
    run = guarded(layout_checks.check, options.cpu_s)
    for path in options.inputs:
        run(path.read_bytes())
    if options.inputs:
        return 0
    started, count, slowest_s = time.monotonic(), 0, 0.0
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with suppress(KeyboardInterrupt):  # Ctrl-C ends the run early
        for data in itertools.islice(Mutator(options.seed), options.count):
            before = time.process_time()
            run(data)
            slowest_s = max(slowest_s, time.process_time() - before)
            count += 1
            if time.monotonic() - started >= options.seconds:
                break
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10
    seed = options.seed
    sys.stdout.write(f"{count} inputs of seed {seed}, nothing found; slowest {slowest_s:.2f} s, peak {peak_mb} MB\n")
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
        atheris.Setup(["fuzz-layout", *limits], guarded(check, options.cpu_s))
        atheris.Fuzz()
    return 0


if __name__ == "__main__":
    sys.exit(main())
