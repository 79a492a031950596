"""What a flood of calls took is given back while it lasts, and for a while after it."""

from __future__ import annotations

from shmio.endpoints.grpc.server.memory import AFTER_S, EVERY_S, FLOOD_CALLS, Trimmer


def test_free_memory_is_given_back_again_and_again_after_a_flood() -> None:
    now_s, trims = 100.0, []
    trimmer = Trimmer(lambda: now_s, lambda _: trims.append(now_s))
    trimmer.look(FLOOD_CALLS - 1)
    assert trims == [], "a few calls are no flood"
    trimmer.look(FLOOD_CALLS)
    for _ in range(200):
        now_s += EVERY_S / 2
        trimmer.look(FLOOD_CALLS)
    assert trims == [100.0 + EVERY_S * number for number in range(round(AFTER_S / EVERY_S))]
