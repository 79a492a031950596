"""Instance data blocks, constants, structured initial values, system types, protected blocks."""

from __future__ import annotations

import pytest

from shmio.errors import LayoutError
from shmio.layout.compiler import Compiled, Source, compile_sources
from shmio.layout.model import Layout

TIA_FB = """
FUNCTION_BLOCK "axis"
{ S7_Optimized_Access := 'FALSE' }
VERSION : 0.1
   VAR_INPUT
      "in" { S7_SetPoint := 'True'} : Bool;
      source : Variant;
   END_VAR
   VAR CONSTANT
      N : Int := 2;
   END_VAR
   VAR
      list : Array[0..#N] of Real := [1.5, 2(#N)];
   END_VAR
BEGIN
    #list[0] := SEL(G := #"in", IN0 := 0.0, IN1 := 'not a $'string');
    // END_FUNCTION_BLOCK
    #type := #data_block;
END_FUNCTION_BLOCK
"""
INSTANCE = 'DATA_BLOCK "axis_DB"\n{ S7_Optimized_Access := \'FALSE\' }\nVERSION : 0.1\nNON_RETAIN\n"axis"\nBEGIN\n'
END = "END_DATA_BLOCK\n"


def compile_text(*texts: str) -> Compiled:
    return compile_sources([Source(f"{i}.scl", text.encode()) for i, text in enumerate(texts)])


def layout_of(*texts: str) -> Layout:
    (layout,) = compile_text(*texts).layouts
    return layout


def error(*texts: str) -> str:
    with pytest.raises(LayoutError) as caught:
        compile_text(*texts)
    return str(caught.value).splitlines()[0]


def block(members: str) -> str:
    return f'DATA_BLOCK "b" STRUCT\n{members}\nEND_STRUCT; BEGIN\nEND_DATA_BLOCK\n'


def places(layout: Layout) -> dict[str, float]:
    return {register.path: register.offset + (register.bit or 0) / 10 for register in layout.registers}


def initials(members: str, *more: str) -> dict[str, str | None]:
    return {register.path: register.initial for register in layout_of(block(members), *more).registers}


# -- function blocks and their instances ---------------------------------------------------------------------


def test_an_instance_has_the_interface_of_its_function_block() -> None:
    for texts in ((TIA_FB, INSTANCE + END), (INSTANCE + END, TIA_FB), (TIA_FB + INSTANCE + END,)):
        compiled = compile_text(*texts)
        (layout,) = compiled.layouts
        assert [(r.path, r.offset, r.size, r.initial) for r in layout.registers] == [
            ("%69n", 0, 1, None),
            ("list", 2, 12, "[1.5, 2(2)]"),
        ]
        assert not compiled.warnings


def test_an_instance_is_assigned_after_begin() -> None:
    layout = layout_of(TIA_FB, f'{INSTANCE} "in" := TRUE; list[2] := 3.5;\n{END}')
    assert [register.initial for register in layout.registers] == ["TRUE", "[1.5, 2, 3.5]"]


def test_an_instance_of_an_optimized_function_block_is_optimized() -> None:
    compiled = compile_text(TIA_FB.replace("FALSE", "TRUE"), f'DATA_BLOCK "d" "axis" BEGIN {END}')
    assert compiled.layouts[0].optimized
    assert "Optimized block access" in compiled.warnings[0].message


def test_instances_within_instances_and_system_function_blocks() -> None:
    text = """
        FUNCTION_BLOCK FB 3 VAR v : INT; END_VAR BEGIN END_FUNCTION_BLOCK
        FUNCTION_BLOCK FB 2
          VAR kept : DWORD; inner : FB 3; END_VAR
          VAR_INPUT given : DINT; END_VAR
          VAR_OUTPUT taken : WORD; END_VAR
        BEGIN END_FUNCTION_BLOCK
        FUNCTION_BLOCK FB 1
          VAR g0 : WORD; drive : FB 2; g1 : WORD; count : SFB 0; g2 : WORD; wait : TON; END_VAR
        BEGIN END_FUNCTION_BLOCK
        DATA_BLOCK DB 1
          FB 1
          TITLE = after the name, too
          AUTHOR : shmio
        BEGIN
        END_DATA_BLOCK
    """
    # The absolute addresses are from a public test of a soft PLC; TON is from Siemens' interface.
    layout = layout_of(text)
    assert (layout.number, layout.size) == (1, 50)
    assert places(layout) == {
        "g0": 0,
        "drive/given": 2,
        "drive/taken": 6,
        "drive/kept": 8,
        "drive/inner/v": 12,
        "g1": 14,
        "count/CU": 16,
        "count/R": 16.1,
        "count/PV": 18,
        "count/Q": 20,
        "count/CV": 22,
        "count/CUO": 24,
        "g2": 26,
        "wait/IN": 28,
        "wait/PT": 30,
        "wait/Q": 34,
        "wait/ET": 36,
        "wait/STATE": 40,
        "wait/STIME": 42,
        "wait/ATIME": 46,
    }


def test_many_unfinished_function_blocks_end_in_an_error() -> None:
    unfinished = 'FUNCTION_BLOCK "f" VAR_TEMP a : Int; END_FUNCTION_BLOCK ' * 20_000
    assert "declared twice" in error(unfinished + block("a : Int;"))
    assert "has no END_FUNCTION_BLOCK" in error('FUNCTION_BLOCK "f" VAR a : Int; END_VAR ' * 20_000)


def test_constant_uses_the_constants_at_its_declaration() -> None:
    fb = 'FUNCTION_BLOCK "f" VAR CONSTANT N : Int := 9; END_VAR VAR a : Array[1..LAST] of Byte; END_VAR '
    fb += "END_FUNCTION_BLOCK "
    given = "VAR CONSTANT N : Int := 2; LAST : Int := N + 1; END_VAR "
    assert layout_of(given + fb + f'DATA_BLOCK "d" "f" BEGIN {END}').registers[0].count == 3


def test_faults_of_a_function_block_count_only_with_an_instance() -> None:
    faulty = 'FUNCTION_BLOCK "odd" VAR_INPUT a : ; b : Nope; END_VAR x := 1; END_FUNCTION_BLOCK '
    assert layout_of(faulty + block("a : Int;")).size == 2
    assert "0.scl:1:36: error: expected a type" in error(f'{faulty} DATA_BLOCK "d" "odd" BEGIN {END}')
    unknown = 'FUNCTION_BLOCK "f" VAR a : "Nope"; END_VAR BEGIN END_FUNCTION_BLOCK '
    assert layout_of(unknown + block("a : Int;")).size == 2
    assert "unknown type 'Nope'; if it is a PLC data type or a function block, name its source" in error(
        f'{unknown} DATA_BLOCK "d" "f" BEGIN {END}'
    )


def test_an_instance_without_members_is_empty() -> None:
    assert layout_of(f'FUNCTION_BLOCK "f" x := 1; END_FUNCTION_BLOCK DATA_BLOCK "d" "f" BEGIN {END}').size == 0


def test_huge_arrays_of_empty_structures_end_in_an_error() -> None:
    nothing = 'FUNCTION_BLOCK "f" VAR_INPUT v : Variant; END_VAR BEGIN END_FUNCTION_BLOCK '
    assert layout_of(nothing + block('a : Array[0..99] of "f"; b : Int;')).size == 2
    message = error(nothing + block('a : Array[0..2147483647] of "f" := [(1)];'))
    assert "expected at most 1048576 elements of arrays" in message


def nested(count: int, last: str) -> str:
    """Return types that each have three members of the next type, and the given last type."""
    return "".join(
        f'TYPE "t{i}" STRUCT\n a, b : "t{i + 1}";\n c : "t{i + 1}";\nEND_STRUCT; END_TYPE\n' for i in range(count)
    ) + last.format(f"t{count}")


@pytest.mark.parametrize(
    "last",
    [
        'FUNCTION_BLOCK "{}" VAR_TEMP i : Bool; END_VAR BEGIN END_FUNCTION_BLOCK\n',
        'FUNCTION_BLOCK "{}" VAR_INPUT v : Variant; END_VAR BEGIN END_FUNCTION_BLOCK\n',
    ],
)
def test_empty_structures_count_toward_the_limit(last: str) -> None:
    message = error(nested(29, last) + block('a : "t0";'))
    assert message.startswith("0.scl:75:")
    assert "expected at most 200000 structures in the type 't18'; up to this member there are 265719" in message


def test_empty_structures_beside_registers_are_left_out() -> None:
    members = 'a : "t0"; b : Array[0..99] of Int; c : Array[0..999] of Struct x : "t0"; y : Int; END_STRUCT;'
    layout = layout_of(nested(4, 'FUNCTION_BLOCK "{}" BEGIN END_FUNCTION_BLOCK\n') + block(members))
    assert layout.size == 200 + 2000
    assert places(layout)["c/999/y"] == 2198


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('FUNCTION_BLOCK "f" VAR a : Int; END_VAR BEGIN', "the function block 'f' has no END_FUNCTION_BLOCK"),
        ('FUNCTION_BLOCK "f" VAR_TEMP a : Int; END_FUNCTION_BLOCK', "expected END_VAR, found 'a'"),
        ("FUNCTION_BLOCK FB 1 : VOID VAR a : Int; END_VAR END_FUNCTION_BLOCK", "section of variables or BEGIN"),
        ('FUNCTION_BLOCK "f" VAR a : "f"; END_VAR BEGIN END_FUNCTION_BLOCK', "contains itself"),
    ],
)
def test_faulty_function_blocks(text: str, message: str) -> None:
    name = "FB 1" if "FB 1" in text else '"f"'
    assert message in error(f'{text} DATA_BLOCK "d" {name} BEGIN {END}')


# -- protected blocks ----------------------------------------------------------------------------------------


def test_a_protected_block_with_its_declaration_compiles() -> None:
    assert layout_of(block("a : Int;").replace("STRUCT", "KNOW_HOW_PROTECT STRUCT", 1)).size == 2


@pytest.mark.parametrize(
    "text",
    [
        f"DATA_BLOCK DB 5 KNOW_HOW_PROTECT BEGIN {END}",
        f'DATA_BLOCK "DB5"\nVERSION : 0.1\nKNOW_HOW_PROTECT\n{END}',
        'TYPE "DB5" KNOW_HOW_PROTECT END_TYPE',
        f'FUNCTION_BLOCK "DB5" KNOW_HOW_PROTECT BEGIN END_FUNCTION_BLOCK DATA_BLOCK "d" "DB5" BEGIN {END}',
    ],
)
def test_a_protected_block_without_its_declaration_is_refused(text: str) -> None:
    message = error(text)
    assert "'DB5' is know-how protected and its declaration is not in the source" in message
    assert "remove the protection" in message


# -- constants -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("bounds", "dims"),
    [
        ("0..MAX", (0, 4)),
        ('0.."MAX"', (0, 4)),
        ("0..#max", (0, 4)),
        ("-MAX..MAX + 1", (-4, 5)),
        ("1..2*MAX-LOW", (1, 6)),
        ("16#A..INT#11", (10, 11)),
    ],
)
def test_constants_as_bounds(bounds: str, dims: tuple[int, int]) -> None:
    constants = "VAR CONSTANT MAX : Int := 4; LOW : Int := MAX - 2; END_VAR"
    assert layout_of(constants, block(f"a : Array[{bounds}] of Int;")).registers[0].dims == (dims,)


def test_constants_of_a_block_shadow_global_ones() -> None:
    own = 'DATA_BLOCK "b" VAR CONSTANT N : Int := 3; END_VAR VAR a : Array[1..N] of Byte; t : "t"; END_VAR BEGIN '
    udt = 'TYPE "t" STRUCT a : String[N]; END_STRUCT; END_TYPE '
    layout = layout_of("VAR CONSTANT N : Int := 5; END_VAR", own + END, udt)
    assert [(r.count, r.type) for r in layout.registers] == [(3, "BYTE"), (1, "STRING[5]")]


def test_constants_as_initial_values() -> None:
    constants = "VAR CONSTANT A : Int := 7; B : Int := A; T : Time := T#1s; S : String := 'A'; END_VAR"
    members = 'a : Int := "A"; b : Int := B; c : Array[0..2] of Int := [#A, 2("B")]; d : Time := T; e : Word := 16#A;'
    assert initials(members + " f : String := 'A'; g : Int := \"X\"; h : String := S;", constants) == {
        "a": "7",
        "b": "7",
        "c": "[7, 2(7)]",
        "d": "T#1s",
        "e": "16#A",
        "f": "'A'",
        "g": '"X"',
        "h": "'A'",
    }


@pytest.mark.parametrize(
    ("constants", "member", "message"),
    [
        (
            "",
            'a : Array[0.."N"] of Int;',
            "the constant 'N' is not in the sources; write its value here, or add a source",
        ),
        ("N : Int := M;", "a : Array[0..N] of Int;", "the constant 'M' is not in the sources"),
        ("N : Int := N;", "a : Array[0..N] of Int;", "the definition of the constant 'N' uses itself"),
        ("N : Real := 1.5;", "a : Array[0..N] of Int;", "expected a whole number, but the constant 'N'"),
        ("N : Int := 0;", "a : Array[1..N] of Int;", "expected a lower bound not above the upper, found 1..0"),
        ("N : Int := 300;", "a : String[N];", "expected a STRING length of 1 to 254, found 300"),
        ("N : DInt := 2147483647;", "a : Array[0..N+1] of Int;", "expected a whole number within 32 bits"),
        ("N : DInt := 2147483647;", "a : Array[0..N*N*N*N] of Int;", "expected a whole number within 32 bits"),
        ("N : Int := 1; N : Int := 2;", "a : Int;", "'N' is declared twice"),
        ("N : Int := ;", "a : Int;", "expected a value"),
        ("N : Int 1;", "a : Int;", "expected ':=' and the constant's value"),
        ("N : Int := 1", "a : Int;", "expected ';' after the value"),
    ],
)
def test_invalid_constants_are_refused(constants: str, member: str, message: str) -> None:
    sources = [block(member)]
    if constants:
        sources.append(f"VAR CONSTANT\n{constants}\nEND_VAR")
    assert message in error(*sources)


def test_long_sums_and_chains_of_constants_are_bounded() -> None:
    assert layout_of(block(f"a : Array[0..{'1+' * 50_000}1] of Bool;")).registers[0].count == 50_002
    doubled = "".join(f"C{i} : Int := C{i + 1} * C{i + 1} + C{i + 1};\n" for i in range(31))
    zero = f"VAR CONSTANT {doubled} C31 : Int := 0; END_VAR"
    assert layout_of(zero, block("a : Array[0..C0] of Int;")).registers[0].count == 1
    chain = "".join(f"C{i} : Int := C{i + 1};\n" for i in range(1000))
    assert "uses itself" in error(f"VAR CONSTANT {chain} END_VAR", block("a : Array[0..C0] of Int;"))


def test_constants_within_a_constant_do_not_grow_without_end() -> None:
    constants = 'VAR CONSTANT G : Int := ["G", "G", "G", "G"]; END_VAR'
    assert initials('a : Int := "G";', constants) == {"a": '["G", "G", "G", "G"]'}
    long = f"VAR CONSTANT L : String := '{'x' * 250}'; END_VAR"
    value = f"[{'#L, ' * 100}#L]"
    assert initials(f"a : Array[0..100] of String := {value};", long) == {"a": value}


# -- initial values of structures ----------------------------------------------------------------------------

POINT = 'TYPE "p" STRUCT x : Int := 1; y : Int; z : Struct u : Int := 3; v : Int; END_STRUCT; END_STRUCT; END_TYPE'


@pytest.mark.parametrize(
    ("value", "found"),
    [
        ("(7, 8, (9, 10))", ["7", "8", "9", "10"]),
        ("(7, (), (()))", ["7", None, "3", None]),
        ("(7)", ["7", None, "3", None]),
        ("((), 8, ())", ["1", "8", "3", None]),
        ("(y := 8, Z := (v := 10))", ["1", "8", "3", "10"]),
        ('("y" := 8)', ["1", "8", "3", None]),
        ("(2(7))", ["7", "7", "3", None]),
        ("[7, 8]", ["7", "8", "3", None]),
        ("()", ["1", None, "3", None]),
    ],
)
def test_initial_values_of_structures(value: str, found: list[str | None]) -> None:
    assert list(initials(f'a : "p" := {value};', POINT).values()) == found


def test_outermost_initial_value_wins() -> None:
    types = 'TYPE "o" STRUCT p : "p" := (4, 5); q : "p"; END_STRUCT; END_TYPE ' + POINT
    found = initials('a : "o" := (((), 6), (y := 7)); b : "o";', types)
    assert {path: value for path, value in found.items() if "/z/" not in path} == {
        "a/p/x": "4",
        "a/p/y": "6",
        "a/q/x": "1",
        "a/q/y": "7",
        "b/p/x": "4",
        "b/p/y": "5",
        "b/q/x": "1",
        "b/q/y": None,
    }


@pytest.mark.parametrize(
    ("value", "found"),
    [
        ("[(1, 2), (3, 4)]", ["1", "2", "3", "4", "0", None]),
        ("((1, 2), (3, 4))", ["1", "2", "3", "4", "0", None]),
        ("[(), 2((b := 5))]", ["0", None, "0", "5", "0", "5"]),
        ("([()], [7], [])", ["0", None, "7", None, "0", None]),
    ],
)
def test_initial_values_of_arrays_of_structures(value: str, found: list[str | None]) -> None:
    member = f"s : Array[1..3] of Struct a : Int := 0; b : Int; END_STRUCT := {value};"
    assert list(initials(member).values()) == found


def test_commas_in_texts_of_structures() -> None:
    assert list(initials("a : Struct s : String; t : String; END_STRUCT := ('a,(', ')');").values()) == ["'a,('", "')'"]


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("5", "expected a value such as (1, 2) or (a := 1, b := 2), found '5'"),
        ("(1, 2, 3)", "expected at most 2 values"),
        ("(9999999999(1))", "expected at most 2 values"),
        ("(c := 1)", "expected a member of the structure, found 'c'"),
    ],
)
def test_initial_values_that_cannot_be_read_are_reported(value: str, message: str) -> None:
    compiled = compile_text(block(f"s : Struct a : Int := 4; b : Int; END_STRUCT := {value};"))
    assert [register.initial for register in compiled.layouts[0].registers] == ["4", None]
    (warning,) = compiled.warnings
    assert f"the initial value of the structure 's' is ignored: {message}" in warning.message


def test_a_large_value_is_read_once_for_all_elements() -> None:
    value = "(" + "1," * 30_000 + ")"
    udt = f'TYPE "t" STRUCT s : Array[0..0] of Struct a : Int; END_STRUCT := {value}; END_STRUCT; END_TYPE'
    assert len(initials('a : Array[1..30000] of "t";', udt)) == 30_000


def test_texts_that_a_value_repeats_are_bounded() -> None:
    value = f"[10000(('{'x' * 4000}'))]"
    message = error(block(f"a : Array[1..10000] of Struct s : String[1]; END_STRUCT := {value};"))
    assert "the names, comments and values have more than 33554432 characters" in message


def test_comments_within_a_value_are_left_out() -> None:
    assert initials("a : Array[0..1] of Int := [1, // one\n (* two *) 2];") == {"a": "[1, 2]"}


# -- types of the system -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "size", "last"),
    [
        ("ErrorStruct", 28, ("DATA_ADDRESS/OFFSET", 24)),
        ("CREF", 8, ("OFFSET", 4)),
        ("NREF", 8, ("OFFSET", 4)),
        ("TCON_Param", 64, ("spare", 62)),
        ("TADDR_PARAM", 8, ("reserved", 6)),
        ("SSL_HEADER", 4, ("N_DR", 2)),
        ("CTU", 10, ("CUO", 8)),
        ("CTD", 10, ("CDO", 8)),
        ("CTUD", 10, ("CDO", 8.1)),
        ("SFB 3", 22, ("ATIME", 18)),
        ("TOF", 22, ("ATIME", 18)),
    ],
)
def test_system_types_have_the_stated_length(name: str, size: int, last: tuple[str, float]) -> None:
    layout = layout_of(block(f"a : {name}; after : Byte;"))
    found = list(places(layout).items())
    assert found[-2:] == [(f"a/{last[0]}", last[1]), ("after", size)]


def test_tcon_param_at_its_stated_bytes() -> None:
    found = places(layout_of(block("a : TCON_PARAM;")))
    assert list(found.values()) == [0, 2, 4, 5, 6, 7, 8, 9, 10, 11, 12, 28, 34, 40, 56, 62]


@pytest.mark.parametrize(
    ("name", "type_", "size"),
    [
        ("HW_ANY", "UINT", 2),
        ("ob_cyclic", "INT", 2),
        ("CONN_R_ID", "DWORD", 4),
        ("Remote", "ANY", 10),
        ("Timer", "UINT", 2),
    ],
)
def test_identifier_types_are_plain_values(name: str, type_: str, size: int) -> None:
    (register,) = layout_of(block(f"a : {name};")).registers
    assert (register.type, register.size) == (type_, size)


@pytest.mark.parametrize("name", ["TON_TIME", "CTU_INT", "TON_LTIME", "TCON_IP_v4", "R_TRIG", "VARIANT", "TCON"])
def test_system_types_without_a_public_placement_are_refused_with_the_remedy(name: str) -> None:
    message = error(block(f"a : {name};"))
    assert f"shmio does not know the members of the system type {name}" in message
    assert f'declare it as a PLC data type, TYPE "{name}" STRUCT' in message


def test_declared_type_replaces_the_built_in_one() -> None:
    given = 'TYPE "IEC_TIMER" STRUCT x : DInt; END_STRUCT; END_TYPE TYPE CREF STRUCT y : Byte; END_STRUCT; END_TYPE '
    assert places(layout_of(given + block("a : IEC_TIMER; b : CREF;"))) == {"a/x": 0, "b/y": 4}


# -- types of which only the size is known ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "size"),
    [("IEC_TIMER", 16), ("IEC_LTIMER", 32), ("IEC_COUNTER", 6), ("IEC_ULCOUNTER", 24), ("IEC_SCOUNTER", 3)],
)
def test_a_system_type_of_public_length_is_bytes_without_meaning(name: str, size: int) -> None:
    members = f"before : Array[0..98] of Byte; a : {name}; b : Bool; many : Array[1..3] of {name}; after : Int;"
    compiled = compile_text(block(members))
    (layout,) = compiled.layouts
    [warning] = compiled.warnings
    assert f"the system type '{name}' is kept as {size} bytes without meaning" in warning.message
    even = size + size % 2
    assert places(layout) == {
        "before": 0,
        "a/bytes": 100,
        "b": 100 + even,
        "many/1/bytes": 102 + even,
        "many/2/bytes": 102 + 2 * even,
        "many/3/bytes": 102 + 3 * even,
        "after": 102 + 4 * even,
    }
    assert layout.registers[1].size == size
    assert layout.registers[1].type == "BYTE"


def test_initial_values_of_an_unknown_structure_are_ignored() -> None:
    compiled = compile_text(f'DATA_BLOCK "T1" NON_RETAIN IEC_TIMER BEGIN PT := T#5s; {END}')
    assert places(compiled.layouts[0]) == {"bytes": 0}
    assert "the value is ignored" in compiled.warnings[1].message
    declared = 'TYPE "IEC_TIMER" STRUCT PT : Time; END_STRUCT; END_TYPE '
    assert places(layout_of(declared, block("a : IEC_TIMER;"))) == {"a/PT": 0}


def test_the_size_of_any_other_type_can_be_declared() -> None:
    text = block('big : Array[0..99] of Real; a : TON_TIME; b : "My FB"; c : Array[0..1] of "Axis";')
    given = 'TYPE "Axis" STRUCT x : Nope; END_STRUCT; END_TYPE '
    sources = [Source("x.db", (given + text).encode())]
    sizes = {"ton_time": 16, "My FB": 7, "Axis": 10, "Other": 4}
    with pytest.raises(LayoutError, match="'My FB'"):
        compile_sources(sources, blocks=["b"])
    compiled = compile_sources(sources, blocks=["b"], type_bytes=sizes)
    assert places(compiled.layouts[0]) == {
        "big": 0,
        "a/bytes": 400,
        "b/bytes": 416,
        "c/0/bytes": 424,
        "c/1/bytes": 434,
    }
    assert compiled.unused == ("Other",)
    assert not compiled.warnings


# -- one block of several --------------------------------------------------------------------------------------

OTHERS = """
TYPE "broken" STRUCT a : ; END_STRUCT; END_TYPE
TYPE "unknown" STRUCT a : "Nope"; END_STRUCT; END_TYPE
DATA_BLOCK "Timers" STRUCT t : TON_TIME; END_STRUCT; BEGIN END_DATA_BLOCK
DATA_BLOCK "Torn" STRUCT a : Int
END_STRUCT; BEGIN x ! y; END_DATA_BLOCK
DATA_BLOCK "Odd" STRUCT a b : Int; END_STRUCT; BEGIN a b := 1; END_DATA_BLOCK
DATA_BLOCK "Twice" STRUCT a : Int; END_STRUCT; BEGIN END_DATA_BLOCK
DATA_BLOCK "Twice" STRUCT a : Int; END_STRUCT; BEGIN END_DATA_BLOCK
"""


@pytest.mark.parametrize("text", [OTHERS + "{}", "{}" + OTHERS], ids=["behind", "before"])
def test_faults_of_other_blocks_are_ignored(text: str) -> None:
    plain = (
        'DATA_BLOCK "Plain" STRUCT a : Array[0..199] of Int; b : Bool; END_STRUCT; BEGIN b := TRUE; END_DATA_BLOCK\n'
    )
    sources = [Source("x.db", text.format(plain).encode())]
    compiled = compile_sources(sources, blocks=["PLAIN"])
    assert places(compiled.layouts[0]) == {"a": 0, "b": 400}
    assert not compiled.warnings
    with pytest.raises(LayoutError) as caught:
        compile_sources(sources)
    found = "\n".join(map(str, caught.value.diagnostics))
    for what in ("TON_TIME", "'Nope'", "expected a type", "';' at the end", "'Twice' is declared twice"):
        assert what in found
    for name, what in (("Timers", "TON_TIME"), ("Torn", "';' at the end"), ("Twice", "is declared twice")):
        with pytest.raises(LayoutError, match=what) as caught:
            compile_sources(sources, blocks=[name])
        assert len({error.line for error in caught.value.diagnostics}) == 1


def test_fault_of_a_type_that_the_block_uses_is_reported() -> None:
    text = OTHERS + 'DATA_BLOCK "Uses" STRUCT a : "broken"; END_STRUCT; BEGIN END_DATA_BLOCK\n'
    with pytest.raises(LayoutError, match="2:26: error: expected a type"):
        compile_sources([Source("x.db", text.encode())], blocks=["Uses"])


def test_many_large_blocks_of_a_small_source_are_bounded_together() -> None:
    text = 'TYPE "t" STRUCT a : Array[1..30000] of Struct b : Byte; END_STRUCT; END_STRUCT; END_TYPE\n'
    text += "".join(f'DATA_BLOCK DB{number} "t" BEGIN END_DATA_BLOCK\n' for number in range(1, 200))
    message = error(text)
    assert message.startswith("0.scl:18:12: error: the data blocks up to this one have more than 500000 registers")
    assert len(compile_sources([Source("x.db", text.encode())], blocks=["DB199"]).layouts[0].registers) == 30_000
