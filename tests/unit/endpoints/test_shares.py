"""How the endpoint's time is shared among its clients. The clock is the test's."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

import pytest
from asyncua import ua

from shmio.endpoints.opcua.requests import decode
from shmio.endpoints.opcua.subscriptions import ITEM_S, Costs, Subscription
from shmio.endpoints.shares import ALL_SHARE, ALONE_SHARE, BURST_S, BYTE_S, CLIENT_SHARE, SLICE_S, Share, Shares


class Clock:
    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def use(clock: Clock, share: Share, for_s: float) -> None:
    with share:
        clock.now_s += for_s


def work_for(clock: Clock, clients: list[Share], for_s: float) -> list[float]:
    """Let clients work whenever they may, and return what part of the time each has got."""
    begin_s, used_s = clock.now_s, [0.0] * len(clients)
    while clock.now_s - begin_s < for_s:
        idle = True
        for place, one in enumerate(clients):
            if one.wait_s == 0:
                use(clock, one, SLICE_S)
                used_s[place] += SLICE_S
                idle = False
        if idle:
            clock.now_s += max(1e-6, min(one.wait_s for one in clients))
    return [used / (clock.now_s - begin_s) for used in used_s]


def test_greedy_clients_get_their_share_and_a_modest_one_never_waits() -> None:
    for greedy in (1, 20):
        clock = Clock()
        shares = Shares(clock)
        clients, modest = [Share(shares) for _ in range(greedy)], Share(shares)
        work_for(clock, clients, 40.0)  # with the bursts
        parts = work_for(clock, clients, 20.0)
        most = min(CLIENT_SHARE, ALL_SHARE / greedy)
        assert all(part == pytest.approx(most, rel=0.2) for part in parts), (greedy, parts)
        assert sum(parts) < ALL_SHARE * 1.2
        for _ in range(100):
            clock.now_s += 0.1
            use(clock, modest, 0.001)
            assert modest.wait_s == 0


def test_a_client_that_was_idle_may_use_a_burst() -> None:
    clock = Clock()
    shares = Shares(clock)
    share, other = Share(shares), Share(shares)
    use(clock, share, BURST_S)
    assert share.wait_s == 0
    while share.wait_s == 0:
        use(clock, share, 0.01)
    use(clock, share, 0.03)
    assert share.wait_s == pytest.approx(0.03 * (1 - CLIENT_SHARE) / CLIENT_SHARE, abs=0.01 / CLIENT_SHARE)
    other.close()
    assert share.wait_s == pytest.approx(0.02 / ALONE_SHARE, abs=0.02), "it is the only client now"
    clock.now_s += 1000
    use(clock, share, 2 * BURST_S)
    assert share.wait_s > 0, "it has saved no more than a burst"


def test_bytes_count_as_time() -> None:
    clock = Clock()
    shares = Shares(clock)
    share, _ = Share(shares), Share(shares)
    share.count_bytes(round(1 / BYTE_S))
    assert share.wait_s == pytest.approx((1 - BURST_S) / CLIENT_SHARE)


def test_only_the_time_counts_in_which_a_coroutine_runs() -> None:
    clock = Clock()
    shares = Shares(clock)
    share, _ = Share(shares), Share(shares)

    async def work() -> str:
        for _ in range(3):
            clock.now_s += 0.1
            await asyncio.sleep(0)
        with pytest.raises(KeyError):
            await fail()
        return "done"

    async def fail() -> None:
        await asyncio.sleep(0)
        raise KeyError

    async def main() -> None:
        task = asyncio.create_task(share.count(work()))
        for _ in range(10):
            await asyncio.sleep(0)
        assert await task == "done"

    asyncio.run(main())
    use(clock, share, BURST_S - 0.1)
    assert share.wait_s > 0, "the coroutine has used the rest"
    cancelled: list[bool] = []

    async def wait() -> None:
        try:
            await asyncio.sleep(1000)
        except asyncio.CancelledError:
            cancelled.append(True)
            raise

    async def cancel() -> None:
        task = asyncio.create_task(Share(shares).count(wait()))
        await asyncio.sleep(0)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    asyncio.run(cancel())
    assert cancelled == [True]


def in_turns(do: Callable[[Share], Awaitable[object]], clock: Clock) -> int:
    """Do something, and return how often another task could proceed meanwhile."""
    turns = 0

    async def main() -> None:
        nonlocal turns
        share = Share(Shares(clock))
        task = asyncio.ensure_future(share.count(do(share)))  # type: ignore[arg-type]
        while not task.done():
            await asyncio.sleep(0)
            turns += 1
        await task

    asyncio.run(main())
    return turns


def test_a_large_request_is_decoded_in_slices() -> None:
    class Ticking(Clock):
        def __call__(self) -> float:
            self.now_s += SLICE_S / 10
            return self.now_s

    count = 1000
    element = ua.ua_binary.struct_to_binary(ua.ReadValueId(ua.NodeId("cell/step", 2), ua.AttributeIds.Value))
    body = ua.ua_binary.Primitives.Double.pack(0.0) + (2).to_bytes(4, "little") + count.to_bytes(4, "little")

    async def read(share: Share) -> None:
        found = await decode(ua.ReadParameters, ua.utils.Buffer(body + element * count), count, share)
        assert len(found.NodesToRead) == count

    assert in_turns(read, Ticking()) > count / 15


def test_sampling_intervals_grow_with_what_a_client_asks_for() -> None:
    def subscription(owner: object) -> Subscription:
        owner.session_id = ua.NodeId(1)  # type: ignore[attr-defined]
        return Subscription(1, owner, ua.CreateSubscriptionParameters(20.0, 100, 10, 0, True, 0), lambda: None)

    class Owner:
        pass

    costs = Costs()
    one, other = subscription(Owner()), subscription(Owner())
    assert costs.interval_ms(one, ITEM_S, 1) < 1
    # The second value has 1,000 items, of 10 us each: 10 ms of work, of which 0.3 of the time may consist.
    assert costs.interval_ms(one, ITEM_S, 1000) == pytest.approx(33, rel=0.02)
    for _ in range(4000):
        costs.add(one, ITEM_S + 8000 * BYTE_S)
    assert costs.interval_ms(one, ITEM_S, 1) == pytest.approx(4000 * 170e-6 / CLIENT_SHARE * 1e3, rel=0.02)
    assert costs.interval_ms(other, ITEM_S, 1) == pytest.approx(4000 * 170e-6 / ALL_SHARE * 1e3, rel=0.02)
    for _ in range(4000):
        costs.add(one, -(ITEM_S + 8000 * BYTE_S))
    assert costs.interval_ms(other, ITEM_S, 1) < 1
