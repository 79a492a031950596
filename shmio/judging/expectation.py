"""Turns the expectations of a campaign file into formulas."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from shmio.config import Expectation
from shmio.config.expectation import form_of
from shmio.errors import ConfigError
from shmio.injection.language import Constant, Operation, Tree, parse_formula
from shmio.judging.formula import Registers, check, horizon_ns, signals, temporal
from shmio.judging.source import Signal
from shmio.layout.model import Layout

MAX_SIGNALS: Final = 64
"""Maximum number of signals that one expectation may read."""
_NS: Final = 1_000_000_000


@dataclass(frozen=True)
class Formula:
    """An expectation as a formula.

    Attributes:
        expectation: The expectation.
        tree: The formula, whose truth at the start of the judged time is the verdict; None for an
            expectation with ``like``, which compares signals with a recording.
        trigger: A condition that must become true at least once, or else the verdict is
            inconclusive; None if there is no such condition.
        signals: The signals that the formula reads.
        failure: Text that says what a failure means.
    """

    expectation: Expectation
    tree: Tree | None
    trigger: Tree | None
    signals: tuple[Signal, ...]
    failure: str

    @property
    def horizon_ns(self) -> int:
        """How far the formula looks ahead or back, at most, from each moment that it judges, in ns."""
        return 0 if self.tree is None else _reach_ns(self.tree)


def _reach_ns(tree: Tree) -> int:
    match tree:
        case Operation("always" | "eventually", (operand,)):
            return horizon_ns(operand)
        case Operation("and" | "or" | "not" | "implies", operands):
            return max(map(_reach_ns, operands))
        case _:
            return horizon_ns(tree)


def read_expectations(
    expectations: Sequence[Expectation], layouts: Mapping[str, Layout]
) -> tuple[list[Formula], Registers]:
    """Parse expectations, and find the registers that they read.

    Raises:
        ConfigError: An expectation is invalid; the message starts as ``expect[0].formula: …``.

    """
    registers = Registers(layouts)
    found = []
    for index, expectation in enumerate(expectations):
        try:
            found.append(_FORMS[form_of(expectation)](expectation, registers))
        except ConfigError as error:
            raise ConfigError(f'expect[{index}].{error} (expect "{expectation.name}")') from None
    return found, registers


def faults_of_texts(expectations: Sequence[Expectation]) -> Iterator[str]:
    """Parse the formulas and conditions of expectations, without looking up their registers.

    Yield a message for each fault; it starts as ``expect[0].formula: …``.
    """
    for index, expectation in enumerate(expectations):
        for key in ("formula", "when", "then", "never", "always", "stays", "signal"):
            if getattr(expectation, key) is not None and (key != "signal" or expectation.max_rate is not None):
                try:
                    _parsed(expectation, key)
                except ConfigError as error:
                    yield f"expect[{index}].{error}"


def _parsed(expectation: Expectation, key: str, *, momentary: bool = False) -> Tree:
    """Parse the text of a key. With ``momentary``, refuse temporal operators."""
    try:
        tree = parse_formula(getattr(expectation, key))
        check(tree)
    except ConfigError as error:
        raise ConfigError(f"{key}: {error}") from None
    if momentary and temporal(tree):
        raise ConfigError(f"{key}: a temporal operator has no meaning here; write the whole expectation as a formula")
    return tree


def _made(
    expectation: Expectation, key: str, tree: Tree, registers: Registers, failure: str, trigger: Tree | None = None
) -> Formula:
    try:
        check(tree)
        found = tuple(signals(tree, registers))
        _check_count(found)
    except ConfigError as error:
        raise ConfigError(f"{key}: {error}") from None
    return Formula(expectation, tree, trigger, found, failure)


def _formula(expectation: Expectation, registers: Registers) -> Formula:
    tree = _parsed(expectation, "formula")
    if not temporal(tree, ("always", "eventually", "until")):
        raise ConfigError("formula: this formula judges only the first moment; write always(…) or eventually(…)")
    trigger = None
    match tree:
        case Operation("always", (Operation("implies", (condition, _)),)):
            trigger = condition
    return _made(expectation, "formula", tree, registers, "the formula was false", trigger)


def _then(expectation: Expectation, registers: Registers) -> Formula:
    trigger = Operation("rise", (_parsed(expectation, "when", momentary=True),))
    within_s = expectation.within_s or 0.0
    then = Operation("eventually", (_parsed(expectation, "then"),), (0, round(within_s * _NS)))
    failure = f"{expectation.when} became true, but {expectation.then} did not within {within_s:g} s"
    return _made(expectation, "then", _always(Operation("implies", (trigger, then))), registers, failure, trigger)


def _never(expectation: Expectation, registers: Registers) -> Formula:
    tree = _always(Operation("not", (_parsed(expectation, "never"),)))
    return _made(expectation, "never", tree, registers, f"{expectation.never} was true")


def _everywhere(expectation: Expectation, registers: Registers) -> Formula:
    tree = _always(_parsed(expectation, "always"))
    return _made(expectation, "always", tree, registers, f"{expectation.always} was false")


def _stays(expectation: Expectation, registers: Registers) -> Formula:
    stays = _parsed(expectation, "stays", momentary=True)
    key = "stays" if expectation.when is None else "when"
    trigger = Operation("rise", (_parsed(expectation, key, momentary=True),))
    for_s = expectation.for_s or 0.0
    held = Operation("always", (stays,), (0, max(round(for_s * _NS) - 1, 0)))
    failure = f"{getattr(expectation, key)} became true, but {expectation.stays} did not stay true for {for_s:g} s"
    return _made(expectation, "stays", _always(Operation("implies", (trigger, held))), registers, failure, trigger)


def _max_rate(expectation: Expectation, registers: Registers) -> Formula:
    rate = Operation("abs", (Operation("rate", (_parsed(expectation, "signal", momentary=True),)),))
    limit = expectation.max_rate or 0.0
    failure = f"{expectation.signal} changed by more than {limit:g} a second"
    tree = _always(Operation("<=", (rate, Constant(limit))))
    return _made(expectation, "signal", tree, registers, failure)


def _like(expectation: Expectation, registers: Registers) -> Formula:
    texts = [expectation.signal] if isinstance(expectation.signal, str) else expectation.signal or []
    try:
        found = tuple(dict.fromkeys(signal for text in texts for signal in registers.several(text)))
        _check_count(found)
    except ConfigError as error:
        raise ConfigError(f"signal: {error}") from None
    return Formula(expectation, None, None, found, f"it differed from {expectation.like}")


def _check_count(found: Sequence[Signal]) -> None:
    if len(found) > MAX_SIGNALS:
        raise ConfigError(f"an expectation may read at most {MAX_SIGNALS} signals, but this one reads {len(found)}")


def _always(tree: Tree) -> Tree:
    return Operation("always", (tree,))


_FORMS: Final[Mapping[str, Callable[[Expectation, Registers], Formula]]] = {
    "formula": _formula,
    "then": _then,
    "never": _never,
    "always": _everywhere,
    "stays": _stays,
    "max_rate": _max_rate,
    "like": _like,
}
