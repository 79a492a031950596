"""Calls and waiting with threads. ``shmio.client.aio.transport`` does the same with asyncio."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final

import grpc

from shmio.client import calls
from shmio.client.calls import OPTIONS, Target
from shmio.client.model import Values
from shmio.errors import RemoteError

Outputs = Mapping[str, object] | None
Step = Callable[[float, float, Values], Outputs]
"""Function of ``(time_s, dt_s, inputs)`` that returns the outputs, by path, at the end of a step.

Times are in s.
"""
CLOSED: Final = ValueError
"""Error that grpcio raises for a call on a closed channel."""
sleep: Final = time.sleep


def outputs_of(found: Outputs) -> Outputs:
    """Return the outputs of a step."""
    return found


class Channel:
    """The gRPC connection of one client."""

    def __init__(self, target: Target, timeout_s: float) -> None:
        self.target = target
        self.timeout_s = timeout_s
        """Time-out of calls that the endpoint answers at once, in s."""
        self.closed = False
        credentials = target.credentials
        self.grpc = (
            grpc.insecure_channel(target.address, OPTIONS)
            if credentials is None
            else grpc.secure_channel(target.address, credentials, OPTIONS)
        )

    def close(self) -> None:
        """End all calls, and the connection."""
        self.closed = True
        self.grpc.close()


class Stream(Iterator[Any]):
    """Iterator over the answers to one request. It ends when the stream or its channel is closed.

    Raises:
        ShmioError: The endpoint ended the stream.
    """

    def __init__(self, channel: Channel, method: Any, request: Any, *, timeout_s: float | None = None) -> None:
        self._channel = channel
        self._closed = False
        self._answered = False
        self._call = method(request, timeout=timeout_s, metadata=channel.target.metadata)

    def __next__(self) -> Any:
        try:
            found = next(self._call)
        except grpc.RpcError as error:
            if self._closed or self._channel.closed:
                raise StopIteration from None
            self._channel.target.fail(error, answered=self._answered)
        self._answered = True
        return found

    def first(self) -> Any:
        """Return the first answer; None if the stream was closed. Raise RemoteError if none comes in time."""
        late = threading.Event()

        def give_up() -> None:
            late.set()
            self._call.cancel()

        timer = threading.Timer(calls.WRITE_PATIENCE_S, give_up)
        timer.daemon = True
        timer.start()
        try:
            return next(self, None)
        except RemoteError:
            if late.is_set():
                raise calls.unanswered(self._channel.target) from None
            raise
        finally:
            timer.cancel()
            timer.join()

    def to_list(self) -> list[Any]:
        """Return all answers. Raise RemoteError if the channel was closed meanwhile."""
        found = list(self)
        if self._channel.closed:
            raise RemoteError(f"{self._channel.target.address}: the client was closed")
        return found

    def close(self) -> None:
        """End the stream."""
        self._closed = True
        self._call.cancel()


class Duplex(Stream):
    """A stream that also sends further requests. The first requests are sent at once."""

    def __init__(self, channel: Channel, method: Any, *first: Any) -> None:
        self._requests: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self.write(*first)
        super().__init__(channel, method, iter(self._requests.get, None))
        # grpcio's thread waits for requests until then. The call also ends with its channel.
        if not self._call.add_callback(self.finish):
            self.finish()

    def write(self, *requests: Any) -> None:
        """Send requests.

        If the stream has ended, they are dropped, and reading raises the reason.
        """
        for request in requests:
            self._requests.put(request)

    def finish(self) -> None:
        """Tell the endpoint that no more requests follow."""
        self._requests.put(None)


class Condition(threading.Condition):
    """Condition on which several threads can wait, each with its own time-out."""

    def wait_until(self, predicate: Callable[[], bool], timeout_s: float | None = None) -> bool:
        """Wait until the predicate is true; return False after ``timeout_s`` seconds (None: never)."""
        return self.wait_for(predicate, timeout_s)


class Background(threading.Thread):
    """Daemon thread that runs a function. The program can end while the thread runs."""

    def __init__(self, run: Callable[[], None], name: str) -> None:
        super().__init__(target=run, name=name, daemon=True)
        self.start()
