"""A structure of numbers that is read and written in one operation gives the same values as its single members."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.errors import ModelError
from shmio.layout.compiler import Source, compile_sources
from shmio.layout.model import Layout, Register
from shmio.simulation import Input, Model, ModelRunner, Output
from shmio.simulation.images import Images

NUMBERS = {"a": "LREAL", "b": "INT", "c": "REAL", "d": "LREAL"}
PACKED = struct.Struct("<dhxxfd")


class Told(Model):
    """A model that writes ``tells``, and stores in ``seen`` what it read."""

    tells: Any = None
    seen: Any = None

    given = Input(NUMBERS)
    numbers = Output(NUMBERS)

    def step(self, time_s: float, dt_s: float) -> None:
        Told.seen = self.given, self.numbers
        self.numbers = Told.tells


def shown(tells: object, layout: Layout | None = None) -> tuple[float, ...]:
    """Return all numbers after a step in which the model wrote ``tells``."""
    Told.tells = tells
    image = ModelRunner(Told, layout).step(1, 1)
    return PACKED.unpack_from(image, PACKED.size)


@pytest.mark.parametrize(
    "tells",
    [
        {"a": 1.5, "b": -2, "c": 0.25, "d": 4.0},
        {"d": 4.0, "c": 0.25, "b": -2, "a": 1.5},
        {"a": np.float64(1.5), "b": np.int16(-2), "c": np.float32(0.25), "d": 4},
        {"a": 1.5, "b": -2.0, "c": 0.25, "d": 4},
    ],
    ids=["in order", "in another order", "of numpy", "whole numbers either way"],
)
def test_all_members_are_written(tells: dict[str, object]) -> None:
    assert shown(tells) == (1.5, -2, 0.25, 4.0)


def test_members_that_are_not_given_keep_their_value() -> None:
    assert shown({"d": 4.0, "b": 7}) == (0.0, 7, 0.0, 4.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"b": 40_000}, "numbers/b: .*40000"),
        ({"b": 1.5}, "numbers/b: .*whole number.*1.5"),
        ({"a": True}, "numbers/a: .*number.*True"),
        ({"c": 1e39}, "numbers/c: .*1e[+]39"),
        ({"a": "1"}, "numbers/a: .*number.*'1'"),
        ({"e": 1}, "numbers: expected a dict with some of a, b, c, d"),
    ],
)
def test_an_invalid_value_is_named_and_the_image_is_unchanged(change: dict[str, object], message: str) -> None:
    Told.tells = {"a": 1.5, "b": -2, "c": 0.25, "d": 4.0}
    runner = ModelRunner(Told)
    before = runner.step(1, 1)
    Told.tells = Told.tells | change
    with pytest.raises(ModelError, match=message):
        runner.step(2, 1)
    assert runner.image == before


def test_all_members_are_read() -> None:
    runner = ModelRunner(Told)
    runner.connect({"given/a": 0.5, "given/b": 3, "given/d": -1})
    Told.tells = {"a": 1.5, "b": -2, "c": 0.25, "d": 4.0}
    runner.step(1, 1)
    runner.step(2, 1)
    assert Told.seen == ({"a": 0.5, "b": 3, "c": 0.0, "d": -1.0}, Told.tells)
    assert [list(part) for part in Told.seen] == [list(NUMBERS)] * 2


def test_members_need_not_be_adjacent() -> None:
    text = """DATA_BLOCK "Apart"
{ S7_Optimized_Access := 'FALSE' }
   STRUCT
      given : Struct a : LReal; b : Int; c : Real; d : LReal; END_STRUCT;
      numbers : Struct a : LReal; between : Int := 9; b : Int; c : Real; d : LReal; END_STRUCT;
   END_STRUCT;
BEGIN
END_DATA_BLOCK
"""
    layout = compile_sources([Source("apart.db", text.encode())]).layouts[0]
    Told.tells = {"a": 1.5, "b": -2, "c": 0.25, "d": 4.0}
    image = ModelRunner(Told, layout).step(1, 1)
    assert struct.unpack_from(">dhhfd", image, 22) == (1.5, 9, -2, 0.25, 4.0)


@given(st.lists(st.booleans(), min_size=1, max_size=120), st.randoms(use_true_random=False))
def test_commanded_values_are_shown_except_those_that_the_model_computes(computed: list[bool], random: Any) -> None:
    """Few pieces are copied in another way than many. Every fourth register is a number, the others are bits."""
    registers = [
        Register(f"r{place}", "BYTE", (), place // 4 * 2 + 1, None, 1, 1)
        if place % 4 == 3
        else Register(f"r{place}", "BOOL", (), place // 4 * 2, place % 4, 1, 1)
        for place in range(len(computed))
    ]
    layout = Layout("l", None, (len(computed) + 3) // 4 * 2, False, tuple(registers))
    images = Images(layout, [one for one, own in zip(registers, computed, strict=True) if own])
    images.commanded[:], images.shown[:] = random.randbytes(layout.size), random.randbytes(layout.size)
    expected = bytearray(images.commanded)
    for register, own in zip(registers, computed, strict=True):
        if own:
            mask = 0xFF if register.bit is None else 1 << register.bit
            expected[register.offset] ^= (expected[register.offset] ^ images.shown[register.offset]) & mask
    assert images.with_given(images.shown) == expected
    images.show_given()
    assert images.shown == expected
