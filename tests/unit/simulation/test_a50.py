"""The A50 cell as a model; the tests of the emulated controller check its movements in detail."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from shmio.emulators.programs import A50
from shmio.layout.compiler import Source, compile_sources
from shmio.layout.model import Layout
from shmio.layout.topic import find
from shmio.layout.values.codec import codec
from shmio.layout.values.write import encode
from shmio.plan.prepare import prepare
from shmio.simulation import ModelRunner, layout_of
from shmio.simulation.a50 import A50Cell, Track, smooth

STEP_NS = 50_000_000
ROOT = Path(__file__).parents[3]
AXIS = "Robot_825/Axs1_Pos"


@pytest.fixture
def db201() -> Layout:
    source = ROOT / "db201.db"
    (layout,) = compile_sources([Source(source.name, source.read_bytes())]).layouts
    return layout


def value(runner: ModelRunner, path: str) -> Any:
    return codec(find(runner.layout, path), runner.layout.byte_order).decode(runner.image)


def test_its_layout_has_the_signals_of_db201(db201: Layout) -> None:
    own = {register.path: (register.type, register.dims) for register in layout_of(A50Cell).registers}
    assert own == {register.path: (register.type, register.dims) for register in db201.registers}


def test_moves_as_the_emulated_plant_does(db201: Layout) -> None:
    program, runner = A50(db201), ModelRunner(A50Cell, db201)
    frame = bytearray(db201.size)
    program.step(0, frame)
    seen = set()
    for number in range(1, 400):
        program.step(number / 20, frame)
        assert runner.step(number * STEP_NS, STEP_NS) == frame
        seen.add(value(runner, AXIS))
    assert len(seen) > 100


def test_hold_pauses_and_resumes_the_movement(db201: Layout) -> None:
    runner = ModelRunner(A50Cell, db201)
    hold = find(db201, "Outputs/13")

    def run(first: int, last: int) -> float:
        for number in range(first, last):
            runner.step(number * STEP_NS, STEP_NS)
        position: float = value(runner, AXIS)
        return position

    moving = run(1, 161)
    assert runner.write(encode(hold, 1, "big")) == [""]
    assert run(161, 200) == pytest.approx(moving)
    assert value(runner, "Outputs/13") == 1
    runner.write(encode(hold, 0, "big"))
    assert run(200, 220) != pytest.approx(moving, abs=1)


def test_registers_that_it_does_not_compute_keep_written_values(db201: Layout) -> None:
    runner = ModelRunner(A50Cell, db201)
    paths = ("Inputs/0", "Inputs/20", "Outputs/0", "Outputs/18")
    writes = [write for path in paths for write in encode(find(db201, path), 0xA5, "big")]
    assert runner.write(writes) == [""] * 4
    runner.step(STEP_NS, STEP_NS)
    assert [value(runner, path) for path in ("Inputs/20", "Outputs/18")] == [0xA5] * 2
    assert 0xA5 not in [value(runner, path) for path in ("Inputs/0", "Outputs/0")]
    assert runner.write(encode(find(db201, AXIS), 0.0, "big")) == [
        "the model computes Robot_825/Axs1_Pos: outputs cannot be written; shmio inject can show another value"
    ]


def test_runs_as_a_source_on_db201(db201: Layout, tmp_path: Path) -> None:
    file = tmp_path / "supervisor.toml"
    file.write_text(
        '[instance]\nname = "a50"\n[[source]]\nname = "cell"\nconnector = "simulation"\nwritable = ["Outputs"]\n'
        f'model = "shmio.simulation.a50:A50Cell"\nlayout = "{ROOT / "db201.db"}"\n'
    )
    prepared = prepare(file)
    assert prepared.plan.warnings == ()
    assert prepared.layouts["cell"] == db201


def test_smooth_begins_and_ends_at_rest() -> None:
    assert [smooth(u) for u in (-1, 0, 0.5, 1, 2)] == [0, 0, 0.5, 1, 1]
    assert smooth(0.001) < 0.00001
    assert smooth(0.999) > 0.99999


def test_track_meets_its_keys_and_closes_the_cycle() -> None:
    track = Track([(1.0, (0.0, 5.0)), (3.0, (10.0, 5.0)), (4.0, (10.0, 5.0))], cycle_s=8.0, breath=0.0)
    for turn in (0.0, 8.0, 80.0):
        assert track.pose(turn + 1.0) == (0.0, 5.0)
        assert track.pose(turn + 2.0) == (5.0, 5.0)
        assert track.pose(turn + 3.5) == (10.0, 5.0)
        assert track.pose(turn + 6.5) == pytest.approx((5.0, 5.0))
        assert track.pose(turn + 0.999999) == pytest.approx((0.0, 5.0), abs=1e-6)


def test_track_rests_between_equal_keys_only() -> None:
    track = Track([(0.0, (0.0,)), (1.0, (1.0,)), (2.0, (1.0,))], cycle_s=3.0, breath=0.1)
    assert [track.rest(time_s) for time_s in (0.5, 1.5, 2.5)] == [None, (1.0,), None]


def test_breath_keeps_a_resting_axis_moving_within_its_amplitude() -> None:
    track = Track([(0.0, (7.0, 7.0)), (1.0, (7.0, 7.0))], cycle_s=2.0, breath=0.01)
    poses = [track.pose(step / 50) for step in range(500)]
    assert all(abs(value - 7) <= 0.01 for pose in poses for value in pose)
    assert max(poses)[0] - min(poses)[0] > 0.019
    assert len({first for first, _ in poses}) > 50
    assert any(abs(first - second) > 0.01 for first, second in poses)
