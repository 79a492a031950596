"""Code that all commands share: exit status, output, errors without a traceback, and signals."""

from __future__ import annotations

import argparse
import importlib
import io
import json
import math
import os
import re
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from types import FrameType, MappingProxyType
from typing import Any, Final, TextIO

from shmio.errors import CommandError, ConfigError, ControlError, LayoutError, ShmioError
from shmio.wording import printable

MAX_SECONDS = 86_400
_TARGETS: Final = ("-c", "--instance", "--host")
"""Options that name the instance; each takes a value."""
_MOST: Final = 9_999_999
SHOWN_CHARACTERS = 60
"""Maximum number of characters of a value that a terminal shows."""


class PartlyDoneError(CommandError):
    """A command failed after it had done part of its work.

    ``found`` describes that part, as keys of the JSON output.
    """

    def __init__(self, message: str, found: Mapping[str, object]) -> None:
        super().__init__(message)
        self.found = found


def run(
    program: str,
    command: Callable[[], int | None],
    options: argparse.Namespace,
    status_of: Callable[[Exception], int] = lambda _error: 1,
) -> int:
    """Run a command, print its error, and return its exit status.

    The status is 0 for success, 1 for a failure, and 128 + n after signal n, as in shells. argparse
    exits with 2 for wrong usage. An error is printed on standard error; with ``--json`` also on
    standard output, as ``{"error": "…"}``.

    Args:
        program: Name of the program, for error messages.
        command: Runs the command. It returns the exit status, or None for 0.
        options: The parsed arguments.
        status_of: Returns the exit status for an error, for a command that uses 1 for something
            else.
    """
    as_json = getattr(options, "json", False)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # the terminal may not be UTF-8
    try:
        status = command() or 0
        sys.stdout.flush()
    except (ConfigError, ControlError, LayoutError) as error:  # a line for each problem
        _print_error(str(error), as_json=as_json)
        return status_of(error)
    except ShmioError as error:
        found = error.found if isinstance(error, PartlyDoneError) else {}
        _print_error(str(error).replace("\n", "\\n"), found, as_json=as_json)
        return status_of(error)
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        give_up_if_broken(sys.stdout)  # the reader has ended, as with `| head`
        return 141
    except OSError as error:
        _print_error(f"{error.filename or program}: {error.strerror}", as_json=as_json)
        give_up_if_broken(sys.stdout)
        return status_of(error)
    return status


def load(command: str) -> Callable[..., int]:
    """Import and return a function of a verb: the one that runs it, or the one that adds its arguments.

    Only the modules that this verb needs are imported. During the import, Ctrl-C ends the process
    at once.

    Args:
        command: Module and function of the verb, such as ``shmio.cli.instance.status:status``.
    """
    module, _, function = command.partition(":")
    with ended_by_interrupt():
        found: Callable[..., int] = getattr(importlib.import_module(module), function)
    return found


class _VerbParser(argparse.ArgumentParser):
    """The parser of a verb. It refuses words that it does not know, so that the error shows the verb's own usage."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse the words. No unknown words remain."""
        found, rest = super().parse_known_args(args, namespace)
        if rest:
            self.error(f"unrecognized arguments: {' '.join(rest)}")
        return found, rest


def add_verbs(
    parser: argparse.ArgumentParser, dest: str = "verb"
) -> argparse._SubParsersAction[argparse.ArgumentParser]:
    """Return the object with which to add verbs to a command."""
    return parser.add_subparsers(dest=dest, required=True, metavar="VERB", parser_class=_VerbParser)


def verb_first(words: Sequence[str]) -> list[str]:
    """Return the words of a command line, with options that name the instance moved from before the verb to after it.

    Users of other commands write ``shmio-supervisor -c FILE status``.
    """
    at = 0
    while at < len(words) and words[at].startswith(_TARGETS):
        at += 2 if words[at] in _TARGETS else 1
    if at >= len(words):
        return []  # the message about the missing verb is the same
    return [words[at], *words[:at], *words[at + 1 :]]


def complete(parser: argparse.ArgumentParser) -> None:
    """If the shell asks for completions, print them and exit; otherwise do nothing."""
    if "_ARGCOMPLETE" in os.environ:
        from shmio.cli.completion import answer  # noqa: PLC0415  only for a shell

        answer(parser)


def say(line: str, stream: TextIO | None = None) -> None:
    """Print a line without delay. If the terminal is closed, do nothing."""
    with suppress(OSError):
        print(printable(line), file=stream or sys.stdout, flush=True)
        return
    if stream is sys.stderr:
        give_up_if_broken(sys.stderr)  # Python would end with status 120


def say_json(value: Any) -> None:
    """Print an object as one line of JSON without delay. If the terminal is closed, do nothing."""
    with suppress(OSError):
        print(dumps(value), flush=True)


def _print_error(error: str, found: Mapping[str, object] = MappingProxyType({}), *, as_json: bool) -> None:
    sys.stderr.write("".join(f"{printable(line)}\n" for line in error.split("\n")))
    if as_json:
        say_json({**found, "error": error})


def give_up_if_broken(stream: TextIO | None) -> str:
    """Flush a stream. If that fails, discard its output from now on, and return why; else return "".

    If it were not discarded, a later flush would fail again, and change the exit status.
    """
    if stream is None:
        return ""
    try:
        stream.flush()
    except OSError as error:
        with Path(os.devnull).open("wb") as null:
            os.dup2(null.fileno(), stream.fileno())
        return str(error.strerror)
    return ""


def at_least(least: int) -> Callable[[str], int]:
    """Return an argparse type that accepts whole numbers from ``least`` to 9,999,999."""

    def convert(text: str) -> int:
        if not text.isascii() or not text.isdecimal() or len(text) > len(str(_MOST)) or int(text) < least:
            raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from {least} to {_MOST}")
        return int(text)

    return convert


def seconds(text: str) -> float:
    """Convert an argument that is a time in s. This is an argparse type."""
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not 0 < seconds <= MAX_SECONDS:
        raise argparse.ArgumentTypeError(f"{text.strip()!r} is not a number of seconds above 0 and up to {MAX_SECONDS}")
    return seconds


def milliseconds(text: str) -> float:
    """Convert an argument that is a time in ms. This is an argparse type."""
    try:
        found = float(text)
    except ValueError:
        found = math.nan
    if not 0 < found <= 1000 * MAX_SECONDS:
        raise argparse.ArgumentTypeError(
            f"{text.strip()!r} is not a number of milliseconds above 0 and up to {1000 * MAX_SECONDS}"
        )
    return found


def step_ms(text: str) -> float:
    """Convert an argument that is the length of a step in ms. This is an argparse type."""
    from shmio.model.clock import MAX_STEP_NS, MIN_STEP_NS, check_step  # noqa: PLC0415  only for commands that step

    try:
        found = float(text)
        check_step(found * 1e6)
    except ValueError:  # ValueRangeError is one
        limits = f"from {MIN_STEP_NS / 1e6:g} to {MAX_STEP_NS // 10**6}"
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of ms {limits}") from None
    return found


_AGO: Final = re.compile(r"([0-9]{1,9}(?:\.[0-9]{1,6})?)([smhd])")
_UNITS_S: Final = {"s": 1, "m": 60, "h": 3600, "d": 86_400}


def moment(text: str) -> float:
    """Convert an argument that is a date and time, or a duration before now, such as ``10m``.

    Returns:
        UNIX time in s.
    """
    if found := _AGO.fullmatch(text):
        return time.time() - float(found[1]) * _UNITS_S[found[2]]
    try:
        return datetime.fromisoformat(text).astimezone().timestamp()
    except (OverflowError, ValueError):
        raise argparse.ArgumentTypeError(
            f"{text!r} is neither a time before now, such as 30s, 10m, 2h or 7d, nor a date and time"
        ) from None


def seed_number(text: str) -> int:
    """Convert an argument that is a seed. This is an argparse type."""
    if not text.isascii() or not text.isdecimal() or len(text) > 19 or int(text) >= 2**63:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 0 to {2**63 - 1}")
    return int(text)


def add_access(parser: argparse._ActionsContainer) -> None:
    """Add the options for the connection to a NATS server."""
    parser.add_argument(
        "--credentials", metavar="FILE", help="a .creds file, or the seed of an NKey, for the NATS server"
    )
    parser.add_argument("--ca", metavar="FILE", help="the authority of the NATS server's certificate (PEM)")
    parser.add_argument("--certificate", metavar="FILE", help="the certificate to show to the NATS server (PEM)")
    parser.add_argument("--key", metavar="FILE", help="its key (PEM)")


def add_json(parser: argparse._ActionsContainer, text: str = "print one JSON object") -> None:
    """Add the option ``--json``, with ``text`` as its help. It also makes :func:`run` print errors as JSON."""
    parser.add_argument("--json", action="store_true", help=f"{text}, also for an error")


def add_full(parser: argparse.ArgumentParser) -> None:
    """Add the option ``--full``, which prints long values completely."""
    parser.add_argument(
        "--full", action="store_true", help="print long arrays and texts completely, even on a terminal"
    )


def room(options: argparse.Namespace) -> int | None:
    """Return the maximum number of characters to print of a value; None if there is no limit.

    There is no limit with ``--full``, or if standard output is not a terminal.
    """
    return None if options.full or not sys.stdout.isatty() else SHOWN_CHARACTERS


def draw(lines: Sequence[str], drawn: int, remedy: str = "; enlarge the window") -> int:
    """Show lines on the terminal in the place of those that were drawn before, and return their number.

    Args:
        lines: The lines. If there are more than the window has, the last one says how many are left
            out, and then ``remedy``.
        drawn: What the previous call has returned; 0 for the first call.
        remedy: How to see all lines.
    """
    rows = shutil.get_terminal_size().lines
    if len(lines) >= rows:
        lines = [*lines[: max(rows - 2, 0)], f"… and {len(lines) - rows + 2} more lines{remedy}"]
    up = f"\x1b[{drawn}F" if drawn else ""
    text = "".join(f"{line}\x1b[K\n" for line in lines)
    sys.stdout.write(f"{up}\x1b[?7l{text}\x1b[J\x1b[?7h")  # the terminal cuts long lines
    sys.stdout.flush()
    return len(lines)


def dumps(value: Any, indent: int | None = None) -> str:
    """Return a value as JSON that contains only characters that standard output can encode.

    Args:
        value: The value.
        indent: Number of spaces by which to indent each level; None for a single line.
    """
    utf8 = (sys.stdout.encoding or "").lower().replace("-", "") == "utf8"
    return json.dumps(value, indent=indent, ensure_ascii=not utf8)


@contextmanager
def stop_on_signals() -> Iterator[threading.Event]:
    """Yield an event that is set by SIGINT, SIGTERM or SIGHUP; restore the handlers at the end.

    If SIGHUP is ignored, as under nohup, it stays ignored.
    """
    stopping = threading.Event()

    def stop(_number: int, _frame: FrameType | None) -> None:
        # In another thread, because the interrupted main thread may hold the event's lock.
        threading.Thread(target=stopping.set, daemon=True).start()

    heeded = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]
    if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
        heeded.remove(signal.SIGHUP)
    old = {number: signal.signal(number, stop) for number in heeded}
    try:
        yield stopping
    finally:
        for number, handler in old.items():
            signal.signal(number, handler)


@contextmanager
def ended_by_interrupt() -> Iterator[None]:
    """Within a ``with`` block, let Ctrl-C end the process at once and silently.

    An exception would leave an import unfinished.
    """
    main = threading.current_thread() is threading.main_thread()
    heeded = main and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if heeded:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        yield
    finally:
        if heeded:
            signal.signal(signal.SIGINT, signal.default_int_handler)


@contextmanager
def exit_on_signals() -> Iterator[None]:
    """Within a ``with`` block, let SIGTERM and SIGHUP raise SystemExit, so that unfinished work is undone.

    The exit status is 128 + n, as in shells. Signals that are ignored, such as SIGHUP under nohup,
    stay ignored.
    """

    def end(number: int, _frame: FrameType | None) -> None:
        for other in old:
            signal.signal(other, signal.SIG_IGN)  # a shell may repeat it, which must not end the clean-up
        sys.exit(128 + number)

    handlers = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGHUP)}
    old = {number: handler for number, handler in handlers.items() if handler is not signal.SIG_IGN}
    for number in old:
        signal.signal(number, end)
    try:
        yield
    finally:
        for number, handler in old.items():
            signal.signal(number, handler)
