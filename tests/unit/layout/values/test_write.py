"""A register's new value as writes of its bytes and bits, and of no others."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.errors import PathError, ValueRangeError
from shmio.layout.model import Layout, Register
from shmio.layout.topic import find
from shmio.layout.values.codec import codec
from shmio.layout.values.write import Write, cover, encode, merge

LAYOUT = Layout(
    "DB1",
    1,
    24,
    False,
    (
        Register("speed", "REAL", (), 0, None, 4, 1),
        Register("on", "BOOL", (), 4, 3, 1, 1),
        Register("bits", "BOOL", ((1, 11),), 6, 0, 2, 11),
        Register("axes/1/counts", "INT", ((0, 3),), 8, None, 8, 4),
        Register("axes/1/name", "STRING[4]", (), 16, None, 6, 1),
    ),
)


def apply(image: bytes, *writes: Write) -> bytes:
    changed = bytearray(image)
    for offset, mask, data in writes:
        if mask:
            assert len(data) == 1
            assert mask & (mask - 1) == 0
            changed[offset] = changed[offset] & ~mask | data[0] & mask
        else:
            changed[offset : offset + len(data)] = data
    return bytes(changed)


@given(
    st.binary(min_size=24, max_size=24),
    st.sampled_from(
        [
            ("speed", 1.5),
            ("on", True),
            ("on", False),
            ("bits", [True, False] * 5 + [True]),
            ("bits/9", True),
            ("axes/1/counts", [1, -2, 3, -4]),
            ("axes/1/counts/2", -1),
            ("axes/1/counts/1..2", [-1, 7]),
            ("axes/1/counts/3.%X15", True),
            ("axes/1/counts/3.%B0", 0xA5),
            ("bits/2..3", [True, False]),
            ("bits/4..11", [True, False] * 4),
            ("bits/1..8", [False] * 8),
            ("axes/1/name", "ab"),
        ]
    ),
)
def test_encoded_value_changes_only_the_register(before: bytes, case: tuple[str, object]) -> None:
    path, value = case
    register = find(LAYOUT, path)
    after = apply(before, *encode(register, value))
    assert codec(register).decode(after) == value
    reference = bytearray(before)
    codec(register).encode_into(value, reference)
    if path == "bits":
        reference[7] &= 0b111  # the padding bits belong to no register
    assert after == bytes(reference)


def test_a_bit_is_a_write_of_one_bit_and_whole_bytes_are_one_write() -> None:
    assert encode(find(LAYOUT, "on"), value=True) == [Write(4, 8, b"\x08")]
    assert encode(find(LAYOUT, "bits/9"), value=True) == [Write(7, 1, b"\x01")]
    assert encode(find(LAYOUT, "axes/1/counts"), [1, 2, 3, 4]) == [Write(8, 0, bytes([0, 1, 0, 2, 0, 3, 0, 4]))]
    assert encode(find(LAYOUT, "bits"), [True] * 11) == [Write(6, 0, b"\xff\x07")]


def test_a_value_that_does_not_fit_is_refused() -> None:
    with pytest.raises(ValueRangeError):
        encode(find(LAYOUT, "axes/1/counts/0"), 40_000)


@pytest.mark.parametrize(
    ("patterns", "covered"),
    [
        (["speed"], range(4)),
        (["axes"], range(8, 22)),
        (["axes/*/name"], range(16, 22)),
        (["axes/1/counts/2"], range(12, 14)),
        (["**/counts/*"], range(8, 16)),
        ([], ()),
        (["nothing"], ()),
    ],
)
def test_cover_of_patterns(patterns: list[str], covered: range) -> None:
    assert cover(LAYOUT, patterns) == bytes(0xFF if at in covered else 0 for at in range(24))


def test_bits_are_covered_one_by_one() -> None:
    mask = cover(LAYOUT, ["on", "bits/9", "bits/11"])
    assert (mask[4], mask[6], mask[7]) == (8, 0, 0b101)
    assert cover(LAYOUT, ["bits"])[6:8] == cover(LAYOUT, ["bits/*"])[6:8] == b"\xff\xff"


def test_a_wrong_pattern_is_an_error() -> None:
    with pytest.raises(PathError):
        cover(LAYOUT, ["a//b"])


@given(st.binary(min_size=12, max_size=12), st.lists(st.sampled_from([0, 0xFF, 0x80, 0x7E]), min_size=12, max_size=12))
def test_merged_writes_have_the_effect_of_image_and_mask(image: bytes, mask: list[int]) -> None:
    before = bytes(range(100, 112))
    after = apply(before, *merge(image, bytes(mask), [(6, 12), (0, 7)]))
    assert after == bytes(old & ~m | new & m for old, new, m in zip(before, image, mask, strict=True))
