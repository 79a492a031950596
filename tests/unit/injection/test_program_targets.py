"""Targets of injections: registers, elements, ranges, parts, structures, patterns, sources."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.errors import PathError
from shmio.injection.program import MAX_REGISTERS, resolve, single
from shmio.layout.compiler import Source, compile_sources
from shmio.layout.model import Layout, Register

DB = b"""
DATA_BLOCK "DB1"
{ S7_Optimized_Access := 'FALSE' }
STRUCT
  word : WORD;
  long : DWORD;
  speed : REAL;
  run : BOOL;
  stop : BOOL;
  bytes : ARRAY[0..9] OF BYTE;
  grid : ARRAY[1..2, 1..3] OF INT;
  lamps : ARRAY[0..11] OF BOOL;
  axis : STRUCT
    position : REAL;
    name : STRING[4];
  END_STRUCT;
END_STRUCT;
BEGIN
END_DATA_BLOCK
"""
BIG = compile_sources([Source("cell.db", DB)]).layouts[0]
REGISTERS = (Register("word", "WORD", (), 0, None, 2, 1), Register("a", "INT", (), 4, None, 2, 1))
LITTLE = Layout("t", None, 8, False, REGISTERS, "little")
LAYOUTS = {"cell": BIG, "sim": LITTLE}


def paths(*texts: str) -> list[str]:
    return [register.path for register in resolve(texts, LAYOUTS).registers]


def bits(cover: bytes) -> set[tuple[int, int]]:
    return {(at, bit) for at, byte in enumerate(cover) for bit in range(8) if byte >> bit & 1}


def test_registers_elements_structures_patterns_and_sources() -> None:
    assert paths("cell/speed", "cell/bytes/3") == ["speed", "bytes/3"]
    assert paths("cell/axis") == ["axis/position", "axis/name"]
    assert paths("cell/*o*") == ["word", "long", "stop"]
    assert paths("cell/bytes/*") == [f"bytes/{place}" for place in range(10)]
    assert paths("sim") == ["word", "a"]
    assert resolve(["cell/speed/in"], LAYOUTS).direction == "in"
    assert resolve(["SIM://a/out"], LAYOUTS)[:2] == ("sim", "out")


def test_range_is_of_the_last_index() -> None:
    assert paths("cell/bytes/2..4") == ["bytes/2", "bytes/3", "bytes/4"]
    assert paths("cell/grid/2/1..3/in") == ["grid/2/1", "grid/2/2", "grid/2/3"]


def test_bits_bytes_and_words_count_from_the_least_significant() -> None:
    offset = BIG.registers[BIG.by_path["word"]].offset
    assert bits(resolve(["cell/word.%X0"], LAYOUTS).cover) == {(offset + 1, 0)}
    assert bits(resolve(["cell/word.%X15"], LAYOUTS).cover) == {(offset, 7)}
    assert bits(resolve(["sim/word.%X15/in"], LAYOUTS).cover) == {(1, 7)}
    parts = resolve(["cell/long.%B0", "cell/long.%W1"], LAYOUTS).registers
    assert [(register.offset, register.type) for register in parts] == [(5, "BYTE"), (2, "WORD")]
    assert single("cell/bytes/3.%X7", LAYOUTS)[1].bit == 7


def test_a_register_named_twice_counts_once() -> None:
    assert paths("cell/speed", "cell/sp*", "cell/speed") == ["speed"]


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        (["cell/sped"], "no such register"),
        (["speed"], "not one of the 2 sources"),
        (["cell/speed", "sim/a"], "one direction of one source"),
        (["cell/speed", "cell/speed/in"], "one direction of one source"),
        (["cell/word", "cell/word.%X0"], ""),
        (["cell/word.%X0", "cell/word"], "names cell/word, or a part of it, twice"),
        (["cell/speed.%X0"], "REAL has no such part"),
        (["cell/bytes.%X0"], "has no such part"),
        (["cell/word.%X16"], "WORD has bits 0 to 15"),
        (["cell/word.%W0"], "WORD has no such part"),
        (["cell/bytes/4..2"], "the lower index first"),
        (["cell/bytes/8..10"], "outside"),
        (["cell/speed/1..2"], "the place of an array's last index"),
        (["cell/grid/1..2"], "the place of an array's last index"),
        (["cell/z*"], "no such register"),
        (["model/clock"], "unknown source 'model'"),
        (["cell//speed"], "empty segment"),
    ],
)
def test_faulty_target_is_refused(texts: list[str], message: str) -> None:
    if not message:
        assert paths(*texts) == ["word"], "the whole register is named already"
        return
    with pytest.raises(PathError) as refused:
        resolve(texts, LAYOUTS)
    assert message in str(refused.value)


def test_size_of_a_target_is_bounded() -> None:
    many = Layout("m", None, 5000, False, tuple(Register(f"r{at}", "BYTE", (), at, None, 1, 1) for at in range(5000)))
    with pytest.raises(PathError, match=f"more than {MAX_REGISTERS} registers"):
        resolve(["m/**"], {"m": many})


def test_condition_refuses_registers_toward_the_device() -> None:
    assert single("cell/speed/out", LAYOUTS)[1].path == "speed"
    for text in ("cell/speed/in", "cell/word.%X1/in"):
        with pytest.raises(PathError, match="leave out /in"):
            single(text, LAYOUTS)


@given(st.text(alphabet="cel/spdwor.%XBWD0123456789*in-", max_size=30))
def test_any_text_names_something_or_is_refused(text: str) -> None:
    try:
        target = resolve([text], LAYOUTS)
    except PathError:
        return
    assert target.registers
    assert any(target.cover)
