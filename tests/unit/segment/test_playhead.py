"""The position of a playhead: every reader computes the same position, forward and backward."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.errors import SegmentError
from shmio.segment import Attributes, BlockSpec, Segment
from shmio.segment.playhead import FindRequest, MoveRequest, PlayheadAnswer, PlayState, with_answer
from tests.unit.recorder.harness import LAYOUT

S = 1_000_000_000
PLAY = PlayState(100 * S, 110 * S, 5 * S, 100 * S, 110 * S, 0, 0)

speeds = st.floats(0.01, 1000)
positions = st.integers(100 * S, 110 * S)


@given(speeds, positions)
def test_a_position_is_reached_when_due_and_not_earlier(speed: float, position_ns: int) -> None:
    play = PLAY._replace(speed=speed)
    due_ns = play.due_ns(position_ns)
    assert play.reach_ns(due_ns) >= position_ns
    if position_ns > play.position_ns:
        assert play.reach_ns(due_ns - 2) < position_ns


@given(speeds, st.integers(0, 3600 * S), st.booleans(), st.booleans())
def test_settling_changes_no_position(speed: float, after_ns: int, loop: bool, paused: bool) -> None:
    play = PLAY._replace(speed=speed, loop=loop, paused=paused)
    clock_ns = play.anchor_ns + after_ns
    settled = play.settled(clock_ns)
    assert abs(settled.at_ns(clock_ns) - play.at_ns(clock_ns)) <= 2 + speed
    assert settled.settled(clock_ns) == settled
    assert play.begin_ns <= settled.at_ns(clock_ns) <= play.end_ns


def test_it_ends_loops_or_pauses() -> None:
    assert PLAY.at_ns(8 * S) == 103 * S
    assert PLAY.at_ns(99 * S) == 110 * S
    assert PLAY.settled(99 * S).paused
    assert PLAY._replace(loop=True).at_ns(18 * S) == 103 * S
    assert PLAY._replace(loop=True, until_ns=104 * S).settled(18 * S).position_ns == 104 * S
    assert PLAY._replace(paused=True).at_ns(99 * S) == 100 * S
    assert PLAY.at_ns(0) == 100 * S, "before the start"


@given(st.binary(max_size=2560), st.integers(0, 2559))
def test_any_bytes_are_a_valid_playhead_none_or_refused(data: bytes, at: int) -> None:
    memory = bytearray(2560)
    memory[at : at + len(data)] = data[: 2560 - at]
    from shmio.segment.playhead import Playhead

    head = Playhead(None, memoryview(memory), 0, 2560, 0, None)  # type: ignore[arg-type]
    try:
        play = head.read()
    except SegmentError:
        return
    assert play is None or (play.begin_ns < play.end_ns and play.speed > 0)
    head.asks(0)


def test_a_request_and_its_answer(instance: str) -> None:
    spec = BlockSpec("cell", LAYOUT, 20_000_000, S, 1 << 20, Attributes("replay", stepped=True, replay=True))
    with Segment.create(instance, [spec], []) as segment:
        head = segment.blocks["cell"].playhead
        assert head is not None
        assert head.read() is None
        head.write(PLAY)
        assert head.read() == PLAY
        with head.held():
            number = head.ask(MoveRequest(7, paused=True))
            assert head.asks(0) == (number, MoveRequest(7, paused=True))
            assert head.found(number) is None
            head.write(with_answer(PLAY, number, PlayheadAnswer("because " + "ä" * 500)))
            assert head.asks(number) is None
            found = head.found(number)
            assert found is not None
            assert found.error.startswith("because ä")
            assert head.ask(FindRequest(8, "count")) == number + 1
        segment.unlink()


def test_a_block_without_replay_has_no_playhead(instance: str) -> None:
    with Segment.create(instance, [BlockSpec("cell", LAYOUT, 20_000_000, S, 1 << 20)], []) as segment:
        assert segment.blocks["cell"].playhead is None
        segment.unlink()


@pytest.mark.parametrize("size", [0, 2559])
def test_a_section_too_short_is_refused(size: int) -> None:
    from shmio.segment.playhead import Playhead

    with pytest.raises(ValueError, match="too short"):
        Playhead(None, memoryview(bytearray(4096)), 0, size, 0, None)  # type: ignore[arg-type]
