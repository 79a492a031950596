"""Many steps by one call, for programs with threads."""

from __future__ import annotations

import queue
from collections.abc import Iterator
from typing import Any, Self

import grpc

from shmio.client import calls
from shmio.client.calls import Stepped, Target


class Steps(Iterator[Stepped]):
    """Steps of time on one stream, which costs less than a call for each. Close it, or use ``with``; for one thread.

    Iterate over it for those that :meth:`Client.steps` has asked for, in their order: each when all streams have what
    has changed in it, while the next ones go on; and, for a program that does something between them, :meth:`step`.
    """

    def __init__(self, method: Any, target: Target, count: int, dt_s: float | None) -> None:
        """``method``: the call. ValueRangeError."""
        self._target = target
        self._left = count
        self._waiting: Iterator[Any] = iter(())
        self._requests: queue.SimpleQueue[Any] = queue.SimpleQueue()
        for request in calls.steps_requests(count, dt_s):
            self._requests.put(request)
        self._call = method(iter(self._requests.get, None), metadata=target.metadata)

    def __next__(self) -> Stepped:
        """The next one that is done, waited for; ends when all that were asked for are.

        CommandError: it failed, or another program owns time, and none of those behind it is done; ValueRangeError,
        RemoteError.
        """
        if not self._left:
            raise StopIteration
        while True:
            for found in self._waiting:
                self._left -= 1
                return Stepped.of(found)
            try:
                self._waiting = iter(next(self._call).steps)
            except grpc.RpcError as error:
                self.close()
                self._target.fail(error)

    def step(self, dt_s: float | None = None) -> Stepped:
        """Do one more, and wait for it, and for those that were asked for before. Errors as of iterating."""
        for request in calls.steps_requests(1, dt_s):
            self._requests.put(request)
        self._left += 1
        *_, last = self
        return last

    def close(self) -> None:
        """Ask for no more: a step that was begun is done, those behind it are not."""
        self._left = 0
        self._requests.put(None)
        self._call.cancel()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
