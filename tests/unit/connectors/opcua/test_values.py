"""Values of every type for registers of every type: each fits, or turns one register bad."""

from __future__ import annotations

import math
from contextlib import suppress
from typing import Any

import pytest

from shmio.connectors.opcua.decode import NAMES, Extension, Sample
from shmio.connectors.opcua.values import MismatchError, ValueConverter
from shmio.connectors.register_image import RegisterImage
from shmio.layout.tags import place_tags
from shmio.layout.values.codec import codec

TYPES = (
    "BOOL", "BYTE", "USINT", "SINT", "WORD", "UINT", "INT", "DWORD", "UDINT", "DINT", "LWORD", "ULINT", "LINT", "REAL",
    "LREAL", "TIME", "LTIME", "TIME_OF_DAY", "LTOD", "S5TIME", "STRING[5]", "WSTRING[5]", "CHAR", "WCHAR", "DATE",
    "DATE_AND_TIME", "LDT", "DTL",
)  # fmt: skip
VALUES: dict[int, list[Any]] = {
    0: [None], 1: [True], 2: [-128], 3: [0, 255], 4: [-1], 5: [0, 0x9999, 0xD800, 0xFFFF], 6: [-(1 << 31)],
    7: [0xFFFFFFFF], 8: [-(1 << 63)], 9: [(1 << 64) - 1], 10: [math.nan, math.inf, 0.5],
    11: [math.nan, -math.inf, 1e308],
    12: ["", "x", "é" * 10, "x" * 70_000, "2024-02-30", "\0", "\U0001f600"],
    13: [-11_644_473_600_000_000_000, 0, (1 << 63) - 1],
    14: ["72962b91-fa75-4ae6-8d28-b404dc7daf63"], 15: [b"", b"\xff" * 8], 16: ["<x/>"], 17: ["ns=1;i=2"], 18: ["i=1"],
    19: [0x80000000], 20: ["name"], 21: ["text"],
    22: [Extension(b"\0\1", b""), Extension(b"\0\1", bytes(12)), Extension(b"\0\1", b"\xff" * 12)],
    23: [Sample(6, 1, None, 0, 0)], 24: [(6, 1, None)], 25: [None], 31: [b"x"],
}  # fmt: skip


@pytest.mark.parametrize("element", TYPES)
def test_a_value_fits_or_is_refused(element: str) -> None:
    assert VALUES.keys() >= set(range(len(NAMES)))
    for kind in (element, f"ARRAY[0..2] OF {element}", f"ARRAY[0..1, 0..1] OF {element}"):
        layout = place_tags("device", {"it": {"type": kind, "address": "i=1"}}).with_statuses()
        image, converter = RegisterImage(layout), ValueConverter(layout.registers[0])
        for number, values in VALUES.items():
            for value in values:
                for found, dims in (
                    (value, None), ([], (0,)), ([value] * 3, (3,)), ([value] * 4, (4,)), ([value] * 4, (2, 2)),
                    ([value] * 24, (3, 8)), ([value] * 32, (2, 2, 8)),
                ):  # fmt: skip
                    with suppress(MismatchError, ValueError, OverflowError):
                        image.put(0, converter.value(Sample(number, found, dims, 0, 0)))
                    assert len(bytes(image)) == layout.size


def test_a_character_that_a_server_sends_as_a_number_has_the_encoding_of_its_register() -> None:
    # S7-1500: CHAR is a Byte, WCHAR a UInt16 (function manual "Communication"). WHATWG, index-windows-1252: 80 is €.
    for kind, element, found, value in (
        (3, "CHAR", 0x80, "€"), (3, "CHAR", 0x81, "\x81"), (3, "CHAR", 0x41, "A"), (5, "WCHAR", 0x20AC, "€"),
        (5, "WCHAR", 0xD83D, "\U0010f83d"),
    ):  # fmt: skip
        layout = place_tags("device", {"it": {"type": element, "address": "i=1"}})
        layout = layout.with_encoding("windows-1252").with_statuses()
        image, converter = RegisterImage(layout), ValueConverter(layout.registers[0])
        sample = Sample(kind, found, None, 0, 0)
        assert image.put(0, converter.value(sample)) == ""
        assert codec(layout.registers[0], layout.byte_order).decode(bytes(image)) == value
        assert converter.sample(value, sample) == sample
