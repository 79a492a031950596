from __future__ import annotations

import pytest

from shmio.simulation.motion import Track, smooth


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
