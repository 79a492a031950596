"""When a client that is far behind is tried again."""

from __future__ import annotations

from shmio.endpoints.grpc.streams.back_pressure import BEHIND_S, WINDOW_S, LossMonitor


def far_behind(now_s: float) -> LossMonitor:
    """One that was found to lose most of what there is."""
    losses = LossMonitor()
    losses.offer(now_s - WINDOW_S)
    losses.lose(1)
    losses.offer(now_s)
    assert losses.behind
    return losses


def test_all_who_are_far_behind_are_tried_again_together() -> None:
    together_s = 7 * BEHIND_S
    paces = [far_behind(together_s - before_s) for before_s in (0.9 * BEHIND_S, 0.4 * BEHIND_S, 0.001)]
    for now_s, behind in ((together_s - 0.0005, True), (together_s, False)):
        for losses in paces:
            losses.offer(now_s)
        assert [losses.behind for losses in paces] == [behind] * 3
