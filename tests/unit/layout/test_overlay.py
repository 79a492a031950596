"""Tag tables over a data block: where their registers lie, and errors with their lines."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.errors import LayoutError
from shmio.layout.compiler import Compiled, Source, compile_sources
from shmio.layout.document import load_layout, load_part
from shmio.layout.image import initial_frame
from shmio.layout.model import INTEGERS, Layout, Register, element_type
from shmio.layout.topic import find
from shmio.layout.values.codec import codec
from shmio.layout.values.frame_codec import FrameCodec
from shmio.layout.values.write import apply, bits_of, cover, elements, encode, paths_of
from shmio.model.statuses import GOOD, RegisterStatus, StatusArea

ROOT = Path(__file__).parents[3]
A50 = (ROOT / "db201.db").read_bytes()
SMALL = b"""DATA_BLOCK "cell" { S7_Optimized_Access := 'FALSE' } STRUCT
  Inputs : Array[0..9] of Byte; Status : Word; Wide : DWord; Level : Real; Flags : Array[0..10] of Bool;
  Axis : Struct Position : Real; END_STRUCT; Text : String[4] := 'abc';
END_STRUCT; BEGIN END_DATA_BLOCK
"""
NAMES = """
[registers]
DoorClosed = "Inputs/8.%X0"
"door/Speed" = { address = "Inputs/10", type = "REAL", unit = "mm/s", comment = "of the door" }
Release = { address = '"DB201".Outputs[13].%X6', writable = true }
lamps = { address = "Outputs/20.%X2", type = "ARRAY[1..9] OF BOOL" }
Both = { address = "Inputs/4..5", type = "WORD" }
Some = "Inputs/4..5"
Axis = "Robot_800/Axs1_Pos"
"""


def compiled(names: str | bytes, block: bytes = A50, file: str = "names.toml") -> Compiled:
    data = names.encode() if isinstance(names, str) else names
    return compile_sources([Source("db201.db", block), Source(file, data)])


def overlaid(names: str | bytes, block: bytes = A50, file: str = "names.toml") -> Layout:
    return compiled(names, block, file).layouts[0]


def small(address: str, kind: str = "") -> Register:
    given_type = f', type = "{kind}"' if kind else ""
    return overlaid(f'[registers]\nit = {{ address = "{address}"{given_type} }}', SMALL).registers[-1]


def refusal(names: str | bytes, block: bytes = SMALL, file: str = "names.toml") -> str:
    with pytest.raises(LayoutError) as error:
        overlaid(names, block, file)
    assert "\n" not in str(error.value)
    return str(error.value)


def test_names_follow_the_registers_of_the_block_which_stay_as_they_are() -> None:
    layout, bare = overlaid(NAMES), compile_sources([Source("db201.db", A50)]).layouts[0]
    assert layout.own == bare.registers
    assert layout.base.hash == bare.hash != layout.hash
    assert (layout.size, layout.name, layout.number) == (bare.size, bare.name, bare.number)
    assert [(one.path, one.type, one.dims, one.offset, one.bit) for one in layout.registers[len(layout.own) :]] == [
        ("DoorClosed", "BOOL", (), 8, 0),
        ("door/Speed", "REAL", (), 10, None),
        ("Release", "BOOL", (), 1013, 6),
        ("lamps", "BOOL", ((1, 9),), 1020, 2),
        ("Both", "WORD", (), 4, None),
        ("Some", "BYTE", ((4, 5),), 4, None),
        ("Axis", "REAL", (), 2108, None),
    ]
    speed = find(layout, "door/Speed")
    assert (speed.unit, speed.comment, speed.over, speed.writable) == ("mm/s", "of the door", "Inputs/10", False)
    assert find(layout, "Release").writable


def test_a_stored_layout_keeps_the_names() -> None:
    layout = overlaid(NAMES)
    assert load_layout(layout.to_json()) == layout
    assert load_layout(layout.with_statuses().to_json()) == layout.with_statuses()


def test_a_part_of_a_layout_with_names_has_own_registers_only() -> None:
    """The layout of a name alone would not be one: its block has no register."""
    layout = overlaid(NAMES)
    for path in ("DoorClosed", "door/Speed", "lamps/3", "Both"):
        find(layout, path)
        assert load_part(layout.to_json(), path) is None
    part = load_part(layout.to_json(), "Robot_800/Axs1_Pos")
    assert part is not None
    assert find(part, "Robot_800/Axs1_Pos") == find(layout, "Robot_800/Axs1_Pos")


def test_a_csv_names_bits_too() -> None:
    layout = overlaid("path;address;type;writable\nDoor;Inputs/8.%X0;;x\nSpeed;Inputs/10;REAL;\n", file="names.csv")
    assert layout.registers[-2:] == (
        Register("Door", "BOOL", (), 8, 0, 1, 1, over="Inputs/8.%X0", writable=True),
        Register("Speed", "REAL", (), 10, None, 4, 1, over="Inputs/10"),
    )


@pytest.mark.parametrize("page", ["how-to/use-a-tag-list.md", "reference/layout-rules.md"])
def test_the_examples_of_the_pages_lie_over_the_a50_block(page: str) -> None:
    text = (ROOT / "docs" / page).read_text()
    (example,) = [toml for toml in re.findall(r"```toml\n(.*?)```", text, re.DOTALL) if "Inputs/8.%X0" in toml]
    door = find(overlaid(example), "DoorClosed")
    assert (door.type, door.offset, door.bit) == ("BOOL", 8, 0)


@pytest.mark.parametrize(
    ("address", "kind", "place"),
    [
        ("Status.%X0", "", ("BOOL", 11, 0)),  # bit 0 is the lowest: in the last byte of a big-endian word
        ("Status.%X8", "", ("BOOL", 10, 0)),
        ("Status.%B0", "", ("BYTE", 11, None)),
        ("Wide.%W0", "INT", ("INT", 14, None)),
        ("Wide", "REAL", ("REAL", 12, None)),
        ("Inputs/9", "SINT", ("SINT", 9, None)),
        ("Inputs", "STRING[8]", ("STRING[8]", 0, None)),
        ("Inputs/2..5", "TIME", ("TIME", 2, None)),
        ("Flags/9", "", ("BOOL", 21, 1)),
        ("Flags/3..9", "ARRAY[0..6] OF BOOL", ("BOOL", 20, 3)),
        ("Inputs/3", "ARRAY[0..15] OF BOOL", ("BOOL", 3, 0)),
        ("Text", "", ("STRING[4]", 26, None)),
    ],
)
def test_where_a_name_lies(address: str, kind: str, place: tuple[str, int, int | None]) -> None:
    found = small(address, kind)
    assert (found.type, found.offset, found.bit) == place


REFUSED = {
    'a = "Inputs/10"': "a: Inputs: index [10] is outside [0..9]",
    'a = "Inputs/1.%X8"': "Inputs/1.%X8: BYTE has bits 0 to 7",
    'a = "inputs/1"': "inputs/1: cell has no such register; did you mean 'Inputs/1'",
    'a = "Inputs.%X1"': "Inputs.%X1: an array has no such part",
    'a = "Axis"': "Axis: this is a structure, not a register; it contains Axis/Position",
    'a = "DB201.DBX8.0"': "DB201.DBX8.0 is an address in the controller; a table over cell names its "
    "registers, such as Inputs/0.%X0; a table of addresses is a layout of its own, without cell",
    'a = "%I8.0"': "%I8.0 is an address in the controller",
    'a = { type = "BOOL" }': "a: address: this key is needed; name a register of cell, such as Inputs/0.%X0",
    'a = { address = "Inputs/7", type = "REAL" }': "a: type: REAL needs 4 bytes, but from Inputs/7 on there are only 3",
    'a = { address = "Inputs/7..9", type = "REAL" }': "a: type: REAL needs 4 bytes, but Inputs/7..9 has 3",
    'a = { address = "Wide", type = "INT" }': "INT needs 2 bytes, but Wide has 4; name a part of it, such as Wide.%W0",
    'a = { address = "Inputs/7", type = "BOOL" }': "a: type: a BOOL needs the address of a bit, such as Inputs/7.%X0",
    'a = { address = "Inputs/7.%X0", type = "BYTE" }': "a: type: Inputs/7.%X0 is a BOOL, so it cannot be read as BYTE",
    'a = { address = "Inputs/9.%X1", type = "ARRAY[0..7] OF BOOL" }': "8 bits are needed, but Inputs/9.%X1 has 7",
    'a = { address = "Wide.%X1", type = "ARRAY[0..7] OF BOOL" }': "an array of BOOL needs bytes and one dimension",
    'a = { address = "Level", type = "DWORD" }': "only bytes and integers can be read as another type",
    'a = { address = "Inputs/7", type = "FLOAT" }': "a: unknown type 'FLOAT'",
    'a = { address = "Inputs/7", initial = 3 }': "a: initial: leave out this key, because the initial values are "
    "those of cell",
    'a = { address = "Inputs/7", scale = 0.1 }': "a: scale: leave out this key, because a name over a data block "
    "shows the bytes of cell as they",
    'a = { address = "Inputs/7", deadband = 1 }': "a: deadband: ",
    'a = { adress = "Inputs/7" }': "a: unknown key 'adress'; did you mean 'address'?",
    'Level = "Inputs/7"': "Level: cell has a register of this path; choose another path",
    'Axis = "Inputs/7"': "Axis: cell has a structure of this path; choose another one",
    '"Inputs/7" = "Inputs/7"': "Inputs/7: Inputs is already a register; choose another path",
    'a = "Inputs/1"\n"a/b" = "Inputs/2"': "a/b: a is already a register",
    '"a/in" = "Inputs/1"': "a/in: leave out /in or /out at the end of the path",
    'a = "b"\nb = "Inputs/1"': "a: b: cell has no such register",
}


@pytest.mark.parametrize("names", REFUSED)
def test_what_does_not_fit_is_refused_by_name_and_line(names: str) -> None:
    text = refusal(f"[registers]\n{names}")
    assert REFUSED[names] in text
    assert text.startswith("names.toml:")


def test_a_table_that_is_given_without_its_block_says_so() -> None:
    with pytest.raises(
        LayoutError, match=r'together with the block\'s source: layout = "cell\.db" and tags = "names\.toml"'
    ):
        compile_sources([Source("names.toml", NAMES.encode())])


def test_two_tables_need_a_block_and_lie_over_it_together() -> None:
    one, other = Source("one.toml", b'[registers]\na = "Inputs/1"'), Source("other.csv", b"path,address\nb,Inputs/2\n")
    with pytest.raises(LayoutError, match="there are several tag tables without a data block"):
        compile_sources([one, other])
    layout = compile_sources([other, Source("cell.db", SMALL), one]).layouts[0]
    assert [register.path for register in layout.registers[-2:]] == ["b", "a"]
    with pytest.raises(LayoutError, match="a: another table has this register"):
        compile_sources([one, Source("cell.db", SMALL), Source("third.toml", one.text)])


def test_of_several_blocks_a_table_names_its_own() -> None:
    blocks = SMALL + SMALL.replace(b'"cell"', b'"other"')
    assert (
        'names.toml:1:1: error: the sources have several data blocks (cell, other); choose one by block = "NAME"'
        in refusal('[registers]\na = "Inputs/1"', blocks)
    )
    assert "block: unknown data block 'third'; did you mean 'other'?" in refusal(
        'block = "third"\n[registers]\na = "Inputs/1"', blocks
    )
    first, second = compiled('block = "Other"\n[registers]\na = "Inputs/1"', blocks).layouts
    assert ("a" in first.by_path, "a" in second.by_path) == (False, True)
    sources = [Source("cell.db", blocks), Source("names.toml", b'[registers]\na = "Inputs/1"')]
    assert "a" in compile_sources(sources, blocks=["cell"]).layouts[0].by_path
    sources[1] = Source("names.toml", b'block = "other"\n' + sources[1].text)
    left_out = compile_sources(sources, blocks=["cell"])
    assert "a" not in left_out.layouts[0].by_path
    assert "the names of this table are left out: it is for other, but cell is read" in str(left_out.warnings[0])


def test_a_path_that_differs_only_in_case_gets_a_warning() -> None:
    warnings = compiled('[registers]\nLEVEL = "Inputs/1"', SMALL).warnings
    assert [str(one) for one in warnings] == [
        "names.toml:2:1: warning: LEVEL: this path differs from Level only in upper and lower case"
    ]


def test_initial_values_are_those_of_the_block() -> None:
    names = '[registers]\na = "Text"\nb = { address = "Inputs/0", type = "STRING[8]" }'
    bare = compile_sources([Source("cell.db", SMALL)]).layouts[0]
    assert initial_frame(overlaid(names, SMALL)) == initial_frame(bare)


def test_writes_are_named_by_the_block() -> None:
    layout = overlaid(NAMES)
    assert paths_of(layout, encode(find(layout, "Release"), True)) == ["Outputs/13.%X6"]


def test_elements_and_slices_of_a_row_that_begins_within_a_byte() -> None:
    layout = overlaid(NAMES)
    places = [(one.offset, one.bit) for one in elements(layout, find(layout, "lamps"))]
    assert places == [(1020, bit) for bit in range(2, 8)] + [(1021, bit) for bit in range(3)]
    part = find(layout, "lamps/6..8")
    image = bytearray(layout.size)
    for write in encode(part, [True, False, True]):
        apply(write, image)
    assert image[1020:1022] == b"\x80\x02"
    assert codec(find(layout, "lamps")).decode(image) == [False] * 5 + [True, False, True, False]


def test_patterns_cover_the_bits_of_a_row_and_no_others() -> None:
    layout = overlaid('[registers]\nrow = { address = "Inputs/3.%X2", type = "ARRAY[0..2] OF BOOL" }', SMALL)
    assert cover(layout, ["row"]) == bytes([0, 0, 0, 0b11100]).ljust(layout.size, b"\0")


def test_a_name_has_the_status_of_what_it_lies_over() -> None:
    layout = overlaid('[registers]\na = "Status.%X9"\nb = "Level"\nc = "Inputs/9"', SMALL).with_statuses()
    area, image = StatusArea(layout), bytearray(layout.size)
    area.put(image, layout.by_path["Status"], RegisterStatus(0x80050000, 7))
    codes = [area.get(image, area.index(find(layout, path))).code for path in "abc"]
    assert codes == [0x80050000, GOOD, GOOD]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('"offset":8,"bit":0', '"offset":9,"bit":0'),
        ('"offset":8,"bit":0', '"offset":8,"bit":1'),
        ('"over":"Inputs/8.%X0"', '"over":"Inputs/8888.%X0"'),
        ('"over":"Inputs/8.%X0"', '"over":"DoorClosed"'),
        ('"over":"Inputs/10"', '"over":"Inputs/998"'),
        (',"over":"Inputs/8.%X0"', ""),
    ],
)
def test_a_stored_layout_that_contradicts_itself_is_refused(old: str, new: str) -> None:
    text = overlaid(NAMES).to_json().decode()
    assert text.count(old) == 1
    with pytest.raises(LayoutError):
        load_layout(text.replace(old, new).encode())


@given(st.text(max_size=60), st.text(max_size=20))
def test_any_address_and_type_are_laid_or_refused(address: str, kind: str) -> None:
    names = "path,address,type\n" + ",".join('"' + text.replace('"', '""') + '"' for text in ("a", address, kind))
    try:
        layout = overlaid(names, SMALL, "names.csv")
    except LayoutError:
        return
    assert load_layout(layout.to_json()) == layout


_ADDRESS = st.from_regex(
    r"(Inputs|Status|Wide|Level|Flags|Text|Axis/Position)(/-?[0-9]{1,2}(\.\.[0-9]{1,2})?)?(\.%[XBWD][0-9]{1,2})?",
    fullmatch=True,
)
_KIND = st.from_regex(r"(ARRAY\[[0-3]\.\.[0-9]\] OF )?(BOOL|BYTE|INT|REAL|LREAL|STRING\[3\]|DTL|DATE)", fullmatch=True)


@given(st.text(max_size=200))
def test_any_table_is_laid_or_refused(text: str) -> None:
    for body in (text, f"[registers]\n{text}", f"[registers]\na = '{text}'", f"[registers]\n'{text}' = 'Level'"):
        try:
            layout = overlaid(body, SMALL)
        except LayoutError:
            continue
        assert load_layout(layout.to_json()) == layout


@given(_ADDRESS, _KIND | st.just(""))
def test_a_name_never_reaches_beyond_what_it_lies_over(address: str, kind: str) -> None:
    try:
        found = small(address, kind)
    except LayoutError:
        return
    member = re.match("[A-Za-z]+(/Position)?", address)
    assert member is not None
    holder = find(overlaid('[registers]\nit = "Level"', SMALL), member[0])
    assert holder.offset <= found.offset
    assert found.offset + found.size <= holder.offset + holder.size
    for at, bits in enumerate(bits_of(found), found.offset - holder.offset):
        assert bits & ~bits_of(holder)[at] == 0


# -- any names over any block ------------------------------------------------------------------------------------------

_KINDS = sorted(INTEGERS)
_VIEWS = ["REAL", "LREAL", "INT", "UDINT", "WORD", "SINT", "BYTE", "ULINT"]


@st.composite
def cells(draw: st.DrawFn) -> tuple[Layout, bytes]:
    """A data block, names over it, and an image."""
    members, names = [], {}
    for number in range(draw(st.integers(1, 4))):
        kind = draw(st.sampled_from(_KINDS))
        element = element_type(kind)
        assert element is not None
        low = draw(st.integers(-2, 3))
        length = draw(st.integers(0, 9))
        members.append(f"m{number} : {f'ARRAY[{low}..{low + length - 1}] OF ' if length else ''}{kind};")
        at = draw(st.integers(0, max(0, length - 1)))
        one = f"m{number}/{low + at}" if length else f"m{number}"
        names[f"bit{number}"] = f'"{one}.%X{draw(st.integers(0, 8 * element.size - 1))}"'
        if element.size > 1:
            names[f"byte{number}"] = f'"{one}.%B{draw(st.integers(0, element.size - 1))}"'
        if length:
            last = draw(st.integers(at, length - 1))
            names[f"slice{number}"] = f'"m{number}/{low + at}..{low + last}"'
            fitting = [
                view for view in _VIEWS if (found := element_type(view)) and found.size <= (length - at) * element.size
            ]
            if fitting:
                names[f"view{number}"] = f'{{ address = "{one}", type = "{draw(st.sampled_from(fitting))}" }}'
    body = f"STRUCT {' '.join(members)} END_STRUCT; BEGIN END_DATA_BLOCK"
    text = f"DATA_BLOCK DB1 {{ S7_Optimized_Access := 'FALSE' }} {body}"
    table = "[registers]\n" + "\n".join(f"{path} = {over}" for path, over in names.items())
    layout = overlaid(table, text.encode())
    return layout, draw(st.binary(min_size=layout.size, max_size=layout.size))


@given(cells())
def test_a_name_reads_and_writes_the_bytes_that_it_lies_over(cell: tuple[Layout, bytes]) -> None:
    layout, image = cell
    assert load_layout(layout.to_json()) == layout
    (row,) = FrameCodec(layout).decode(image)
    for register in layout.registers[len(layout.own) :]:
        named, own = find(layout.base, register.over), codec(register)
        value = own.decode(image)
        assert repr(row[register.path].tolist()) == repr(value), "arrays of frames differ"
        if register.path.startswith("view"):
            expected = codec(Register("", register.type, (), 0, None, register.size, 1)).decode(
                image[named.offset : named.offset + register.size]
            )
            assert struct.pack(">d", value) == struct.pack(">d", expected)
        else:
            assert value == codec(named).decode(image)
            integer, _, bit = register.over.partition(".%X")
            if bit:
                whole = codec(find(layout, integer)).decode(image)
                assert isinstance(whole, int)
                assert value == bool(whole >> int(bit) & 1)
        new = bytearray(image)
        flipped = bytearray(byte ^ 0xFF for byte in image)
        for write in encode(register, own.decode(bytes(flipped))):
            apply(write, new)
        if register.type == "BOOL":
            assert new[register.offset] ^ image[register.offset] == 1 << (register.bit or 0)
        start, stop = register.offset, register.offset + register.size
        assert bytes(new[:start] + new[stop:]) == image[:start] + image[stop:], "a neighbour has changed"
