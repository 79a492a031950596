"""When a subscription publishes."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from typing import Any

from asyncua import ua

from shmio.endpoints.opcua.subscriptions import MAX_PUBLISHING_MS, MIN_PUBLISHING_MS, Subscription

TURNS = 5


class Owner:
    """The session of a client that always waits for publications."""

    session_id = ua.NodeId(1)

    def __init__(self) -> None:
        self.sizes: list[int] = []
        self.arrived = asyncio.Event()

    def sent(self, result: ua.PublishResult, _request: Any, _subscription: Subscription) -> None:
        data = result.NotificationMessage.NotificationData
        self.sizes.append(int.from_bytes(data[0].Body[:4], "little") if data else 0)
        self.arrived.set()


class Changed:
    """A monitored item whose value has changed."""

    handle = 1

    def take(self) -> Iterator[bytes]:
        yield b"value"


async def turns() -> None:
    """Let the loop do what is due now; no timer runs out meanwhile."""
    for _ in range(TURNS):
        await asyncio.sleep(0)


def test_a_change_after_an_interval_without_changes_is_published_at_once() -> None:
    async def main() -> None:
        owner = Owner()
        asked = ua.CreateSubscriptionParameters(MIN_PUBLISHING_MS, 10_000, 3000, 0, True, 0)
        subscription = Subscription(1, owner, asked, lambda: None)
        subscription.pub_request_callback = lambda _: object()
        subscription.start()
        await owner.arrived.wait()  # the first message, and nothing in it
        subscription.revise(asked.__class__(MAX_PUBLISHING_MS, 10_000, 3000, 0, True, 0))
        assert owner.sizes == [0]
        for one in (Changed(), Changed(), Changed()):
            subscription.mark(one)  # type: ignore[arg-type]
        await turns()
        assert owner.sizes == [0, 3], "all of a frame are one message"
        subscription.mark(Changed())  # type: ignore[arg-type]
        await turns()
        assert owner.sizes == [0, 3], "the next one waits for the end of the interval"
        subscription.stop()

    asyncio.run(main())
