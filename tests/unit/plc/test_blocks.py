"""Timers and edge detection, against the timing diagrams of IEC 61131-3."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from shmio.plc import F_TRIG, R_TRIG, TOF, TON, TP
from shmio.plc.blocks import FunctionBlock

SCAN_NS = 100_000_000


class Plc:
    """A program's time."""

    _now_ns = 0


def levels(text: str) -> list[bool]:
    return [letter == "#" for letter in text]


def played(block: type[TON | TOF | TP], pt_s: float, inputs: Sequence[bool]) -> tuple[str, list[float]]:
    """Run a timer with a scan each 0.1 s; return Q as a diagram, and ET of each scan."""
    plc = Plc()
    own = block(pt_s).of(plc)
    q, et_s = "", []
    for level in inputs:
        q += "#" if own(level) else "."
        et_s.append(own.et_s)
        plc._now_ns += SCAN_NS
    return q, et_s


@pytest.mark.parametrize(
    ("block", "inputs", "outputs"),
    [
        (TON, "..######..##..####", ".....###.........#"),
        (TON, "######", "...###"),
        (TOF, "......", "......"),
        (TOF, "..##......#.#.....", "..#####...######.."),
        (TOF, "##", "##"),
        (TP, "..########...#....", "..###........###.."),
        (TP, "#.#.#......", "###.###...."),
        (TP, "#.##.", "###.."),
    ],
)
def test_timers_follow_the_diagrams(block: type[TON | TOF | TP], inputs: str, outputs: str) -> None:
    assert len(inputs) == len(outputs)
    assert played(block, 0.3, levels(inputs))[0] == outputs


@pytest.mark.parametrize(
    ("block", "inputs", "elapsed"),
    [
        (TON, "#####..", [0, 0.1, 0.2, 0.3, 0.3, 0, 0]),
        (TOF, ".#.....#", [0, 0, 0, 0.1, 0.2, 0.3, 0.3, 0]),
        (TP, "#####..", [0, 0.1, 0.2, 0.3, 0.3, 0, 0]),
        (TP, "#......", [0, 0.1, 0.2, 0, 0, 0, 0]),
    ],
)
def test_the_elapsed_time_stops_at_the_preset_time(
    block: type[TON | TOF | TP], inputs: str, elapsed: list[float]
) -> None:
    assert played(block, 0.3, levels(inputs))[1] == pytest.approx(elapsed)


def test_rounding_delays_no_timer() -> None:
    """0.3 - 0.1 is less than 0.2 in floating point, but the timer's time is exact."""
    assert played(TON, 0.2, levels(".####"))[0] == "...##"


def test_a_preset_time_of_zero_and_a_new_one_while_it_runs() -> None:
    assert played(TON, 0.0, levels(".#"))[0] == ".#"
    assert played(TP, 0.0, levels(".##"))[0] == "..."
    plc = Plc()
    timer = TON(10.0).of(plc)
    timer(True)
    plc._now_ns = 5 * SCAN_NS
    timer.pt_s = 0.5
    assert timer(True)


@pytest.mark.parametrize("pt_s", [-1.0, float("nan"), float("inf")])
def test_invalid_preset_times_are_refused(pt_s: float) -> None:
    with pytest.raises(ValueError, match="PT"):
        TON(pt_s)


@pytest.mark.parametrize(
    ("block", "inputs", "outputs"),
    [
        (R_TRIG, ".##..#", ".#...#"),
        (R_TRIG, "##", "#."),
        (F_TRIG, "##..#.", "..#..#"),
        (F_TRIG, "..", "#."),
    ],
)
def test_edges(block: type[R_TRIG | F_TRIG], inputs: str, outputs: str) -> None:
    own = block()
    assert "".join("#" if own(level) else "." for level in levels(inputs)) == outputs


def test_each_program_has_its_own_blocks() -> None:
    class Machine(Plc):
        delay = TON(0.1)

    one, other = Machine(), Machine()
    one.delay(True)
    one._now_ns = other._now_ns = SCAN_NS
    assert one.delay(True)
    assert not other.delay(True)
    assert one.delay is one.delay


def test_a_timer_without_a_program_says_what_to_do() -> None:
    timer: FunctionBlock = TON(1.0)
    with pytest.raises(TypeError, match="class body"):
        timer(True)  # type: ignore[operator]
