from __future__ import annotations

from shmio.backoff import Backoff


def test_waits_double_up_to_the_limit() -> None:
    backoff = Backoff(0.1, 0.5)
    assert [backoff.wait_s(waits) for waits in range(5)] == [0.1, 0.2, 0.4, 0.5, 0.5]
    assert backoff.wait_s(10**9) == 0.5


def test_jitter_spreads_the_waits_around_the_same_value() -> None:
    waits = [Backoff(1.0, 15.0, jitter=0.5).wait_s(2) for _ in range(200)]
    assert len(set(waits)) > 1
    assert all(2.0 <= wait_s <= 6.0 for wait_s in waits)
    longest = [Backoff(1.0, 15.0, jitter=0.5).wait_s(9) for _ in range(200)]
    assert max(longest) > 15.0  # otherwise many clients would retry at the same time
    assert all(7.5 <= wait_s <= 22.5 for wait_s in longest)
