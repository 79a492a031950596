"""Conversion of values and declared injections to wire messages and back."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from shmio.errors import ValueRangeError
from shmio.messages import declaration_from_wire, declaration_to_wire, value_from_wire, value_to_wire
from shmio.wire import shmio_v1_pb2 as wire


@pytest.mark.parametrize(
    "value",
    [True, 0, -(2**63), 2**64 - 1, 1.5, "", "ä", [], [1, [2.0, "x"], False]],
    ids=lambda value: repr(value)[:20],
)
def test_values_survive_a_round_trip(value: object) -> None:
    found = value_from_wire(value_to_wire(value, "x"), "x")
    assert found == value
    assert type(found) is type(value)


def test_numpy_values_become_python_values() -> None:
    assert value_from_wire(value_to_wire(np.array([[1, 2]], np.uint8), "x"), "x") == [[1, 2]]
    assert value_from_wire(value_to_wire(np.float32(0.5), "x"), "x") == 0.5


@pytest.mark.parametrize("value", [None, 2**64, -(2**63) - 1, object(), {"a": 1}, [None]])
def test_invalid_values_are_refused(value: object) -> None:
    with pytest.raises(ValueRangeError, match="x: "):
        value_to_wire(value, "x")


def test_an_empty_value_is_refused() -> None:
    with pytest.raises(ValueRangeError, match="x: no value"):
        value_from_wire(wire.Value(list=wire.List(values=[wire.Value()])), "x")


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"operation": "drop", "color": 1}, "injection.color: operation 'drop' has no such key"),
        ({"operation": ["drop"]}, "injection.operation"),
        ({"operation": "drop", "name": 5}, "injection: "),
        ({"operation": "drop", "target": 5}, "injection: "),
        ({"operation": "flip", "bits": [-1]}, "injection: "),
        ({"operation": "noise", "distribution": "even"}, "injection.distribution: unknown distribution 'even'"),
        ({"operation": "random", "values": [None]}, "injection.values: a Python NoneType"),
    ],
)
def test_invalid_declarations_are_refused(table: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueRangeError, match=message):
        declaration_to_wire({"name": "x", "target": "y"} | table, "injection")


def test_empty_declarations_and_several_targets() -> None:
    assert declaration_from_wire(wire.Declaration(), "x") == {"name": "", "target": []}
    table = {"name": "x", "target": ["a", "b"], "operation": "drop"}
    assert declaration_from_wire(declaration_to_wire(table, "x"), "x") == table
