"""The fast way for one number gives the bytes of the way for many."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from shmio.injection.draw import SeededRandom
from shmio.injection.operations import ADD, MULTIPLY, Arithmetic, Noise, OperationContext, ValueGroup, places
from shmio.layout.model import ByteOrder, Register

TYPES = {"REAL": 4, "LREAL": 8, "INT": 2, "UINT": 2, "DINT": 4, "UDINT": 4, "SINT": 1, "BYTE": 1, "LINT": 8}
numbers = st.floats(allow_nan=False, allow_infinity=False) | st.integers(-(2**31), 2**31)


class NeverSingle(ValueGroup):
    """A group that takes the way for many numbers."""

    single = None


def groups(type_: str, order: ByteOrder, group: type[ValueGroup]) -> list[ValueGroup]:
    (one,) = places([Register("value", type_, (), 3, None, TYPES[type_], 1)], order)
    return [group(one.element, one.first, one.index, one.shifts, one.dtype)]


@given(st.sampled_from(sorted(TYPES)), st.sampled_from(("big", "little")), st.binary(min_size=12, max_size=12), numbers)
def test_arithmetic(type_: str, order: ByteOrder, data: bytes, by: float) -> None:
    at = OperationContext(1, 2, 3, 4)
    for array, single in (
        (lambda _, values: values + by, (ADD, by)),
        (lambda _, values: values * by, (MULTIPLY, by)),
    ):
        found = []
        for kind in (ValueGroup, NeverSingle):
            image = np.frombuffer(data, np.uint8).copy()
            Arithmetic(groups(type_, order, kind), array, single).apply(image, at)
            found.append(image.tobytes())
        assert found[0] == found[1]


@given(
    st.sampled_from(sorted(TYPES)),
    st.binary(min_size=12, max_size=12),
    st.floats(0, 1e6),
    st.booleans(),
    st.integers(0),
)
def test_noise(type_: str, data: bytes, amplitude: float, gaussian: bool, seed: int) -> None:
    found = []
    for kind in (ValueGroup, NeverSingle):
        image = np.frombuffer(data, np.uint8).copy()
        draw = SeededRandom(seed, "noise")
        Noise(groups(type_, "big", kind), draw, amplitude, gaussian=gaussian).apply(image, OperationContext(1, 2, 3, 4))
        found.append(image.tobytes())
    assert found[0] == found[1]
