"""The decoder of CDR gives the same messages as the library's, and refuses damaged ones."""

from __future__ import annotations

import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.connectors.ros import cdr
from shmio.connectors.ros.messages import DEFINITIONS, FLOATS, INTEGERS

pytest.importorskip("cyclonedds")

from cyclonedds.idl._support import Endianness

from shmio.connectors.ros.dds_types import sample_type, to_message, to_sample


def _values(kind: str) -> st.SearchStrategy[Any]:
    """Return values of a type. Floats are whole numbers, so that values of float32 are equal, too."""
    if kind.endswith("[]"):
        return st.lists(_values(kind[:-2]), max_size=3)
    if kind == "string":
        return st.text(st.characters(exclude_characters="\0", codec="utf-8"), max_size=5)
    if kind == "bool":
        return st.booleans()
    if kind in FLOATS:
        return st.integers(-9999, 9999).map(float)
    if kind in INTEGERS:
        return st.integers(*INTEGERS[kind])
    return st.fixed_dictionaries({name: _values(inner) for name, inner in DEFINITIONS[kind].items()})


_MESSAGES = st.sampled_from(sorted(DEFINITIONS)).flatmap(lambda kind: st.tuples(st.just(kind), _values(kind)))


@given(_MESSAGES, st.sampled_from(Endianness))
def test_each_message_is_decoded_as_the_library_decodes_it(given: tuple[str, Any], order: Endianness) -> None:
    kind, message = given
    data = to_sample(message, kind).serialize(endianness=order)
    assert cdr.decode(data, kind) == to_message(sample_type(kind).__idl__.deserialize(data), kind) == message


@given(_MESSAGES, st.data())
def test_a_message_that_ends_too_early_is_refused(given: tuple[str, Any], data: st.DataObject) -> None:
    kind, message = given
    whole = to_sample(message, kind).serialize()
    with pytest.raises((ValueError, struct.error)):
        cdr.decode(whole[: data.draw(st.integers(2, len(whole) - 1))], kind)


@pytest.mark.parametrize("count", [1 << 20, 0xFFFF_FFFF])
@pytest.mark.parametrize(
    "kind", ["std_msgs/Float64MultiArray", "sensor_msgs/JointState", "trajectory_msgs/JointTrajectory"]
)
def test_a_count_larger_than_the_message_is_refused(kind: str, count: int) -> None:
    with pytest.raises((ValueError, struct.error)):
        cdr.decode(b"\0\1\0\0" + struct.pack("<I", count) * 10, kind)


def test_other_encodings_are_left_to_the_library() -> None:
    assert cdr.decode(b"\0\3\0\0" + bytes(8), "std_msgs/Float64") is None
