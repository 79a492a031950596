from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.errors import PathError
from shmio.layout.compiler import Source, compile_sources
from shmio.layout.glob import MAX_PATTERN, Glob, named, select
from shmio.layout.topic import Topic


@pytest.mark.parametrize(
    ("pattern", "path", "matches"),
    [
        ("a", "a", True),
        ("a", "a/b/c", True),  # also covers all below
        ("a", "ab", False),
        ("a/b", "a", False),
        ("*", "a", True),
        ("*", "a/b", True),
        ("Robot_*/*", "Robot_800/Axs1", True),
        ("Robot_*/*", "Robot_800", False),
        ("Robot_*", "Robot_800/Axs1", True),
        ("*_Pos", "a/b_Pos", False),
        ("**_Pos", "a/b_Pos", True),
        ("**/Pos", "Pos", True),
        ("**/Pos", "a/b/Pos", True),
        ("**/Pos", "a/bPos", False),
        ("a/**/b", "a/b", True),
        ("a/**/b", "a/x/y/b", True),
        ("a/**/b", "ab", False),
        ("a/**", "a/b", True),
        ("a/**", "a", False),
        ("**", "a/b/c", True),
        ("**/**/**/c", "c", True),
        ("a*b*c", "axbxc", True),
        ("a*b*c", "axbx/c", False),
        ("a/*/c", "a/b/c", True),
        ("a/*/c", "a//c", True),
        ("a.c", "abc", False),
        ("a%2Ab", "a*b", True),
        ("a%2Ab", "axb", False),
        ("a+*", "a%2Bb", True),
        ("in", "%69n", True),
        ("in*", "inner", True),
        ("*in", "main", True),
        ("%69n/*", "%69n/x", True),
        ("轴*", "轴1", True),
    ],
)
def test_matches(pattern: str, path: str, *, matches: bool) -> None:
    assert Glob(pattern).matches(path) is matches


@pytest.mark.parametrize("pattern", ["", "/a", "a//b", "a/", "a%", "*" * (MAX_PATTERN + 1)])
def test_refused(pattern: str) -> None:
    with pytest.raises(PathError):
        Glob(pattern)


def reference(pattern: str, path: str) -> bool:
    """Match by a regular expression: simple, but slow for patterns with many stars."""
    expression = ""
    for piece in re.findall(r"(?:(?<=/)|^)\*\*+/|\*+|[^*]", pattern):
        if piece.startswith("**") and piece.endswith("/"):
            expression += "(?:.*/)?"
        elif piece.startswith("*"):
            expression += ".*" if len(piece) > 1 else "[^/]*"
        else:
            expression += re.escape(piece)
    return re.fullmatch(f"{expression}(?:/.*)?", path) is not None


segments = st.lists(st.sampled_from(["a", "b", "*", "**", "aa", "a*", "*b", "a**b"]), min_size=1, max_size=4)
paths = st.lists(st.text("ab", min_size=1, max_size=3), min_size=1, max_size=4).map("/".join)


@given(segments.map("/".join), paths)
def test_agrees_with_regular_expressions(pattern: str, path: str) -> None:
    assert Glob(pattern).matches(path) == reference(pattern, path)


def test_many_stars_do_not_take_exponential_time() -> None:
    assert not Glob("*a" * 500 + "b").matches("a" * 10_000)


def test_select() -> None:
    text = """DATA_BLOCK "b" STRUCT Inputs : Array[0..9] of Byte; R1 : Struct x : Int; y : Int; END_STRUCT;
        R2 : Struct x : Int; END_STRUCT; END_STRUCT; BEGIN END_DATA_BLOCK"""
    (layout,) = compile_sources([Source("x", text.encode())]).layouts
    assert select(layout, ["Inputs", "R*/x"]) == (0, 1, 3)
    assert select(layout, ["R1"]) == (1, 2)
    assert select(layout, ["%52%31/y"]) == (2,)
    assert select(layout, ["**"]) == (0, 1, 2, 3)
    assert select(layout, ["nothing", "Inputs/5"]) == ()


LISTS = compile_sources(
    [Source("x.db", b'DATA_BLOCK "b" STRUCT a : Array[-2..3] of Int; s : Struct x : Int; y : Array[0..1, 0..1] of Int; '
                    b'END_STRUCT; z : Int; END_STRUCT; BEGIN END_DATA_BLOCK')]
).layouts[0]  # fmt: skip


@pytest.mark.parametrize(
    ("path", "paths"),
    [
        ("", ["a", "s/x", "s/y", "z"]),
        ("z", ["z"]),
        ("s", ["s/x", "s/y"]),
        ("*", ["a", "s/x", "s/y", "z"]),
        ("q*", []),
        ("a/-2", ["a/-2"]),
        ("a/-1..1", ["a/-1", "a/0", "a/1"]),
        ("a/3..3", ["a/3"]),
    ],
)
def test_path_names_registers(path: str, paths: list[str]) -> None:
    assert [register.path for register in named(LISTS, Topic("cell", path))] == paths


@pytest.mark.parametrize(
    "path", ["q", "a/4", "a/2..4", "a/1..0", "z/0..1", "s/0..1", "s/y/0..1", "a/1..", "a/..", "q/0..1"]
)
def test_path_that_names_nothing_is_refused(path: str) -> None:
    with pytest.raises(PathError):
        named(LISTS, Topic("cell", path))
