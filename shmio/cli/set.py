"""``shmio set``: writes values to sources, and prints the outcomes."""

from __future__ import annotations

import argparse
import re
import shlex
from collections.abc import Mapping, Sequence

from shmio.cli.common import PartlyDoneError, dumps, seconds
from shmio.errors import CommandError, PathError, ShmioError, ValueRangeError
from shmio.layout.glob import select
from shmio.layout.model import Layout, Register
from shmio.layout.topic import look_up, parse_topic
from shmio.layout.values.codec import Value
from shmio.layout.values.typed import read_value
from shmio.model.cell import Cell
from shmio.model.values import WRITE_MIN_PERIODS, WRITE_TIMEOUT_S, Outcome, OutcomeKind
from shmio.wording import printable, unknown

MATCHES = 3
"""Number of matching registers that an error about a pattern lists."""

_NEGATIVE = re.compile(r"-(?:\.?[0-9]|Infinity\Z)")


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``set``."""
    parser.epilog = (
        "VALUE is JSON or an S7 literal: 5, -1.5e-3, true, 16#FF, T#1s500ms, TOD#12:00:00, D#2026-11-22, '\"text\"'."
    )
    parser.add_argument(
        "--timeout",
        type=seconds,
        metavar="S",
        help="give up if the source begins no write within this many seconds "
        f"(default {WRITE_TIMEOUT_S:g}, or {WRITE_MIN_PERIODS} cycles)",
    )
    parser.add_argument("pairs", nargs="+", action=Pairs, metavar="PATH VALUE", help="register or array element")


def shield(words: Sequence[str]) -> list[str]:
    """Put a space before each word that is a negative number but that argparse would take for an option.

    argparse itself recognizes ``-1.5``, but not ``-1.5e-3``, ``-16#FF`` or ``-Infinity``.
    """
    return [f" {word}" if _NEGATIVE.match(word) else word for word in words]


class Pairs(argparse.Action):
    """The argparse action for the arguments PATH VALUE, which may be repeated."""

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, values: object, _: str | None = None
    ) -> None:
        """Store the words as pairs. A path without a value is wrong usage."""
        words = [word[_NEGATIVE.match(word[1:]) is not None :] for word in values] if isinstance(values, list) else []
        if len(words) % 2:
            parser.error(f"{words[-1]!r} has no value; give PATH VALUE [PATH VALUE ...]")
        namespace.pairs = list(zip(words[::2], words[1::2], strict=True))


def execute(cell: Cell, options: argparse.Namespace) -> int:
    """Write all values for each source as one command.

    Raises:
        CommandError: A write failed; the message is about the first failure.

    """
    wanted: dict[str, dict[str, Value]] = {}
    layouts = cell.layouts()
    for path, text in options.pairs:
        source, register = _target(layouts, path)
        values = wanted.setdefault(source, {})
        name = f"{source}/{register.path}"
        if name in values:
            raise PathError(f"{name}: this path is given twice")
        try:
            values[name] = read_value(text, register)
        except ValueRangeError as error:
            raise ValueRangeError(f"{name}: {str(error).removeprefix(f'{register.path}: ')}") from None
    outcomes: dict[str, Outcome] = {}
    failed: list[tuple[str, Outcome]] = []
    try:
        for values in wanted.values():
            outcomes |= zip(values, cell.set(values, options.timeout), strict=True)
        failed = [(path, outcome) for path, outcome in outcomes.items() if not outcome.done]
        if failed:
            more = f" (and {len(failed) - 1} more)" if failed[1:] else ""
            raise CommandError(_complaint(*failed[0]) + more)
    except ShmioError as error:
        if options.json and outcomes:
            raise PartlyDoneError(str(error), _described(outcomes)) from error
        raise
    finally:  # print the outcomes of earlier sources even if a later one failed
        if not options.json:
            _print(outcomes, failed[0][1].text if failed else "")
    if options.json:
        print(dumps(_described(outcomes)))
    return 0


def _target(layouts: Mapping[str, Layout], path: str) -> tuple[str, Register]:
    """Return the source and the register that a path names.

    Raises:
        PathError: The path does not name a single register that can be written.

    """
    topic = parse_topic(path, layouts, next(iter(layouts)) if len(layouts) == 1 else None)
    if topic.direction == "out":
        raise PathError(f"{path}: an output of a source cannot be written; leave out /out")
    if topic.source not in layouts:
        raise PathError(f"{path}: {unknown('source', topic.source, layouts)}")
    layout = layouts[topic.source]
    try:
        return topic.source, look_up(layout, topic)
    except PathError:
        if "*" not in topic.path:
            raise
    chosen = [f"{topic.source}/{layout.registers[index].path}" for index in select(layout, [topic.path])]
    some = f"{', '.join(chosen[:MATCHES])}{', …' if chosen[MATCHES:] else ''}" if chosen else "nothing"
    raise PathError(f"{path}: set takes one register, not a pattern; this one matches {some}")


def _described(outcomes: dict[str, Outcome]) -> dict[str, object]:
    """Return the outcomes for JSON."""
    return {path: {"outcome": str(end.kind), "reason": end.text} for path, end in outcomes.items()}


def _print(outcomes: dict[str, Outcome], complaint: str) -> None:
    """Print the outcomes as text.

    A reason equal to ``complaint`` is left out, because the error message contains it.
    """
    width = max((len(printable(path)) for path in outcomes), default=0)
    for path, end in outcomes.items():
        reason = f": {printable(end.text)}" if end.text and end.text != complaint else ""
        print(f"{printable(path):<{width}}  {end.kind}{reason}")


def _complaint(path: str, outcome: Outcome) -> str:
    """Return the error text for a failed write, with a remedy."""
    if outcome.kind == OutcomeKind.REJECTED:
        return (
            f"{path}: not written, because the source did not accept the command: {outcome.text}; see "
            "shmio-supervisor status"
        )
    if outcome.kind == OutcomeKind.REFUSED:
        return f"{path}: the source refused the write: {outcome.text}"
    if outcome.kind == OutcomeKind.EXPIRED:
        return f"{path}: not written: {outcome.text}; try again, or with a longer --timeout"
    return f"{path}: {outcome.text}; check the value with shmio get {shlex.quote(path)} before you write it again"
