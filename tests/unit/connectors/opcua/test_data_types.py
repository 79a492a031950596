"""Definitions of structures and their values, from a server that may send anything."""

from __future__ import annotations

import asyncio
import itertools
import struct
import time
import tracemalloc
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import pytest
from asyncua import ua
from asyncua.ua.ua_binary import struct_to_binary
from hypothesis import given
from hypothesis import strategies as st

from shmio.connectors.opcua import decode
from shmio.connectors.opcua.data_types import MAX_TYPES, DataTypes, Structures
from shmio.connectors.opcua.decode import Extension, MalformedError, Sample
from shmio.connectors.opcua.structures import (
    AbsentError,
    ChangedValue,
    Members,
    find,
    members_of,
    read_definition,
    read_value,
)
from shmio.connectors.opcua.values import MismatchError

ENCODED = b"\1\2\1\0"
"""The node id ns=2;i=1 of an encoding."""
Fields = list[tuple[str, Any, int, bool]]


def definition(fields: Fields, form: int = 0, encoding: int = 1) -> bytes:
    made = [
        ua.StructureField(name, ua.LocalizedText(), data_type, rank, [], 0, optional)
        for name, data_type, rank, optional in fields
    ]
    return bytes(
        struct_to_binary(ua.StructureDefinition(ua.NodeId(encoding, 2), ua.NodeId(22), ua.StructureType(form), made))
    )


class Server:
    """Answers requests: definitions by the number of their data type, which the node with this number has."""

    def __init__(self, definitions: dict[int, bytes], body: bytes = b"", parents: dict[int, int] | None = None) -> None:
        self._definitions, self._body, self._parents = definitions, body, parents or {}
        self.read_nodes = 0

    async def read(self, nodes: Sequence[Any], attribute: Any) -> list[Sample]:
        self.read_nodes += len(nodes)
        return [self._attribute(node.Identifier, attribute) for node in nodes]

    def _attribute(self, number: int, attribute: Any) -> Sample:
        if attribute == ua.AttributeIds.Value:
            return Sample(decode.EXTENSION, Extension(ENCODED, self._body), None, 0, 0)
        if attribute == ua.AttributeIds.DataType:
            return Sample(decode.NODE_ID, f"ns=2;i={number}", None, 0, 0)
        if attribute == ua.AttributeIds.DataTypeDefinition and number in self._definitions:
            return Sample(decode.EXTENSION, Extension(b"\0\x7a", self._definitions[number]), None, 0, 0)
        return Sample(0, None, None, 0x80350000, 0)

    async def origins(self, nodes: Sequence[Any], reference: Any) -> list[Any]:
        found = [self._parents.get(node.Identifier) for node in nodes]
        return [ua.NodeId(number, 0 if number < 100 else 2) if number else None for number in found]


def learned(definitions: dict[int, bytes], body: bytes, parents: dict[int, int] | None = None) -> Structures:
    types = DataTypes(Server(definitions, body, parents))
    asyncio.run(types.learn([ua.NodeId(101, 2)]))
    return types.structures


def value_of(body: bytes) -> Sample:
    return Sample(decode.EXTENSION, Extension(ENCODED, body), None, 0, 0)


def read(definitions: dict[int, bytes], body: bytes, parents: dict[int, int] | None = None) -> Any:
    return read_value(learned(definitions, body, parents), value_of(body))


def numbers(*kinds: int) -> Fields:
    return [(f"m{place}", ua.NodeId(kind), -1, False) for place, kind in enumerate(kinds)]


def test_matrices_derived_types_and_values_of_any_type() -> None:
    fields: Fields = [
        ("grid", ua.NodeId(4), 2, False), ("span", ua.NodeId(200, 2), -1, False), ("any", ua.NodeId(24), -1, False),
        ("flags", ua.NodeId(201, 2), -1, False),
    ]  # fmt: skip
    body = struct.pack("<iii6h", 2, 2, 3, *range(6)) + struct.pack("<d", 2.5) + b"\x0c\1\0\0\0x" + b"\x05"
    found = read({101: definition(fields)}, body, {200: 202, 202: 11, 201: 3})
    assert (find(found, ("grid",)).value, find(found, ("grid",)).dims) == ([0, 1, 2, 3, 4, 5], (2, 3))
    assert find(found, ("grid", (1, 0))).value == 3
    assert (find(found, ("span",)).kind, find(found, ("span",)).value) == (decode.DOUBLE, 2.5)
    assert (find(found, ("any",)).kind, find(found, ("any",)).value) == (decode.STRING, "x")
    assert find(found, ("flags",)).value == 5
    with pytest.raises(AbsentError):
        find(found, ("grid", (2, 0)))


@pytest.mark.parametrize(
    ("made", "body", "words"),
    [
        (definition(numbers(6)), b"\0" * 5, "longer than in the server's definition"),
        (definition(numbers(6)), b"\0" * 3, "does not match the server's definition"),
        (definition(numbers(6), form=3), b"\0" * 4, "types that its definition does not name"),
        (definition([("a", ua.NodeId(6), -2, False)]), b"\0" * 4, "whether a is an array"),
        (definition([("a", ua.NodeId(999, 2), -1, False)]), b"\0" * 4, "does not define the type of a"),
        (definition([("a", ua.NodeId(6), -1, False)] * 2), b"\0" * 8, "no names of their own"),
        (definition([(f"{n}", ua.NodeId(6), -1, True) for n in range(33)], form=1), b"\0" * 4, "32 optional"),
        (definition(numbers(6), form=2), struct.pack("<I", 2), "does not match the server's definition"),
        (
            definition([("a", ua.NodeId(6), -1, True)], form=1),
            struct.pack("<Ii", 3, 0),
            "does not match the server's definition",
        ),
        (definition(numbers(6), encoding=7), b"\0" * 4, "does not define the node's structure"),
        (definition(numbers(6))[:-1], b"\0" * 4, "does not define the node's structure"),
    ],
)
def test_what_does_not_fit_has_no_value(made: bytes, body: bytes, words: str) -> None:
    with pytest.raises(MismatchError, match=words):
        read({101: made}, body)


def test_an_encoding_without_its_definition_is_looked_up() -> None:
    found = read({101: definition(numbers(6), encoding=7)}, b"\5\0\0\0", {1: 101})
    assert find(found, ("m0",)).value == 5


LOOP: Fields = [("next", ua.NodeId(101, 2), 1, False)]


@pytest.mark.parametrize(
    ("fields", "body"),
    [
        (LOOP, struct.pack("<i", 1) * 50_000 + struct.pack("<i", 0)),
        (LOOP, struct.pack("<i", 1_000_000) + struct.pack("<i", 0) * 1_000_000),
        ([("a", ua.NodeId(12), 1, False)], struct.pack("<i", 1_000_000) + b"\xff\xff\xff\xff" * 1_000_000),
        ([("a", ua.NodeId(6), 3, False)], struct.pack("<iiii", 3, 0x7FFFFFFF, 0x7FFFFFFF, 0x7FFFFFFF)),
        ([("a", ua.NodeId(102, 2), 1, False)], struct.pack("<i", 0x7FFFFFFF)),
    ],
)
def test_what_asks_for_too_much_is_refused_at_once(fields: Fields, body: bytes) -> None:
    made = {101: definition(fields), 102: definition([], encoding=2)}
    tracemalloc.start()
    begun = time.monotonic()
    try:
        with pytest.raises(MismatchError):
            read(made, body)
        assert tracemalloc.get_traced_memory()[1] - len(body) < 64 << 20
    finally:
        tracemalloc.stop()
    assert time.monotonic() - begun < 10


def test_endless_types_are_bounded() -> None:
    """Each data type has members of two others, so 2^1000 members lie below the first."""
    made = {
        number: definition(
            [("a", ua.NodeId(number + 1, 2), -1, False), ("b", ua.NodeId(number + 1, 2), -1, True)],
            form=1,
            encoding=number - 100,
        )
        for number in range(101, 101 + 3 * MAX_TYPES)
    }
    server = Server(made)
    types = DataTypes(server)
    asyncio.run(types.learn([ua.NodeId(101, 2)]))
    assert server.read_nodes < 5 * MAX_TYPES
    (first,) = (one for key, one in types.structures.items() if key == (2, 2, 1))
    empty = Members(first, {"a": None, "b": None})
    assert len(list(itertools.islice(members_of(empty), 1001))) == 1001


PUMP: Fields = [
    ("n", ua.NodeId(6), -1, False), ("o", ua.NodeId(12), -1, True), ("many", ua.NodeId(102, 2), 1, False),
    ("v", ua.NodeId(24), -1, False), ("u", ua.NodeId(103, 2), -1, True),
]  # fmt: skip
TYPES = {
    101: definition(PUMP, form=1),
    102: definition(numbers(1, 11, 12, 13, 17), encoding=2),
    103: definition(numbers(6, 12), form=2, encoding=3),
}
ELEMENT = b"\1" + struct.pack("<d", 1.5) + b"\1\0\0\0x" + b"\0" * 8 + b"\0\x55"
BODY = (
    struct.pack("<Ii", 3, -3) + b"\2\0\0\0ab" + struct.pack("<i", 2) + ELEMENT * 2 + b"\x06\7\0\0\0"
    + struct.pack("<Ii", 1, 9)
)  # fmt: skip


def test_the_undamaged_value() -> None:
    found = read(TYPES, BODY)
    assert find(found, ("many", (1,), "m1")).value == 1.5
    assert find(found, ("many", (1,), "m4")).value == "i=85"
    assert (find(found, ("o",)).value, find(found, ("v",)).value, find(found, ("u", "m0")).value) == ("ab", 7, 9)
    for size in range(len(BODY)):
        with pytest.raises(MismatchError):
            read(TYPES, BODY[:size])


@given(st.integers(0, len(BODY) - 1), st.binary(min_size=1, max_size=8))
def test_damaged_values_are_values_or_refused(at: int, noise: bytes) -> None:
    with suppress(MismatchError):
        for one in itertools.islice(members_of(read(TYPES, BODY[:at] + noise + BODY[at + len(noise) :])), 1000):
            if not one.refused and one.sample.value is not None:
                find(read(TYPES, BODY[:at] + noise + BODY[at + len(noise) :]), one.member)


def test_a_member_is_changed_without_the_other_bytes() -> None:
    types = learned(TYPES, BODY)
    for member, old, new in (
        (("n",), struct.pack("<Ii", 3, -3), struct.pack("<Ii", 3, 8)),
        (("many", (1,), "m1"), ELEMENT * 2, ELEMENT + ELEMENT[:1] + struct.pack("<d", 8) + ELEMENT[9:]),
        (("v",), b"\x06\7\0\0\0", b"\x06\x08\0\0\0"),
        (("u", "m0"), struct.pack("<Ii", 1, 9), struct.pack("<Ii", 1, 8)),
    ):
        changed = ChangedValue(types, value_of(BODY))
        changed.set(member, changed.find(member)._replace(value=8))
        assert changed.sample == value_of(BODY.replace(old, new))
        assert changed.find(member).value == 8
    changed = ChangedValue(types, value_of(BODY))
    changed.set(("o",), Sample(decode.STRING, "longer", None, 0, 0))
    changed.set(("v",), Sample(decode.INT16, [1, 2], (2,), 0, 0))
    whole = b"\2\0\0\0ab", b"\6\0\0\0longer"
    assert changed.sample.value.body == BODY.replace(*whole).replace(b"\x06\7\0\0\0", b"\x84\2\0\0\0\1\0\2\0")
    for member, words in ((("many", (1,), "m4"), "NodeId"), (("u", "m1"), "no member m1"), (("many",), "address")):
        with pytest.raises(ValueError, match=words):
            changed.set(member, Sample(decode.STRING, "x", None, 0, 0))


@given(st.integers(0, len(BODY) - 1), st.binary(min_size=1, max_size=8))
def test_a_member_of_a_damaged_value_is_changed_alone_or_refused(at: int, noise: bytes) -> None:
    types, value = learned(TYPES, BODY), value_of(BODY[:at] + noise + BODY[at + len(noise) :])

    def members(sample: Sample) -> dict[str, str]:
        found = itertools.islice(members_of(read_value(types, sample)), 100)
        return {repr(one.member): repr(one.sample) for one in found}

    with suppress(MismatchError):
        before = members(value)
        for one in itertools.islice(members_of(read_value(types, value)), 20):
            changed = ChangedValue(types, value)
            with suppress(ValueError):
                changed.set(one.member, changed.find(one.member))
                assert members(changed.sample) == before


@given(st.sampled_from([101, 102, 103]), st.integers(0, 400), st.binary(min_size=1, max_size=8))
def test_damaged_definitions_are_definitions_or_refused(number: int, at: int, noise: bytes) -> None:
    whole = TYPES[number]
    at %= len(whole)
    damaged = whole[:at] + noise + whole[at + len(noise) :]
    with suppress(MismatchError, AbsentError):
        read(TYPES | {number: damaged}, BODY)


@given(st.binary(max_size=64))
def test_noise_is_no_definition(noise: bytes) -> None:
    with suppress(MalformedError):
        read_definition(Sample(decode.EXTENSION, Extension(b"\0\x7a", noise), None, 0, 0))
