"""Paths as TIA Portal writes them."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.layout.compiler import Source, compile_sources
from shmio.layout.spelling import block_path, topic_path

DB = b"""DATA_BLOCK "Cell" STRUCT
  Axes : Array[1..3] of Struct Vel : Real; "in" : Int; END_STRUCT;
  Inputs : Array[0..9] of Byte;
  Grid : Array[0..1, -1..1] of Int;
  "My Axis" : Struct "a/b" : Word; "x.y" : Int; END_STRUCT;
  "Kuka.j1" : Real;
  "odd[1]" : Int;
END_STRUCT; BEGIN END_DATA_BLOCK"""
CELL = compile_sources([Source("x.db", DB)]).layouts[0]
PLAIN = compile_sources(
    [Source("y.db", b"DATA_BLOCK DB7 STRUCT a : Array[0..3] of Int; END_STRUCT; BEGIN END_DATA_BLOCK")]
)
LAYOUTS = {"cell": CELL, "other": PLAIN.layouts[0]}


@pytest.mark.parametrize(
    ("text", "path"),
    [
        ("Axes[2].Vel", "Axes/2/Vel"),
        ('"Axes"[2]."Vel"', "Axes/2/Vel"),
        ("Axes[2]", "Axes/2"),
        ("Axes[2].in", "Axes/2/%69n"),
        ("Axes[*].Vel", "Axes/*/Vel"),
        ("Inputs[8].%X0", "Inputs/8.%X0"),
        ("Inputs[8].%x7", "Inputs/8.%X7"),
        ("Inputs[2..5]", "Inputs/2..5"),
        ("Grid[1, -1]", "Grid/1/-1"),
        ('"My Axis"."a/b".%B1', "My Axis/a%2Fb.%B1"),
        ('"My Axis"."x.y"', "My Axis/x.y"),
        ('"Cell".Axes[1].Vel', "Axes/1/Vel"),
        ("Kuka.j1", "Kuka.j1"),
        ("odd[1]", "odd[1]"),
        ("Axes/2/Vel", "Axes/2/Vel"),
        ("Axes[9].Vel", "Axes[9].Vel"),  # no such register: unchanged
        ("Axes[2]Vel", "Axes[2]Vel"),
        ("Other.Axes[2].Vel", "Other.Axes[2].Vel"),
        ("Axes[a]", "Axes[a]"),
        ("Axes..Vel", "Axes..Vel"),
        ('"Axes', '"Axes'),
        (".%X0", ".%X0"),
    ],
)
def test_within_a_block(text: str, path: str) -> None:
    assert block_path(text, CELL) == path


@pytest.mark.parametrize(
    ("text", "path"),
    [
        ("cell/Axes[2].Vel", "cell/Axes/2/Vel"),
        ('cell/"Axes"[2]."Vel"/in', "cell/Axes/2/Vel/in"),
        ("cell.Axes[2].Vel", "cell/Axes/2/Vel"),
        ('"Cell".Axes[2].Vel', "cell/Axes/2/Vel"),
        ("DB7.a[1].%X3/out", "other/a/1.%X3/out"),
        ("other/a[1..2]", "other/a/1..2"),
        ("CELL://Kuka.j1", "CELL://Kuka.j1"),
        ("Axes[2].Vel", "Axes[2].Vel"),  # no source: unchanged
    ],
)
def test_with_a_source(text: str, path: str) -> None:
    assert topic_path(text, LAYOUTS, None) == path
    assert topic_path("Axes[2].Vel", LAYOUTS, "cell") == "Axes/2/Vel"


@given(st.text(alphabet='Axes[123].%X0"Vel/,*in', max_size=24))
def test_conversion_of_any_text_is_idempotent(text: str) -> None:
    path = topic_path(text, LAYOUTS, "cell")
    assert topic_path(path, LAYOUTS, "cell") == path
