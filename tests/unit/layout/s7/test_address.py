"""Addresses of tag tables: notations, types and faults."""

from __future__ import annotations

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.layout.model import Register
from shmio.layout.s7.address import Address, Area, parse
from shmio.layout.tags import place_tags


def register(kind: str, address: str) -> Register:
    return place_tags("table", {"value": {"type": kind, "address": address}}).registers[0]


def place(kind: str, address: str) -> tuple[Area, int, int, int | None, int]:
    found = parse(register(kind, address))
    return found.area, found.db, found.start, found.bit, found.size


@pytest.mark.parametrize(
    ("kind", "address", "expected"),
    [
        ("BOOL", "DB201.DBX0.1", (Area.BLOCK, 201, 0, 1, 1)),
        ("INT", "DB201.DBW4", (Area.BLOCK, 201, 4, None, 2)),
        ("REAL", "%db201.dbd12", (Area.BLOCK, 201, 12, None, 4)),
        ("STRING[8]", "DB201.DBB10", (Area.BLOCK, 201, 10, None, 10)),
        ("DTL", "DB201.DBX10.0", (Area.BLOCK, 201, 10, None, 12)),
        ("ARRAY[0..9] OF BOOL", "DB1.DBX2.0", (Area.BLOCK, 1, 2, None, 2)),
        ("BOOL", "%I0.0", (Area.INPUT, 0, 0, 0, 1)),
        ("BOOL", "E0.3", (Area.INPUT, 0, 0, 3, 1)),
        ("WORD", "%IW256", (Area.INPUT, 0, 256, None, 2)),
        ("WORD", "%IW256:P", (Area.PERIPHERAL, 0, 256, None, 2)),
        ("BYTE", "%QB4", (Area.OUTPUT, 0, 4, None, 1)),
        ("BYTE", "AB4", (Area.OUTPUT, 0, 4, None, 1)),
        ("DWORD", "%MD10", (Area.MARKER, 0, 10, None, 4)),
        ("LREAL", "%MD10", (Area.MARKER, 0, 10, None, 8)),
        ("REAL", "%MW10 INT", (Area.MARKER, 0, 10, None, 2)),
        ("BOOL", "%M3.7", (Area.MARKER, 0, 3, 7, 1)),
        ("S5TIME", "T5", (Area.TIMER, 0, 5, None, 2)),
        ("INT", "%Z3", (Area.COUNTER, 0, 3, None, 2)),
        ("WORD", "C65535", (Area.COUNTER, 0, 65535, None, 2)),
    ],
)
def test_an_address_is_understood(kind: str, address: str, expected: object) -> None:
    assert place(kind, address) == expected


@pytest.mark.parametrize(
    ("kind", "address", "reason"),
    [
        ("INT", "", "address: this key is needed"),
        ("INT", "DB0.DBW0", "numbered 1 to"),
        ("INT", "DB70000.DBW0", "numbered 1 to"),
        ("INT", "DB1.DBW70000", "the largest number"),
        ("INT", "DB1.DBW65535", "end after byte 65535"),
        ("INT", "DB1.DBD0", "4 bytes, but INT has 2"),
        ("BOOL", "DB1.DBB0", "is one bit"),
        ("INT", "DB1.DBX0.1", "whole byte"),
        ("INT", "%MW3.1", "write a bit with its byte"),
        ("INT", "%M3", "write a bit with its byte"),
        ("BYTE", "%QB4:P", "leave out ':P'"),
        ("REAL", "T5", "S5TIME"),
        ("WORD", "T5.1", "only a number"),
        ("BOOL", "%M0.0 INT", "only numbers"),
        ("WORD", "%MW٣", "is not an S7 address"),
        ("WORD", "40001", "is not an S7 address"),
    ],
)
def test_a_wrong_address_is_named(kind: str, address: str, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        parse(register(kind, address))


KINDS = st.sampled_from(["BOOL", "BYTE", "INT", "DINT", "REAL", "LREAL", "STRING[4]", "ARRAY[0..9] OF INT", "S5TIME"])


@given(KINDS, st.text(alphabet="%DBXWIQMEATCZ.:P0123456789 INT", max_size=24) | st.text(max_size=40))
def test_any_text_is_an_address_within_its_area_or_a_fault(kind: str, text: str) -> None:
    found: Address | None = None
    with contextlib.suppress(ValueError):
        found = parse(register(kind, text))
    if found is not None:
        assert 0 <= found.start <= 65535
        assert found.area.numbered or found.start + found.size <= 65536


@given(
    st.sampled_from([("BYTE", "B"), ("INT", "W"), ("REAL", "D")]),
    st.sampled_from(["%I", "%Q", "%M", "%DB7.DB"]),
    st.integers(0, 65532),
)
def test_the_text_of_an_address_is_read_back(kind: tuple[str, str], area: str, start: int) -> None:
    text = f"{area}{kind[1]}{start}"
    assert parse(register(kind[0], text)).text == text
