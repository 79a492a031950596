"""Integers that a double cannot represent: formulas and conditions agree with exact arithmetic, for any value."""

from __future__ import annotations

import json
import operator
import random
import re
from collections.abc import Callable, Mapping
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from shmio.cli.campaigns.verdicts import as_table, lines
from shmio.injection.condition import Memory
from shmio.injection.language import Constant, Operation, Reference, Tree, parse_formula
from shmio.injection.program import compile_condition
from shmio.judging.judge import Judge
from shmio.judging.pieces import FAR_NS, Piece
from shmio.judging.report import Report, html, junit
from shmio.judging.source import Frames
from shmio.judging.verdict import Outcome
from shmio.layout.model import Layout, Register
from tests.unit.judging.test_judge import S, expect

LAYOUT = Layout(
    "DB1", 1, 40, False,
    (
        Register("a", "LINT", (), 0, None, 8, 1),
        Register("b", "LINT", (), 8, None, 8, 1),
        Register("u", "ULINT", (), 16, None, 8, 1),
        Register("r", "LREAL", (), 24, None, 8, 1),
        Register("t", "LTIME", (), 32, None, 8, 1),
    ),
)  # fmt: skip
FORMULAS = (
    "a == b", "a != b", "a < b", "a <= b", "a > b", "a >= b", "a == u", "u > a", "u - a > b", "a + b == u",
    "a - b == 1", "abs(a - b) <= 1", "-a < -b", "a * 2 == b + u", "a * b > u * u", "a mod 7 == b mod 7",
    "a / 2 == b / 2", "a / 3 < b / 3", "a + 0.5 > b", "a * 0.5 == u * 0.5", "a == r", "a < r", "u >= r + 1", "t > a",
    "a == {n}", "u < {n}", "a - {n} > 0", "u + {n} == b", "abs(a) == {n}.0", "a - r == b - r", "a mod 2 == 1", "a - b",
)  # fmt: skip
OPERATIONS: Mapping[str, Callable[..., Any]] = {
    "+": operator.add, "-": operator.sub, "*": operator.mul, "mod": operator.mod, "neg": operator.neg, "abs": abs,
    "/": lambda left, right: Fraction(left) / right,
    "==": operator.eq, "!=": operator.ne, "<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge,
}  # fmt: skip


def exactly(tree: Tree, values: Mapping[str, Any]) -> Any:
    """Return the value of a formula, by fractions."""
    match tree:
        case Constant(value):
            return Fraction(value)
        case Reference(path):
            return Fraction(values[path])
        case Operation(name, operands):
            return OPERATIONS[name](*(exactly(one, values) for one in operands))


def image(values: Mapping[str, Any]) -> bytes:
    packed = np.zeros(1, [("a", ">i8"), ("b", ">i8"), ("u", ">u8"), ("r", ">f8"), ("t", ">i8")])
    for name, value in values.items():
        packed[name] = value
    return packed.tobytes()


def frames(*rows: Mapping[str, Any]) -> Frames:
    count = len(rows)
    images = np.frombuffer(b"".join(map(image, rows)), np.uint8).reshape(count, LAYOUT.size)
    number = np.arange(1, count + 1).astype(np.uint64)
    return Frames(
        number, np.arange(count) * S, np.full(count, 2, np.uint8), np.zeros(count, np.uint32), images
    )  # fmt: skip


def near(chance: random.Random, bits: int) -> int:
    return chance.choice((1, -1)) * ((1 << bits) + chance.randint(-3, 3))


def row(chance: random.Random) -> dict[str, Any]:
    bits = chance.choice((52, 53, 54, 60, 62))
    a = near(chance, bits)
    u = abs(near(chance, chance.choice((bits, bits + 1)))) + chance.randint(-2, 2)
    r = float(near(chance, chance.choice((bits, 3)))) + chance.choice((0, 0.5))
    return {"a": a, "b": a + chance.randint(-2, 2), "u": u, "r": r, "t": a + chance.randint(-1, 1)}


def verdict(formula: str, *rows: Mapping[str, Any], golden: Any = None, **keys: Any) -> Any:
    expected = expect(formula=formula) if formula else expect(**keys)
    found = Judge([expected], {"cell": LAYOUT}, {"cell": 10 * S}, golden)
    found.add("cell", frames(*rows))
    found.finish()
    return found.verdicts[0]


def test_formulas_and_conditions_are_exact() -> None:
    chance = random.Random(37)
    seen = set()
    for _ in range(60):
        values = row(chance)
        for template in FORMULAS:
            text = template.format(n=abs(values["a"]) + chance.randint(-1, 1))
            right = bool(exactly(parse_formula(text), values))
            seen.add((template, right))
            judged = verdict(f"always({text})", values)
            assert judged.outcome is (Outcome.PASSED if right else Outcome.FAILED), (text, values)
            condition = compile_condition(text, {"cell": LAYOUT})
            read = [one.decode(image(values)) for _, one in condition.reads]
            assert condition.expression.evaluate(read, Memory()) is right, (text, values)  # type: ignore[arg-type]
    assert len(seen) > 1.8 * len(FORMULAS), "each formula is true for some values and false for others"


@pytest.mark.parametrize("base", [1 << 53, 1 << 60, (1 << 63) - 9, -(1 << 63) + 1])
def test_the_least_change_is_seen(base: int) -> None:
    rows = [{"a": base + step, "u": abs(base) + step} for step in (0, 0, 1, 1)]
    assert verdict("always(not changed(a))", *rows).outcome is Outcome.FAILED
    assert verdict("always(not changed(u))", *rows[:2]).outcome is Outcome.PASSED
    assert verdict("", *rows, signal="a", max_rate=0.5).outcome is Outcome.FAILED
    assert verdict("", *rows, signal="a", max_rate=1.5).outcome is Outcome.PASSED


@pytest.mark.parametrize("base", [1 << 53, (1 << 60) + 1, (1 << 63) - 9, -(1 << 63) + 1])
def test_a_recording_is_compared_exactly(base: int) -> None:
    numbers = np.array([base, base + 1, float("nan")], object)
    time = np.array([0, S, S + 1])

    def golden(_file: str, signals: Any) -> list[Piece]:
        return [Piece(time, numbers, numbers, FAR_NS)] * len(signals)

    for shift, tolerance, right in ((0, 0, True), (1, 0, False), (1, 1, True), (2, 1, False), (-1, 0, False)):
        rows = [{"a": base + shift}, {"a": base + 1 + shift}]
        judged = verdict("", *rows, golden=golden, signal="a", like="x.mem", tolerance=tolerance)
        assert judged.outcome is (Outcome.PASSED if right else Outcome.FAILED), (shift, tolerance)
    small = np.array([1.0, 2.0, np.nan])
    judged = verdict("", {"a": base}, {"a": base}, golden=lambda *_: [Piece(time, small, small, FAR_NS)], signal="a",
                     like="x.mem", tolerance=0)  # fmt: skip
    assert judged.outcome is Outcome.FAILED


def test_a_value_that_a_reload_made_wide_is_never_wrong() -> None:
    narrow = Layout("DB1", 1, 40, False, (Register("a", "DINT", (), 0, None, 4, 1),))
    judge = Judge([expect(formula="always(a != 9007199254740992)")], {"cell": narrow}, {"cell": 10 * S})
    judge.add("cell", frames({"a": 0}))
    judge.follow("cell", LAYOUT, 10 * S)
    later = frames({"a": 0}, {"a": (1 << 53) + 1}, {"a": 4})
    judge.add("cell", later._replace(clock_ns=later.clock_ns + S))
    judge.finish()
    (found,) = judge.verdicts
    assert found.outcome is Outcome.INCONCLUSIVE
    assert "too large to be compared exactly" in found.reason


def test_a_failure_shows_all_digits_of_integers() -> None:
    wrong = [(1 << 64) - 1, (1 << 53) + 1, (1 << 50) + 1, 1234567890123]
    judged = verdict("always(u == 1 and r > 0)", *({"u": one, "r": one / 3} for one in wrong))
    assert [value for _, value in judged.around["cell/u"]] == wrong[: len(judged.around["cell/u"])]
    told = json.dumps(as_table(judged))
    report = Report("", [], "", 0, 4 * S, [judged], [[]], [], [])
    texts = "\n".join(lines(judged)), html(report, pytest.fail), junit(report).decode(), told
    for one in wrong[: len(judged.around["cell/u"])]:
        assert all(re.search(rf"\b{one}\b", text) for text in texts), (one, texts)
    assert re.search(r"r  0\.000: 6\.14891469e\+18 ", texts[0])
