"""Tag tables: the placement of registers, and errors with their lines."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.errors import LayoutError
from shmio.layout.compiler import Source, compile_sources
from shmio.layout.document import load_layout
from shmio.layout.image import initial_frame
from shmio.layout.model import Layout
from shmio.layout.values.codec import codec

TABLE = """
[registers]
"joints/R3200/Link1/R/position" = "LREAL"
"flag" = "bool"
"joints/Kuka.j1/R" = { type = "LREAL", initial = 0.5, comment = "rad" }
"lamps" = { type = "Array[1..3, 0..8] of Bool", initial = [true, false] }
name = { type = "STRING[20]", initial = "it's $5" }
wide = { type = "WSTRING[5]", initial = "h\u00e9" }
since = { type = "TIME", initial = "T#5s" }
small = "SINT"
"""


def compiled(text: str | bytes, file: str = "cell.toml") -> Layout:
    return compile_sources([Source(file, text.encode() if isinstance(text, str) else text)]).layouts[0]


def refusal(text: str | bytes) -> str:
    with pytest.raises(LayoutError) as error:
        compiled(text)
    assert "\n" not in str(error.value)
    return str(error.value)


def test_registers_are_placed_in_file_order_at_multiples_of_their_size() -> None:
    layout = compiled(TABLE)
    assert (layout.name, layout.number, layout.byte_order, layout.optimized) == ("cell", None, "little", False)
    assert [(r.path, r.type, r.offset, r.bit) for r in layout.registers] == [
        ("joints/R3200/Link1/R/position", "LREAL", 0, None),
        ("flag", "BOOL", 8, 0),
        ("joints/Kuka.j1/R", "LREAL", 16, None),
        ("lamps", "BOOL", 24, 0),
        ("name", "STRING[20]", 30, None),
        ("wide", "WSTRING[5]", 52, None),
        ("since", "TIME", 68, None),
        ("small", "SINT", 72, None),
    ]
    assert layout.registers[3].dims == ((1, 3), (0, 8))
    assert layout.registers[2].comment == "rad"
    assert layout.size == 73
    assert load_layout(layout.to_json()) == layout


def test_initial_values_are_those_of_the_table() -> None:
    layout = compiled(TABLE)
    frame, unread = initial_frame(layout)
    values = {r.path: codec(r, layout.byte_order).decode(bytes(frame)) for r in layout.registers}
    assert unread == ()
    assert values["joints/Kuka.j1/R"] == 0.5
    assert values["lamps"] == [[True] + [False] * 8, [False] * 9, [False] * 9]
    assert (values["name"], values["wide"], values["small"]) == ("it's $5", "h\u00e9", 0)
    assert bytes(frame[16:24]) == bytes.fromhex("000000000000e03f"), "not little-endian"


def test_name_and_byte_order_can_be_chosen() -> None:
    layout = compiled('name = "DB9"\nbyte_order = "big"\n[registers]\na = { type = "INT", initial = 1 }\n')
    assert (layout.name, layout.byte_order, bytes(initial_frame(layout)[0])) == ("DB9", "big", b"\0\1")


WRONG = {
    'a = "INT"': "cell.toml:1:1: error: the file is not a tag table: ",
    "[registers]": "not a tag table",
    "[registers]\na = INT": "cell.toml:2:5: error: ",
    "[registers]\n\na = 'INTEGER'": "cell.toml:3:1: error: a: unknown type 'INTEGER'",
    "[registers]\na = 'RAEL'": "2:1: error: a: unknown type 'RAEL'; did you mean 'REAL'?",
    "[registers]\na = 'ARRAY[1..3] OF BOLL'": "2:1: error: a: unknown type 'BOLL'; did you mean 'BOOL'?",
    "[registers]\na = 'STRNG[20]'": "2:1: error: a: unknown type 'STRNG[20]'; did you mean 'STRING'?",
    "[registers]\na = 'INT32'": "2:1: error: a: unknown type 'INT32'; valid: BOOL, INT, DINT",
    "[registers]\na = 'STRING[0]'": "2:1: error: a: unknown type 'STRING[0]'; valid: BOOL, INT, DINT",
    "[registers]\na = 'ARRAY[3..1] OF INT'": "2:1: error: a: expected bounds",
    "[registers]\na = 'ARRAY[0..9,0..9,0..9,0..9,0..9,0..9,0..9] OF INT'": "at most 6 dimensions",
    "[registers]\na = 'ARRAY[0..99999999] OF BOOL'": "at most 1048576 elements",
    "[registers]\na = 'ARRAY[0..999999] OF LREAL'": "the registers have more than 1048576 bytes",
    "[registers]\nx = 'INT'\n'a//b' = 'INT'": "cell.toml:3:1: error: a//b: ",
    "[registers]\n'a/b/out' = 'INT'": "leave out /in or /out at the end of the path",
    "[registers]\n'a/b' = 'INT'\na = 'INT'": "a is already a register",
    "[registers]\n'a.b' = 'INT'\n'a%2Eb' = 'INT'": "given twice",
    "[registers]\na = { type = 'INT', initial = 40000 }": "cell.toml:2:1: error: a: ",
    "[[tag]]\npath = 'a'": "unknown key 'tag'; valid: registers, ",
    "[registers]\na = { type = 'INT', start = 4 }": "a: unknown key 'start'; valid: type, initial, comment",
    "[registers]\nb = 'INT'\na = { initial = 4 }": "cell.toml:3:1: error: a: type: this key is needed",
    f"[registers]\na = {'9' * 5000}": "cell.toml:2:1: error: a number has too many digits",
    f"[registers]\na = {{ type = 'INT', initial = 0x{'f' * 5000} }}": "2:1: error: a: initial: expected a number of",
    f"[registers]\n'{'/'.join('a' * 225)}' = 'INT'": "a path has at most 224 segments",
    "[registers]\nb = 'INT'\na = { type = 'ARRAY[1..3] OF INT', initial = [1, 2, 3, 4] }": "3:1: error: a: initial: "
    "expected at most 3 values, found more",
    "[registers]\na = { type = 'ARRAY[1..3] OF INT', initial = '1, 3(2)' }": "expected at most 3 values, found more",
    "[registers]\na = { type = 'ARRAY[0..1, 0..1] OF INT', initial = [1, 2, 3, 4, 5] }": "expected at most 4 values",
    "[registers]\nb = 'INT'\na = { type = 'ARRAY[0..1, 0..1] OF INT', initial = [[1, 2], [3]] }": "3:1: error: a: "
    "initial: expected one flat list",
    '[registers]\nb = "INT"\n"a\\u0000b" = "INT"': r"3:1: error: a\x00b: 'a\x00b': a path must not contain control",
    '[registers]\nb = "INT"\n"a\\nb" = "INT"': r"cell.toml:3:1: error: a\nb: 'a\nb': a path must not contain control",
    "[registers]\n'a%0Ab' = 'INT'": "cell.toml:2:1: error: a%0Ab: 'a%0Ab': a path must not contain control",
    "[registers]\na = 'INT'\nb = 'INT'\na = 'INT'": "cell.toml:4:1: error: a: this key is given twice",
    "[registers]\n'b/c' = 'INT'\n'b/c' = { type = 'ARRAY[1..2] OF INT', initial = [\n1,\n2] }\nd = 'INT'": "cell.toml"
    ":3:1: error: 'b/c': this key is given twice",
    "[registers]\na = 'INT'\na.b = 'INT'\n": "3:1: error: a.b: this key is given twice; write a path with a dot in",
    "[registers]\nab = 'INT'\na.b = 'INT'": "3:1: error: a: unknown key 'b'; valid: type, "
    "initial, comment, unit, address, scale, deadband, writable, word_order, byte_order; write a path with a dot in "
    'quotes, "a.b"',
    "[registers]\na = { type = 'INT', quality = 'q' }": "2:1: error: a: unknown key 'quality'; quality is a key of a",
    "[registers]\na.time = 'INT'": 'write a path with a dot in quotes, "a.time"',
    "[registers]\na/b = 'INT'": "write a path in quotes",
    "name = 'a'\n[registers]\nb = 'INT'\n[registers.name]\ntype = 'INTEGER'": "4:1: error: name: unknown type",
}


@pytest.mark.parametrize("text", WRONG)
def test_fault_is_named_with_its_line(text: str) -> None:
    assert WRONG[text] in refusal(text)


def test_an_array_of_several_dimensions_takes_one_list() -> None:
    layout = compiled("[registers]\na = { type = 'ARRAY[0..1, 0..2] OF INT', initial = [1, 2, 3, 4, 5, 6] }")
    frame, _ = initial_frame(layout)
    assert codec(layout.registers[0], "little").decode(bytes(frame)) == [[1, 2, 3], [4, 5, 6]]


def test_paths_that_differ_in_case_only_are_warned_of() -> None:
    text = "[registers]\n'a/Pos' = 'INT'\nb = 'INT'\n'A/pos' = 'INT'"
    found = compile_sources([Source("cell.toml", text.encode())])
    assert [register.path for register in found.layouts[0].registers] == ["a/Pos", "b", "A/pos"]
    assert [str(warning) for warning in found.warnings] == [
        "cell.toml:4:1: warning: A/pos: this path differs from a/Pos only in upper and lower case"
    ]


def test_file_that_is_not_utf8_is_refused() -> None:
    assert "cell.toml:2:1: error: the file is not UTF-8" in refusal(b"[registers]\n\xff = 'INT'")


def test_a_tag_table_needs_no_source_beside_it_but_that_of_a_data_block() -> None:
    with pytest.raises(LayoutError, match="the files have no DATA_BLOCK"):
        compile_sources([Source("a.toml", b"[registers]\na = 'INT'"), Source("b.udt", b"")])


@given(st.text(max_size=200) | st.binary(max_size=200))
def test_anything_is_compiled_or_refused(data: str | bytes) -> None:
    body = data.encode("utf-8", "replace") if isinstance(data, str) else data
    for text in (body, b"[registers]\n" + body, b"[registers]\na = '" + body + b"'"):
        try:
            layout = compiled(text)
        except LayoutError:
            continue
        assert load_layout(layout.to_json()) == layout


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ('{ type = "BOOL", scale = 2 }', "a BOOL cannot be scaled"),
        ('{ type = "REAL", scale = 0 }', "a finite factor other than 0"),
        ('{ type = "REAL", scale = [1, inf] }', "a finite factor"),
        ('{ type = "REAL", scale = [1, 2, 3] }', "scale"),
        ('{ type = "STRING[4]", deadband = 1 }', "has no dead-band"),
        ('{ type = "REAL", deadband = -1 }', "deadband"),
        ('{ type = "REAL", deadband = inf }', "a finite number"),
        ('{ type = "REAL", unit = "' + "m" * 65 + '" }', "unit"),
        ('{ type = "REAL", writable = 1 }', "writable"),
        ('{ type = "REAL", address = 4 }', "address"),
    ],
)
def test_a_wrong_column_is_named_with_its_line(entry: str, message: str) -> None:
    assert message in (text := refusal(f"[registers]\na = {entry}"))
    assert text.startswith("cell.toml:2:1: error: a: ")


def test_members_of_a_structure_share_its_columns() -> None:
    (layout,) = compile_sources(
        [Source("x.toml", b'[registers]\np = { type = "Point", unit = "mm", writable = true }')]
    ).layouts
    assert {(one.unit, one.writable) for one in layout.registers} == {("mm", True)}
