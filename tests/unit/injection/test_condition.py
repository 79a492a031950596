"""Conditions: their meaning and their errors; any text is either valid or refused."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.errors import ConfigError
from shmio.injection.condition import Memory, parse
from shmio.injection.language import MAX_DEPTH, MAX_LENGTH, MAX_NODES, Number

VALUES: dict[str, Number] = {"a": 3, "b": -2.5, "on": True, "off": False, "cell/R 1/x": 7}


def holds(text: str, **others: Number | None) -> bool:
    expression = parse(text)
    values: dict[str, Number | None] = {**VALUES, **others}
    return expression.holds([values[path] for path in expression.references], Memory())


@pytest.mark.parametrize(
    "text",
    [
        "a == 3", "a = 3", "a != 4", "a <> 4", "a < 3.5", "a <= 3", "b > -2.6", "b >= -2.5",
        "on", "not off", "NOT off AND on == TRUE", "off or on", "not (on and off)",
        "not off and on", "on or off and off", "a + 1 == 4", "a - 1 - 1 == 1", "a * 2 + 1 == 7", "1 + a * 2 == 7",
        "a / 2 == 1.5", "a mod 2 == 1", "-a == -3", "- -a == a", "abs(b) == 2.5", "16#FF == 255", "2#1010 == 1_0",
        "1.5e1 == 15", '"cell/R 1/x" == 7', "'cell/R 1/x' > a", "on == 1", "(a)", "a-1 == 2",
    ],
)  # fmt: skip
def test_true_conditions(text: str) -> None:
    assert holds(text)
    assert not holds(f"not ({text})")


def test_unknown_is_neither_true_nor_false() -> None:
    for text in ("a > 1", "not (a > 1)", "on or a > 1", "on and 1 / (b - b) > 0"):
        expression = parse(text)
        values = [None if path == "a" else VALUES[path] for path in expression.references]
        assert expression.evaluate(values, Memory()) is None
        assert not expression.holds(values, Memory())
    assert parse("on").evaluate([False], Memory()) is False


def test_path_is_one_token() -> None:
    expression = parse("cell/Outputs/13.%X0 and sim/Kuka.j1/R>2 and cell/Outputs/13.%X0")
    assert expression.references == ("cell/Outputs/13.%X0", "sim/Kuka.j1/R")


def test_edges_compare_consecutive_evaluations() -> None:
    rising, falling, changed = (parse(f"{edge}(a > 1)") for edge in ("rising", "falling", "changed"))
    memories = [Memory(), Memory(), Memory()]
    seen = [
        [
            expression.holds([value], memory)
            for expression, memory in zip((rising, falling, changed), memories, strict=True)
        ]
        for value in (2, 2, 0, 0, 5, None, 5, 0)
    ]
    nothing = [False, False, False]
    assert seen == [
        nothing, nothing, [False, True, True], nothing, [True, False, True], nothing, nothing, [False, True, True],
    ]  # fmt: skip


def test_edge_is_seen_even_if_the_rest_decides_the_result() -> None:
    expression, memory = parse("off and rising(a) or on and rising(a)"), Memory()
    assert expression.references == ("off", "a", "on")
    assert [expression.holds([False, value, True], memory) for value in (False, True, True)] == [False, True, False]


def test_condition_with_an_unknown_value_is_false_and_so_is_its_negation() -> None:
    for text in ("a > 1", "not a > 1", "on or a > 1", "1 / (a - 3) > 0", "not 1 / (b + 2.5) > 0"):
        assert not holds(text, a=None if "-" not in text else 3)


def test_comparison_with_nan_is_false() -> None:
    assert not holds("b > 0 or b <= 0", b=math.nan)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "at character 1: expected a register or a number, found the end"),
        ("a >", "at character 4: expected a register or a number, found the end"),
        ("a b", "at character 3: expected 'and', 'or' or the end of the condition, found 'b'"),
        ("a < 1 < 2", "at character 7: expected 'and', 'or' or the end of the condition, found '<'"),
        ("(a", "at character 3: expected ')', found the end"),
        ("abs a", "expected '(' after 'abs', found 'a'"),
        ("a $ 1", "at character 3: expected a register, a number or an operator, found '$'"),
        ("12abc", "at character 1: '12abc' is not a number; put a path that begins with a digit in quotes"),
        ("a > 5s", "at character 5: '5s' is not a number; times are in s, without a unit: write 5"),
        ("a/ 2 > 1", "at character 2: put a blank before the '/' of a division"),
        ("always[0, 2] a", "at character 1: a condition has no 'always'; only expectations have it"),
        ("__import__('os')", "expected 'and', 'or' or the end of the condition, found '('"),
        ("a == 16#_", "expected digits after the '#'"),
        ("a" * (MAX_LENGTH + 1), f"at most {MAX_LENGTH} characters"),
        ("+".join("a" * (MAX_NODES + 1)), f"more than {MAX_NODES} parts"),
        ("(" * (MAX_DEPTH + 1) + "a", f"more than {MAX_DEPTH} nested levels"),
        ("not " * 100 + "a", "nested levels"),
        ("1" * 41 + " > a", "at most 40 digits"),
    ],
)
def test_faulty_condition_is_refused(text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=r"^[^\n]*$") as raised:
        parse(text)
    assert message in str(raised.value)


TEXT = (
    "a b/2 'c d' 1 2.5 16#FF true and or not mod abs rising falling changed ( ) + - * / < <= == != > >= \" ' # % . .."
)
WORDS = st.sampled_from(TEXT.split(" "))


@given(st.one_of(st.lists(WORDS, max_size=40).map(" ".join), st.text(max_size=60)), st.data())
def test_any_text_is_read_or_refused(text: str, data: st.DataObject) -> None:
    try:
        expression = parse(text)
    except ConfigError:
        return
    memory = Memory()
    number = st.one_of(st.none(), st.booleans(), st.integers(-(2**63), 2**64 - 1), st.floats())
    for _ in range(3):
        values = data.draw(st.lists(number, min_size=len(expression.references), max_size=len(expression.references)))
        assert expression.holds(values, memory) in (True, False)


NUMBERS = st.integers(-9, 9)
TREES = st.recursive(
    NUMBERS.map(lambda number: (f"{number}" if number >= 0 else f"(0 - {-number})", number)),
    lambda inner: st.tuples(st.sampled_from("+-*"), inner, inner).map(
        lambda node: (f"({node[1][0]} {node[0]} {node[2][0]})", eval(f"({node[1][1]}) {node[0]} ({node[2][1]})"))
    ),
    max_leaves=12,
)


@given(TREES)
def test_arithmetic_agrees_with_python(tree: tuple[str, int]) -> None:
    text, value = tree
    if len(text) < 900:
        expression = parse(f"{text} == {value}" if value >= 0 else f"{text} == -{-value}")
        assert expression.holds([], Memory())
