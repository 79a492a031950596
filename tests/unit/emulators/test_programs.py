"""The program of the A50 cell: it moves all the time, and only as a real cell could."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path

import pytest
from msgspec import structs

from shmio.emulators.programs import A50
from shmio.errors import ConfigError
from shmio.layout.compiler import Source, compile_sources
from shmio.layout.model import Layout
from shmio.simulation.a50 import ACTUATORS, AXIS_LIMITS, CYCLE_S, STEPS

PERIOD_S = 0.02  # sampling period of these tests
MAX_DEG_PER_S = 123.0


def watch(layout: Layout, begin_s: float, end_s: float) -> list[bytes]:
    program = A50(layout)
    frame = bytearray(layout.size)
    frames = []
    for cycle in range(round(begin_s / PERIOD_S), round(end_s / PERIOD_S)):
        program.step(cycle * PERIOD_S, frame)
        frames.append(bytes(frame))
    return frames


@pytest.fixture(scope="module")
def film(db201: Layout) -> list[bytes]:
    return watch(db201, 0, CYCLE_S + 1)


def axes(frame: bytes) -> tuple[float, ...]:
    return struct.unpack_from(">20f", frame, 2100)


def bit(frame: bytes, byte: int, place: int) -> bool:
    return bool(frame[byte] >> place & 1)


def test_every_axis_changes_within_a_second_at_any_time(film: list[bytes]) -> None:
    window = 50
    for begin in range(len(film) - window):
        seen = [set(values) for values in zip(*(axes(frame) for frame in film[begin : begin + window]), strict=True)]
        assert min(len(values) for values in seen) > 15


def test_axes_keep_their_limits_and_speeds(film: list[bytes]) -> None:
    before = axes(film[0])
    for frame in film:
        now = axes(frame)
        for robot in range(3):
            for axis, (low, high) in enumerate(AXIS_LIMITS):
                place = 2 + 6 * robot + axis
                assert low < now[place] < high
                assert abs(now[place] - before[place]) < MAX_DEG_PER_S * PERIOD_S
        for place in (0, 1):
            assert 0 <= now[place] <= 400
            assert abs(now[place] - before[place]) < 250 * PERIOD_S
        before = now


def test_all_robots_and_axes_take_part(film: list[bytes]) -> None:
    travel = [max(values) - min(values) for values in zip(*(axes(frame) for frame in film), strict=True)]
    assert min(travel) > 15


def test_a_cycle_goes_through_all_steps_in_order(film: list[bytes]) -> None:
    numbers = [int.from_bytes(frame[1002:1004], "big") for frame in film]
    assert list(dict.fromkeys(numbers)) == list(STEPS)
    assert numbers[-1] == 10
    assert int.from_bytes(film[-1][1004:1008], "big") == 1
    for number, duration_s in STEPS.items():
        assert numbers[:-50].count(number) == pytest.approx(duration_s / PERIOD_S, abs=2)


def test_heartbeat_and_its_echo(film: list[bytes]) -> None:
    beats = [bit(frame, 1000, 0) for frame in film[:500]]
    assert beats[:25] == [True] * 25
    assert beats[25:50] == [False] * 25
    echo = [bit(frame, 0, 4) for frame in film[:500]]
    assert echo[2:] == beats[:-2]


def test_actuators_take_time_and_are_never_at_both_ends(film: list[bytes]) -> None:
    for place in range(len(ACTUATORS)):
        states = []
        for frame in film:
            switches = int.from_bytes(frame[8:11], "little") >> 2 * place & 3
            valve = bool(int.from_bytes(frame[1008:1010], "little") >> place & 1)
            states.append((valve, switches))
        assert {switches for _, switches in states} == {0, 1, 2}
        assert set(states) == {(False, 2), (True, 0), (True, 1), (False, 0)}


def test_robots_move_only_when_the_trolley_is_clamped(film: list[bytes]) -> None:
    moved = 0
    for frame in film:
        moving = [bit(frame, byte, 1) for byte in (4, 5, 6)]
        clamped = frame[8] & 0x0F == 0b0101
        assert clamped or not any(moving)
        moved += any(moving)
    assert moved > len(film) / 3


def test_only_one_robot_is_at_the_trolley_or_the_units(film: list[bytes]) -> None:
    for frame in film:
        assert sum(not bit(frame, byte, 2) for byte in (4, 5, 6)) <= 1


def test_engines_turn_only_when_held(film: list[bytes]) -> None:
    turned = 0
    for frame in film:
        speeds = struct.unpack_from(">hh", frame, 16)
        held = int.from_bytes(frame[8:11], "little") >> 6 & 0xFF == 0b01010101
        assert held or speeds == (0, 0)
        turned += speeds > (2000, 2000)
    assert turned > 300


def test_trolley_comes_stays_and_leaves(film: list[bytes]) -> None:
    places = [int.from_bytes(frame[2:4], "big") for frame in film[:-51]]
    assert places == sorted(places)
    assert places[0] == 0
    assert places[-1] > 5990
    assert places.count(3000) > 0.8 * len(places)
    assert all(bit(frame, 1, 1) for frame, place in zip(film, places, strict=False) if place == 3000)


def test_frame_depends_only_on_the_time(db201: Layout, film: list[bytes]) -> None:
    assert watch(db201, 30, 31) == film[1500:1550]


def test_other_registers_are_unchanged(db201: Layout) -> None:
    frame = bytearray(b"\xa5" * db201.size)
    A50(db201).step(12.0, frame)
    assert frame[20:1000] == b"\xa5" * 980
    assert frame[1013:2100] == b"\xa5" * 1087


def test_runs_on_the_printed_source(db201: Layout) -> None:
    source = Path(__file__).parents[2] / "golden" / "layout" / "db201-as-printed.db"
    (printed,) = compile_sources([Source(source.name, source.read_bytes())]).layouts
    assert watch(printed, 40, 41) == watch(db201, 40, 41)


def test_registers_are_found_by_the_layout_not_by_fixed_offsets(db201: Layout) -> None:
    moved = replace(
        db201, size=db201.size + 10, registers=tuple(structs.replace(r, offset=r.offset + 10) for r in db201.registers)
    )
    wide, plain = bytearray(moved.size), bytearray(db201.size)
    A50(moved).step(33.0, wide)
    A50(db201).step(33.0, plain)
    assert wide == bytes(10) + plain


@pytest.mark.parametrize("path", ["Inputs", "NCAchse1 Pos", "Robot_825/Axs6_Pos"])
def test_names_the_register_that_is_missing_or_wrong(db201: Layout, path: str) -> None:
    without = replace(db201, registers=tuple(r for r in db201.registers if r.path != path))
    with pytest.raises(ConfigError, match=f"needs a register {path.replace(' ', '_')}"):
        A50(without)
    other = replace(
        db201, registers=tuple(structs.replace(r, type="DINT") if r.path == path else r for r in db201.registers)
    )
    with pytest.raises(ConfigError, match="DINT"):
        A50(other)


# -- commands ----------------------------------------------------------------------------------------------------------


def follow(layout: Layout, orders: dict[int, bytes], end_s: float) -> dict[int, bytes]:
    """Run from the start, and return the frames by time in ms.

    ``orders`` has the values of Outputs 13 to 17 that a client writes, by time in ms.
    """
    program = A50(layout)
    frame = bytearray(layout.size)
    frames = {}
    for cycle in range(round(end_s / PERIOD_S)):
        time_ms = round(cycle * PERIOD_S * 1000)
        frame[1013:1018] = orders.get(time_ms, bytes(frame[1013:1018]))
        program.step(cycle * PERIOD_S, frame)
        frames[time_ms] = bytes(frame)
    return frames


HOLD, GO = b"\x01\0\0\0\0", bytes(5)


def test_hold_stops_all_motion_until_it_is_released(db201: Layout) -> None:
    """A hold within a robot's move stops all but the heartbeat; the move is finished afterwards."""
    free = follow(db201, {}, 9)
    held = follow(db201, {8000: HOLD, 10_000: GO}, 11)
    assert axes(held[8000]) == axes(free[7980])  # the hold takes effect in this cycle
    assert {axes(held[time_ms]) for time_ms in range(8000, 10_000, 20)} == {axes(held[8000])}
    assert {bit(held[time_ms], 1000, 0) for time_ms in range(8000, 10_000, 20)} == {True, False}
    assert (bit(free[8000], 5, 1), bit(held[8000], 5, 1)) == (True, False)
    assert (bit(free[8000], 1000, 2), bit(held[8000], 1000, 2)) == (True, False)
    assert (bit(free[8000], 1001, 3), bit(held[8000], 1001, 3)) == (False, True)
    assert axes(held[10_980]) == pytest.approx(axes(free[8980]))
    assert held[10_980][1000:1013] == free[8980][1000:1013]


def test_actuators_obey_commands_and_then_the_program_again(db201: Layout) -> None:
    place = next(place for place, actuator in enumerate(ACTUATORS) if actuator.name == "gripper of Robot_825")

    def state(frame: bytes) -> tuple[bool, int, bool]:
        switches = int.from_bytes(frame[8:11], "little") >> 2 * place & 3
        return bit(frame, 1008 + place // 8, place % 8), switches, bit(frame, 5, 3)

    mask = (1 << place).to_bytes(2, "little")
    frames = follow(
        db201, {1000: b"\0" + mask + b"\0\0", 2000: b"\0" + mask + mask, 3000: b"\0\0\0" + mask, 4000: GO}, 5
    )
    assert state(frames[980]) == (False, 2, False)
    assert state(frames[1000]) == (True, 1, True)
    assert [state(frames[time_ms]) for time_ms in (2000, 3000, 4000)] == [(False, 2, False)] * 3
    assert frames[1500][1008:1010] == mask  # no other valve
