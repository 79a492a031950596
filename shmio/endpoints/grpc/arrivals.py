"""Whether what has reached this process has reached those who handle it, too."""

from __future__ import annotations

from typing import Final

import grpc

TURNS: Final = 3
"""One of gRPC's threads may be held up by the machine with what it has received, while others go on."""


class Arrivals:
    """A turn of the queue through which all that gRPC has received goes to the event loop.

    What a handler is waiting for and has come lies in that queue; so does, behind it, the end of an operation that has
    nothing to wait for: that a channel which was never used is not shut down.
    """

    def __init__(self) -> None:
        self._channel: grpc.aio.Channel | None = None

    async def handled(self) -> None:
        """Wait until handlers have been given what came before."""
        if self._channel is None:
            self._channel = grpc.aio.insecure_channel("unix:///dev/null")
        for _ in range(TURNS):
            await self._channel.wait_for_state_change(grpc.ChannelConnectivity.SHUTDOWN)

    async def close(self) -> None:
        """Nothing is waited for any more."""
        if self._channel is not None:
            await self._channel.close()
