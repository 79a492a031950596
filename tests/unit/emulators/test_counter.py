from __future__ import annotations

import struct

import pytest

from shmio.emulators.programs import Counter, generations
from shmio.layout.model import Layout


def frame_at(time_s: float, size: int = 2181) -> bytearray:
    frame = bytearray(size)
    Counter(Layout("DB1", 1, size, False, ())).step(time_s, frame)
    return frame


@pytest.mark.parametrize("size", [1, 7, 8, 9, 2180, 2181])
def test_a_whole_frame_is_of_one_generation(size: int) -> None:
    frame = frame_at(1.234, size)
    assert len(frame) == size
    if size >= 8:
        assert struct.unpack_from(">Q", frame) == (1234,)
        assert generations(frame) == [1234]


def test_mixed_frame_shows_both_generations() -> None:
    old, new = frame_at(5.0), frame_at(5.001)
    assert generations(new[:960] + old[960:]) == [5000, 5001]


@pytest.mark.parametrize("place", [0, 7, 1000, 2175, 2176, 2180])
def test_wrong_byte_is_detected(place: int) -> None:
    frame = frame_at(3.0)
    frame[place] ^= 0x10
    assert generations(frame) != [3000]


def test_shifted_data_are_detected() -> None:
    frame = frame_at(3.0)
    assert generations(frame[8:] + frame[:8]) != [3000]


def test_frame_depends_only_on_the_time() -> None:
    assert frame_at(2.5) == frame_at(2.5)
    assert all(
        a != b
        for a, b in zip(
            [frame_at(i / 1000) for i in range(50)], [frame_at(i / 1000 + 0.001) for i in range(50)], strict=True
        )
    )
