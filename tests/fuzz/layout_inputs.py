"""Inputs for fuzzing layouts: changed golden files, and random combinations of source text."""

from __future__ import annotations

import itertools
import random
from collections.abc import Iterator
from pathlib import Path

from shmio.layout.compiler import Source, compile_sources
from tests.fuzz.layout_checks import SPLIT

GOLDEN = Path(__file__).parents[1] / "golden" / "layout"
FIELD = GOLDEN.parents[1] / "field"
MAX_INPUT = 8192  # bytes; larger ones cost time and find nothing more
FRAGMENTS = [
    *('DATA_BLOCK "b"', "DATA_BLOCK DB 1", 'TYPE "t"', "TYPE UDT 1", 'FUNCTION_BLOCK "f"', "FUNCTION_BLOCK FB 1"),
    *("FUNCTION FC 1 : VOID", "STRUCT", "END_STRUCT", "END_STRUCT;", "END_TYPE", "BEGIN", "END_DATA_BLOCK"),
    *("END_FUNCTION_BLOCK", "END_FUNCTION", "VAR", "VAR_INPUT", "VAR_OUTPUT", "VAR_IN_OUT", "VAR_TEMP", "END_VAR"),
    *("VAR CONSTANT N : Int := 2; END_VAR", "CONST", "END_CONST", "RETAIN", "KNOW_HOW_PROTECT", "TITLE = it's"),
    *("{ S7_Optimized_Access := 'TRUE' }", "VERSION : 0.1", "NON_RETAIN", "a : Int;", "b : Bool;", "x AT a : Word;"),
    *("a", "b", '"t"', '"f"', "N", "#N", '"N"', ":", ":=", ";", ",", ".", "..", "[", "]", "(", ")", "{", "}", "#"),
    *("+", "-", "*", "0", "1", "-5", "16#FF", "99999", "2147483647", "4294967296", "1.5", "'x'", "''", "'$'", "(())"),
    *("3(0)", "9999999999(1)", "(a := 1)", "[()]", "[1, 2(3)]", "Array[0..1] of", "Array[0..N] of", "Array[*] of"),
    *("Struct", "Bool", "Int", "Real", "String[3]", "String[N]", "WString", "DTL", "Date_And_Time", "S5Time", "Any"),
    *('{ S7_Optimized := "FALSE"; S7_BlockNumber := "5" }', '{ S7_MLC := "" }', "TYPE t : STRUCT", "DATA_BLOCK b : t"),
    *("_.t", '"u"."t"', "_.N", "TON_TIME", "CTU_INT", "TCON", "END_NETWORK"),
    *("Variant", "IEC_TIMER", "TON", "SFB 4", "UDT 1", "FB 1", "ErrorStruct", "Timer", "T#1s", "DT#90-1-1-0:0:0"),
    *(
        "TRUE",
        "C#12",
        "B#(1,2)",
        "TOD#1:2:3",
        "//c\n",
        "(*",
        "*)",
        "(/*",
        "*/)",
        "'",
        '"',
        "$",
        "\r\n",
        "\x00",
        "é",
        "轴",
    ),
    *("\ufeff", "\x85", "\u2028", "٣", "²", "İ", "\U0001f600"),
]
CHARACTERS = "0123456789 +-_.,:#'\"$()[]eETtDdSshHmMuUnNsLlTRUEFALSE16#BCWxP%ä轴"
LITERALS = (
    *("TRUE", "-32768", "16#FF", "B#(1, 2)", "1.5e-3", "NaN", "T#1d2h3m4s5ms", "LT#1us", "S5T#2h46m30s", "P#M0.0"),
    *("TOD#23:59:59.999", "LTOD#0:0:0.000000001", "D#2024-02-29", "DT#1990-1-1-0:0:0.5", "LDT#2262-04-11-23:47:16"),
    *(
        "DTL#1970-01-01-00:00:00",
        "'$N$41$'x'",
        "WSTRING#'ä'",
        "[1, 2(3), [4]]",
        "[[1,2,3],[4,5,6]]",
        "2024-02-29T12:00",
    ),
)
NUMBERS = (0, 1, -1, 7, 255, 65_535, 1 << 31, 10**20)
TYPES = (
    *("Bool", "Byte", "Int", "DWord", "Real", "LReal", "Char", "WChar", "String", "String[3]", "WString[#N]", "Time"),
    *("S5Time", "LTime", "Date", "TOD", "LTOD", "DT", "LDT", "DTL", "Any", "Pointer", '"t"', "UDT 1", '"g"', "SFB 4"),
    *(
        "ErrorStruct",
        "HW_ANY",
        "Timer",
        "Array[0..1] of Bool",
        "Array[-1..1, 0..N] of Int",
        'Array[1..2] of "t"',
        'Array[1..9] of "e"',
    ),
    *(
        "Array[1..3] of String[5]",
        "Struct x : Bool; y : Int := 5; END_STRUCT",
        "Array[0..N] of Struct z : DTL; END_STRUCT",
    ),
)
VALUES = (
    "(1, 2)",
    "(p := 1, q := (r := TRUE))",
    "[(), (1)]",
    "((1, (TRUE)), ())",
    "[1, 2(3)]",
    "5(0)",
    '"N"',
    "#N",
    "N",
)
KNOWN = """VAR CONSTANT N : Int := M + 1 - M * 2; M : Int := -1; END_VAR
TYPE "t" STRUCT p : Int; q : Struct r : Bool; s : String[4] := 'ab'; END_STRUCT; END_STRUCT; END_TYPE
TYPE UDT 1 STRUCT x : Array[0..N] of Byte; y : "t" := (7); END_STRUCT; END_TYPE
FUNCTION_BLOCK "g" VAR_INPUT i : Bool; END_VAR VAR_IN_OUT a : Array[*] of Int; END_VAR VAR u : UDT 1; END_VAR
END_FUNCTION_BLOCK
FUNCTION_BLOCK "e" VAR_TEMP i : Bool; END_VAR BEGIN END_FUNCTION_BLOCK
"""
SHAPES = (
    "{}",
    'DATA_BLOCK "b" STRUCT {} a : Int; END_STRUCT; BEGIN {} END_DATA_BLOCK',
    'TYPE "t" STRUCT {} END_STRUCT; END_TYPE DATA_BLOCK "b" STRUCT a : "t" := {}; END_STRUCT; END_DATA_BLOCK',
    """FUNCTION_BLOCK "f" VAR_INPUT {} END_VAR VAR c : Int; END_VAR BEGIN {} END_FUNCTION_BLOCK
    DATA_BLOCK "d" "f" BEGIN END_DATA_BLOCK""",
    'VAR CONSTANT N : Int := {}; END_VAR DATA_BLOCK "b" VAR a : Array[0..{}] of Int; END_VAR END_DATA_BLOCK',
    """DATA_BLOCK "b" STRUCT s : Array[1..2] of Struct a : Int; b : Struct c : Bool; END_STRUCT; END_STRUCT := {};
    END_STRUCT; BEGIN {} END_DATA_BLOCK""",
)


def seeds() -> list[bytes]:
    """Return the golden files, singly and together, and the JSON of their layouts."""
    texts = [path.read_bytes() for path in sorted((GOLDEN / "rules").iterdir())]
    texts += [b"".join(path.read_bytes() for path in sorted((FIELD / "s7").glob("*.s7dcl")))]
    small = [text[:MAX_INPUT] for text in texts]
    found = [b"\0" + text for text in small]
    found += [b"\0" + SPLIT.join((one, other))[:MAX_INPUT] for one, other in itertools.pairwise(small)]
    for text in texts:
        layout = compile_sources([Source("golden", text)]).layouts[0]
        found.append(b"\2" + layout.to_json()[: 4 * MAX_INPUT])
    return found


class Mutator:
    """Yields inputs: some valid, some nearly valid, some garbage. Equal seeds give equal inputs."""

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)
        self._seeds = seeds()

    def __iter__(self) -> Iterator[bytes]:
        ways = (
            *(self._values, self._values, self._declarations, self._declarations, self._fragments, self._golden),
            *(self._nested, self._blocks),
        )
        while True:
            data = self._random.choice(ways)()
            if self._random.random() < 0.4:
                data = self._changed(data)
            if self._random.random() < 0.02:
                data = data[:1] + data[1:MAX_INPUT].decode("utf-8", "replace").encode("utf-16")
            yield data

    def _golden(self) -> bytes:
        return self._random.choice(self._seeds)

    def _values(self) -> bytes:
        rng = self._random
        text = rng.choice((rng.choice(LITERALS), "".join(rng.choices(CHARACTERS, k=rng.randrange(30)))))
        return b"\3" + bytes([rng.randrange(256)]) + (text.encode() if rng.random() < 0.5 else rng.randbytes(64))

    def _declarations(self) -> bytes:
        """Return a data block, or a function block with an instance, which is valid except for random errors."""
        rng = self._random

        def members(name: str) -> str:
            found = []
            for index in range(rng.randrange(1, 6)):
                given = f" := {rng.choice(VALUES if rng.random() < 0.5 else LITERALS)}" if rng.random() < 0.4 else ""
                found.append(f"{name}{index} : {rng.choice(TYPES)}{given};\n")
            return "".join(found)

        assigned = "".join(
            f"a{rng.randrange(4)}{rng.choice(('', '.p', '[1]'))} := {rng.choice(LITERALS)};" for _ in range(2)
        )
        begin = f"BEGIN {assigned if rng.random() < 0.3 else ''} END_DATA_BLOCK"
        if rng.random() < 0.5:
            return f'\0{KNOWN}DATA_BLOCK "b" STRUCT {members("a")} END_STRUCT; {begin}'.encode()
        sections = "".join(
            f"{section} {members(name)} END_VAR "
            for name, section in (("a", "VAR_INPUT"), ("b", "VAR"), ("c", "VAR_IN_OUT"), ("d", "VAR_OUTPUT"))
            if rng.random() < 0.6
        )
        return f'\0{KNOWN}FUNCTION_BLOCK "f" {sections} END_FUNCTION_BLOCK DATA_BLOCK "b" "f" {begin}'.encode()

    def _nested(self) -> bytes:
        """Return types that each use the next one several times, up to the depth limit."""
        rng = self._random
        count = rng.randrange(1, 34)
        text = ""
        for index in range(count):
            inner = f'"t{index + 1}"'
            kinds = rng.choices(
                (inner, inner, inner, f"Array[1..{rng.choice((0, 1, 2, 9, 999))}] of {inner}", "Int"), k=3
            )
            members = "".join(f"{name} : {kind};\n" for name, kind in zip("abc", kinds, strict=True))
            text += f'TYPE "t{index}" STRUCT {members} END_STRUCT; END_TYPE\n'
        last = rng.choice(("", "VAR_TEMP i : Bool; END_VAR", "VAR_INPUT v : Variant; END_VAR", "VAR i : Bool; END_VAR"))
        if rng.random() < 0.2:
            text += f'TYPE "t{count}" STRUCT END_STRUCT; END_TYPE '
        else:
            text += f'FUNCTION_BLOCK "t{count}" {last} BEGIN END_FUNCTION_BLOCK '
        given = rng.choice(("", "", " := (1)", " := ((), (()))"))
        first = rng.randrange(count + 1)
        return f'\0{text}DATA_BLOCK "b" STRUCT a : "t{first}"{given}; END_STRUCT; BEGIN END_DATA_BLOCK'.encode()

    def _blocks(self) -> bytes:
        """Return many blocks of one large type."""
        rng = self._random
        count, length = rng.choice(((1, 2000), (3, 250), (30, 60), (120, 1)))
        text = f'TYPE "t" STRUCT s : Array[1..{length}] of Struct a : Byte; b : "e"; END_STRUCT; END_STRUCT; END_TYPE\n'
        text += 'FUNCTION_BLOCK "e" BEGIN END_FUNCTION_BLOCK\n'
        text += "".join(f'DATA_BLOCK DB{number} "t" BEGIN END_DATA_BLOCK\n' for number in range(1, count + 1))
        return b"\0" + text.encode()

    def _fragments(self) -> bytes:
        """Return fragments of source text in random order, in a frame that often makes them valid."""
        rng = self._random
        words = " ".join(rng.choices(FRAGMENTS, k=rng.randrange(1, 40)))
        shape = rng.choice(SHAPES)
        half = len(words) // 2
        return b"\0" + shape.replace("{}", words[:half], 1).replace("{}", words[half:]).encode("utf-8", "replace")

    def _changed(self, before: bytes) -> bytes:
        rng = self._random
        data = bytearray(before)
        for _ in range(rng.choice((1, 1, 2, 3, 8, 30))):
            at = rng.randrange(1, len(data) + 1)
            kind = rng.randrange(7)
            if kind == 0:
                data[at:at] = f" {rng.choice(FRAGMENTS)} ".encode()
            elif kind == 1:
                del data[at : at + rng.randrange(1, 30)]
            elif kind == 2 and at < len(data):
                data[at] = rng.randrange(256)
            elif kind == 3:
                start = rng.randrange(1, len(data) + 1)
                data[at:at] = data[start : start + rng.randrange(1, 200)]
            elif kind == 4:
                data[at : at + rng.randrange(1, 8)] = str(
                    rng.choice((0, 1, -1, 7, 255, 65535, 1 << 31, 10**20))
                ).encode()
            elif kind == 5:
                data[at:at] = bytes(rng.randrange(256) for _ in range(rng.randrange(1, 4)))
            else:
                other = rng.choice(self._seeds)
                data[at:] = other[rng.randrange(1, len(other) + 1) :]
        return bytes(data[: 4 * MAX_INPUT])
