from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shmio.errors import LayoutError
from shmio.layout.compiler import Compiled, Source, compile_sources
from shmio.layout.document import load_layout
from shmio.layout.model import Layout, Register
from shmio.layout.report import MAX_ERRORS
from shmio.layout.source.lexer import MAX_SOURCE_BYTES, MAX_TOKENS


def compile_text(*texts: str) -> Compiled:
    return compile_sources([Source(f"{i}.db", text.encode()) for i, text in enumerate(texts)])


def block(members: str, begin: str = "", attributes: str = "") -> str:
    return f'DATA_BLOCK "b"\n{attributes}\nSTRUCT\n{members}\nEND_STRUCT;\nBEGIN\n{begin}\nEND_DATA_BLOCK\n'


def layout_of(*texts: str) -> Layout:
    (layout,) = compile_text(*texts).layouts
    return layout


def registers(members: str, begin: str = "") -> dict[str, Register]:
    return {register.path: register for register in layout_of(block(members, begin)).registers}


def errors(*texts: str) -> list[str]:
    with pytest.raises(LayoutError) as caught:
        compile_text(*texts)
    assert caught.value.diagnostics
    assert str(caught.value).splitlines()[0] == str(caught.value.diagnostics[0])
    return [str(diagnostic) for diagnostic in caught.value.diagnostics]


# -- what is accepted ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("bom", [b"", b"\xef\xbb\xbf"])
@pytest.mark.parametrize("newline", ["\n", "\r\n", "\r"])
def test_encodings_and_newlines(bom: bytes, newline: str) -> None:
    text = block('"Größe µ" : Int; // Höhe').replace("\n", newline)
    (layout,) = compile_sources([Source("x.db", bom + text.encode())]).layouts
    assert [(r.path, r.comment) for r in layout.registers] == [("Größe µ", "Höhe")]


def test_keywords_in_any_case_and_without_blanks() -> None:
    text = 'data_block "b" struct a:bool;B:ARRAY[ 0 .. 1 ]of INT:=[1,2];c:Struct d:string[3];end_struct;end_struct '
    layout = layout_of(text + "Begin end_data_block")
    assert [(r.path, r.type) for r in layout.registers] == [("a", "BOOL"), ("B", "INT"), ("c/d", "STRING[3]")]


@pytest.mark.parametrize(
    ("name", "path"),
    [
        ("50%", "50%25"),
        ("a/b", "a%2Fb"),
        ("a+b#c", "a%2Bb%23c"),
        ("in", "%69n"),
        ("out", "%6Fut"),
        ("In", "In"),
        ("a.b c", "a.b c"),
        ("轴1", "轴1"),
        ("END_STRUCT", "END_STRUCT"),
        (" // no comment", " %2F%2F no comment"),
        ("it's", "it's"),
    ],
)
def test_quoted_names(name: str, path: str) -> None:
    assert list(registers(f'"{name}" : Int;')) == [path]


def test_names_of_any_script_and_keywords_before_a_colon() -> None:
    members = "Осла : Int; データ : Int; Type : Int; Begin : Int; Name {a := 'b'} : Int; Title : Int; x, y : Bool;"
    assert list(registers(members)) == ["Осла", "データ", "Type", "Begin", "Name", "Title", "x", "y"]


@pytest.mark.parametrize("gap", [" ", "\t", "\x1f", "(* note *)", " (*\x1f*) "])
def test_gap_between_the_words_of_a_name_becomes_a_space(gap: str) -> None:
    text = block(f"fill{gap}level : Int;", f"fill{gap}level := 3;")
    layout = layout_of(text)
    assert [(r.path, r.initial) for r in layout.registers] == [("fill level", "3")]
    assert load_layout(layout.to_json()) == layout


def test_comments() -> None:
    found = registers(
        """
        a : Int; // of a
        // of nobody
        b (* inside *) : Int;
        c : Int := 1; (* of c *) // and more
        d : Struct // of the struct
           e : Int; (/* multi-
              lingual */)
        END_STRUCT; // also of the struct
        f : Int /* before */ ;
        g : Int;
        """
    )
    comments = {path: register.comment for path, register in found.items()}
    assert comments == {"a": "of a", "b": "", "c": "of c and more", "d/e": "multi- lingual", "f": "before", "g": ""}


def test_header_and_attributes() -> None:
    text = """
        DATA_BLOCK "b"
        TITLE = it's "free" text; DATA_BLOCK
        { S7_m_c := 'true'; S7_Optimized_Access := 'FALSE' }
        AUTHOR:Goosy
        FAMILY : 'x y'
        NAME : STRUCTURE
        VERSION : 0.1
        NON_RETAIN
           VAR RETAIN
              "a" { ExternalWritable := 'False'; S7_SetPoint := 'True'} : Int := 5;
           END_VAR
           VAR
              Retain : Bool;
           END_VAR
        BEGIN
        END_DATA_BLOCK
    """
    layout = layout_of(text)
    assert (layout.name, layout.optimized) == ("b", False)
    assert [(r.path, r.initial) for r in layout.registers] == [("a", "5"), ("Retain", None)]


@pytest.mark.parametrize(
    ("declared", "name", "number"),
    [
        ("DB201", "DB201", 201),
        ("db 7", "db7", 7),
        ('"DB201"', "DB201", None),
        ("DB0", "DB0", None),
        ("DB65535", "DB65535", 65535),
        ("DB65536", "DB65536", None),
        ("Cell", "Cell", None),
    ],
)
def test_block_numbers(declared: str, name: str, number: int | None) -> None:
    layout = layout_of(block("a : Int;").replace('"b"', declared))
    assert (layout.name, layout.number) == (name, number)


def test_optimized_block_warns() -> None:
    compiled = compile_text(block("a : Int;", attributes="{ s7_optimized_access := 'true' }"))
    assert compiled.layouts[0].optimized
    (warning,) = compiled.warnings
    assert warning.severity == "warning"
    assert "Optimized block access" in warning.message


UDT = 'TYPE "Point"\nVERSION : 0.1\nSTRUCT\n x : Real := 1.5; // left\n y : Real;\nEND_STRUCT;\nEND_TYPE\n'


def test_types_in_other_files_and_blocks_of_a_type() -> None:
    text = 'DATA_BLOCK "p"\nNON_RETAIN\n"point"\nBEGIN\n y := 2.5;\nEND_DATA_BLOCK\n' + block('a : "POINT"; b : Bool;')
    first, second = compile_text(text, UDT).layouts
    assert [(r.path, r.offset, r.initial) for r in first.registers] == [("x", 0, "1.5"), ("y", 4, "2.5")]
    assert [(r.path, r.offset, r.comment) for r in second.registers] == [
        ("a/x", 0, "left"),
        ("a/y", 4, ""),
        ("b", 8, ""),
    ]


def test_classic_type_names() -> None:
    udt = "TYPE UDT 10\nSTRUCT\n a : INT ;\nEND_STRUCT ;\nEND_TYPE\n"
    assert [r.path for r in layout_of(udt + block("u : UDT 10; v : UDT10;")).registers] == ["u/a", "v/a"]


def test_code_is_skipped_with_a_warning_that_names_it() -> None:
    code = "FUNCTION FC 1 : VOID\nBEGIN\n L 'it; // \"what\n END_FUNCTION\n"
    code += "ORGANIZATION_BLOCK OB 1 END_ORGANIZATION_BLOCK\n"
    compiled = compile_text(code + block("a : Int;"))
    assert [warning.message.split(" declares")[0] for warning in compiled.warnings] == [
        "FUNCTION 'FC'",
        "ORGANIZATION_BLOCK 'OB'",
    ]


@pytest.mark.parametrize(
    "value",
    [
        "TRUE",
        "-5",
        "16#FF_00",
        "2#1010",
        "1.5e-3",
        "T#1h_2m",
        "S5T#10s",
        "DT#2024-02-29-12:00:00.5",
        "TOD#12:30:00",
        "'it$'s; // no comment'",
        "WSTRING#'ä'",
        '"MY_CONST"',
        "P#DB1.DBX0.0 BYTE 10",
        "[1, 2, 3(0)]",
        "[1,\n 2]",
        "1, 2,\n 3(0)",
        "B#(1, 2)",
    ],
)
def test_initial_values_are_kept_as_written(value: str) -> None:
    found = registers(f"a : Int := {value}; // c\n b : Int;")
    assert (found["a"].initial, found["a"].comment, list(found)) == (value, "c", ["a", "b"])


def test_arrays_of_structures_are_expanded() -> None:
    found = registers("a : Array[1..2, -1..0] of Struct x : Bool; y : Array[0..2] of Int; END_STRUCT;")
    assert list(found) == [f"a/{i}/{j}/{m}" for i in (1, 2) for j in (-1, 0) for m in ("x", "y")]
    assert [r.offset for r in found.values()] == [0, 2, 8, 10, 16, 18, 24, 26]
    assert (found["a/1/0/y"].dims, found["a/1/0/y"].count, found["a/1/0/y"].size) == (((0, 2),), 3, 6)


def test_aliases_of_a_type_become_one_name() -> None:
    found = registers("a : TOD; b : DT; c : LTIME_OF_DAY; d : String; e : WString; f : DATE_AND_LTIME;")
    types = ["TIME_OF_DAY", "DATE_AND_TIME", "LTOD", "STRING[254]", "WSTRING[254]", "LDT"]
    assert [r.type for r in found.values()] == types


def test_begin_assigns_initial_values() -> None:
    found = registers(
        """a : Int := 1; s : Struct "x y" : Real; END_STRUCT;
        u : Array[1..2] of Struct n : Int; END_STRUCT;
        v : Array[0..9] of Int; w : Array[0..1, 1..3] of Int := [7, 4(8)]; z : Array[0..1] of Int;""",
        """A := 16#A; s."x y" := 2.5; U[2].N := -3;
        v[3] := 5; v[4] := 5; v[9] := 6; w[0,2] := 9; z := [1, 2]; z[1] := 3;""",
    )
    assert {path: register.initial for path, register in found.items()} == {
        "a": "16#A",
        "s/x y": "2.5",
        "u/1/n": None,
        "u/2/n": "-3",
        "v": "[3(0), 2(5), 4(0), 6]",
        "w": "[7, 9, 3(8), 0]",
        "z": "[1, 3]",
    }


def test_begin_assigns_the_members_of_a_dtl() -> None:
    found = registers(
        "a, b : DTL; c : DTL := DTL#2024-01-31-12:00:00; d : Array[0..2] of DTL;",
        """a.YEAR := 2262; a.MONTH := 4; a.DAY := 11; a.WEEKDAY := 6; a.NANOSECOND := 5; a := DTL#2000-01-01-00:00:00;
        b.Year := 2008; b.second := 59; b.NANOSECOND := 567_000_000; c.MONTH := 2; c.DAY := 29; d[1].HOUR := 3;""",
    )
    assert [register.initial for register in found.values()] == [
        "DTL#2000-01-01-00:00:00",
        "DTL#2008-01-01-00:00:59.567000000",
        "DTL#2024-02-29-12:00:00.000000000",
        "[DTL#1970-01-01-00:00:00, DTL#1970-01-01-03:00:00.000000000, DTL#1970-01-01-00:00:00]",
    ]
    assert "expected a whole number for YEAR" in errors(block("a : DTL;", "a.YEAR := x;"))[0]
    assert "found 'CENTURY'" in errors(block("a : DTL;", "a.CENTURY := 1;"))[0]


# -- what is refused -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("members", "message"),
    [
        ("a Int;", "4:6: error: expected ':' and the type, found ';'"),
        ("a : ;", "4:5: error: expected a type, found ';'"),
        ("a : Int\nb : Int;", "5:1: error: expected ';' at the end of the declaration, found 'b'"),
        ("a : Int := 5\nb : Int;", "5:1: error: expected ';' after the value, found 'b'"),
        ("a : Int := ;", "4:12: error: expected a value, found ';'"),
        ("a : Int := [1, 2;", "4:17: error: expected the bracket that closes the value, found ';'"),
        ("a : Nope;", "4:5: error: unknown type 'Nope'"),
        ('a : "Int";', "4:5: error: unknown type 'Int'"),
        ("a : TON_TIME;", "4:5: error: shmio does not know the members of the system type TON_TIME"),
        ("a : Int;\n  A : Bool;", "5:3: error: 'A' is declared twice, first in line 4"),
        ("a : Array[2..1] of Int;", "4:11: error: expected a lower bound not above the upper, found 2..1"),
        ("a : Array[0..99999999999999999999] of Int;", "within 32 bits"),
        ("a : Array[0.." + "9" * 5000 + "] of Int;", "4:14: error: longer than 4096 characters"),
        ("a : Array[0..2147483648] of Int;", "within 32 bits"),
        ("a : Array[0..MAX] of Int;", "4:14: error: the constant 'MAX' is not in the sources; write its value here"),
        ("a : Array[*] of Int;", "4:5: error: expected the bounds of the array, found '*'"),
        ("a : Array[0..1.5] of Int;", "a whole number"),
        ("a : Array[0..1,0..1,0..1,0..1,0..1,0..1,0..1] of Int;", "at most 6 dimensions"),
        ("a : Array[0..1] of Array[0..1] of Int;", "one array with more dimensions"),
        ("a : Array[0..1] Int;", "expected OF, found 'Int'"),
        ("a : String[255];", "4:12: error: expected a STRING length of 1 to 254, found '255'"),
        ("a : String[0];", "length of 1 to 254"),
        ("a : WString[16383];", "length of 1 to 16382"),
        ("a : Struct END_STRUCT;", "expected at least one member"),
        ('"" : Int;', "4:1: error: a quoted name must not be empty"),
        ('"a : Int;', "4:1: error: the quoted name that begins here has no closing quote"),
        ("a : String := 'x;\nb : Int;", "4:15: error: the string that begins here has no closing quote"),
        ("(* a : Int;", "4:1: error: the comment that begins here has no '*)'"),
        ("a { b := 'c' : Int;", "4:3: error: the attributes that begin here have no '}'"),
        ('"a\x01b" : Int;', "control characters"),
        (f'"{"x" * 129}" : Int;', "at most 128 characters"),
        ("a : Array[0..65535] of Int;", "the data block has 131072 bytes, but at most 65536 are allowed"),
        ("a : Array[0..1000000] of Struct b : Bool; END_STRUCT;", "expected at most"),
        ("a : Array[1..2147483647, 1..2147483647] of Struct b : Bool; END_STRUCT;", "expected at most"),
        ("a : Array[0..1] of Int; 5 : Int;", "4:25: error: expected a member's name, found '5'"),
    ],
)
def test_errors_say_where_and_what(members: str, message: str) -> None:
    assert any(message in error for error in errors(block(members)))


@pytest.mark.parametrize(
    ("begin", "message"),
    [
        ("b := 1;", "8:1: error: expected a member of this block, found 'b'"),
        ("s := 1;", "found a structure"),
        ("v[2] := 1;", "expected an index within [[0, 1]], found [2]"),
        ("v[0,0] := 1;", "expected an index"),
        ("u[1].x[0] := 1;", "expected no index, found [0]"),
        ("u.x := 1;", "expected an index within [[1, 1]], found 'x'"),
        ("v[0].x := 1;", "expected ':=' and a value, found 'x'"),
        ("v.YEAR := 1;", "expected ':=' and a value, found 'YEAR'"),
        ("u[1] := 1;", "found a structure"),
        ("v 1;", "expected ':=' and a value"),
    ],
)
def test_errors_after_begin(begin: str, message: str) -> None:
    members = (
        "v : Array[0..1] of Int; s : Struct x : Int; END_STRUCT;\n u : Array[1..1] of Struct\n x : Int; END_STRUCT;"
    )
    text = block(members, begin).replace("END_STRUCT;\nBEGIN", "END_STRUCT; BEGIN")
    assert any(message in error for error in errors(text))


def test_several_errors_in_one_run() -> None:
    text = block(
        "a : Nope;\n b Int;\n c : Struct\n d : Array[1..0] of Int;\n e : Int;\n END_STRUCT;\n f : Int", "g := 1;"
    )
    found = errors(text, 'TYPE "t" INT END_TYPE', "x")
    assert [error.split(": ")[0] for error in found] == [
        "0.db:4:5",
        "0.db:5:7",
        "0.db:7:12",
        "0.db:11:1",
        "1.db:1:10",
        "2.db:1:1",
    ]


@pytest.mark.parametrize(
    "text",
    [
        "",
        "(* *)",
        'DATA_BLOCK "b"',
        "DATA_BLOCK",
        'DATA_BLOCK "b" STRUCT',
        'DATA_BLOCK "b" STRUCT a : Struct',
        'DATA_BLOCK "b" Array[0..1] of Int BEGIN END_DATA_BLOCK',
        'DATA_BLOCK "b" Int BEGIN END_DATA_BLOCK',
        'DATA_BLOCK "b" VAR_INPUT a : Int; END_VAR END_DATA_BLOCK',
        "VAR a : Int; END_VAR",
        'FUNCTION_BLOCK "f"',
        UDT,
        block("a : Int;") * 2,
        UDT * 2 + block("a : Int;"),
    ],
)
def test_incomplete_and_unsupported_sources(text: str) -> None:
    assert "error" in errors(text)[0]


def test_recursive_types() -> None:
    types = 'TYPE "a" STRUCT x : "b"; END_STRUCT; END_TYPE TYPE "b" STRUCT x : "A"; END_STRUCT; END_TYPE '
    assert "the type 'A' contains itself: a → b → a" in errors(types + block('m : "a";'))[0]


def test_deep_nesting_ends_in_an_error() -> None:
    structs = "a : Struct " * 20_000 + "b : Int; " + "END_STRUCT; " * 20_000
    assert "nested more than 32 deep" in errors(block(structs))[0]
    brackets = "[" * 20_000 + "1" + "]" * 20_000
    assert registers(f"a : Int := {brackets};")["a"].initial == brackets


@pytest.mark.parametrize("order", [1, -1])
def test_long_chains_of_types_end_in_an_error(order: int) -> None:
    types = [f'TYPE "t{i}" STRUCT a : "t{i + 1}"; END_STRUCT; END_TYPE' for i in range(2000)][::order]
    text = "\n".join(types) + ' TYPE "t2000" STRUCT a : Int; END_STRUCT; END_TYPE ' + block('a : "t0";')
    assert any("32" in error for error in errors(text))


def test_types_of_exponential_size_end_in_an_error() -> None:
    types = [
        f'TYPE "t{i}" STRUCT a : Array[1..99] of "t{i + 1}"; b : "t{i + 1}"; END_STRUCT; END_TYPE' for i in range(20)
    ]
    text = "\n".join(types) + ' TYPE "t20" STRUCT a : Bool; END_STRUCT; END_TYPE ' + block('a : "t0";')
    assert any("expected at most" in error for error in errors(text))


def test_long_texts_in_large_arrays_end_in_an_error() -> None:
    text = block(f"a : Array[0..30000] of Struct b : Bool := {'1' * 4000}; END_STRUCT;")
    assert "characters of names" in errors(text)[0]


def test_bounds_on_files() -> None:
    assert "larger than" in errors(" " * (MAX_SOURCE_BYTES + 1))[0]
    assert "tokens" in errors(";" * (MAX_TOKENS + 1))[0]
    many = errors(block("a Int;\n" * 1000))
    assert len(many) == MAX_ERRORS


def test_warnings_come_with_errors() -> None:
    with pytest.raises(LayoutError) as caught:
        compile_text(block("a b : Int; c : Nope;"))
    assert [d.severity for d in caught.value.diagnostics] == ["error", "warning"]


FRAGMENTS = [
    *('DATA_BLOCK "b"', 'TYPE "t"', "STRUCT", "END_STRUCT", "END_TYPE", "BEGIN", "END_DATA_BLOCK", "VAR", "END_VAR"),
    *("a", '"b c"', ":", ":=", ";", ",", ".", "..", "[", "]", "(", ")", "{", "}", "1", "-5", "'x'", "Int", "Array"),
    *("of", '"t"', "//c\n", "(*", "*)", "'", '"', "String", "\n", "\x00", "FUNCTION", "é", "IEC_TIMER", "Bool"),
]


def outcome(*sources: Source) -> Compiled | LayoutError:
    try:
        return compile_sources(sources)
    except LayoutError as error:
        return error


@settings(max_examples=300)
@given(st.lists(st.sampled_from(FRAGMENTS), max_size=40))
def test_anything_compiles_or_ends_in_a_layout_error(fragments: list[str]) -> None:
    for text in (" ".join(fragments), block(" ".join(fragments)), block("a : Int;", " ".join(fragments))):
        result = outcome(Source("x.db", text.encode()))
        if isinstance(result, LayoutError):
            assert result.diagnostics
            assert all(d.line >= 1 and d.column >= 1 for d in result.diagnostics)
        else:
            assert all(load_layout(layout.to_json()) == layout for layout in result.layouts)


@settings(max_examples=100)
@given(st.binary(max_size=200))
def test_any_bytes_compile_or_end_in_a_layout_error(data: bytes) -> None:
    result = outcome(Source("x.db", data), Source("y.db", block("a : Int;").encode() + data))
    assert isinstance(result, Compiled) or result.diagnostics


def test_a_type_without_members_is_refused_only_where_it_is_used() -> None:
    empty = Source("empty.udt", b'TYPE "Empty" VERSION : 0.1 STRUCT END_STRUCT; END_TYPE')
    unused = Source("a.db", b'DATA_BLOCK "A" STRUCT x : Int; END_STRUCT; BEGIN END_DATA_BLOCK')
    compiled = compile_sources([unused, empty])
    assert compiled.layouts[0].size == 2
    assert "'Empty' has no members" in compiled.warnings[0].message
    used = Source("b.db", b'DATA_BLOCK "B" STRUCT x : "Empty"; END_STRUCT; BEGIN END_DATA_BLOCK')
    with pytest.raises(LayoutError, match="expected at least one member in the type 'Empty'"):
        compile_sources([used, empty])
