"""An injection as a program with threads holds it."""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterator, Mapping
from typing import Any, Self

import grpc

from shmio.client import calls, injection
from shmio.client.calls import Outcome, Target
from shmio.client.update import Update
from shmio.errors import CommandError, RemoteError, ShmioError


class Shadow(Iterator[Update]):
    """An injection that stands. Several threads may give values; one may iterate over the originals.

    ``table``: the registers that it stands over, and the originals by now.
    """

    def __init__(self, method: Any, first: bytes, target: Target, timeout_s: float) -> None:
        self._target = target
        self._timeout_s = timeout_s
        self._turn = threading.Condition()
        self._answers: dict[int, Any] = {}
        self._error: ShmioError | None = None
        self._over = False
        self._updates: list[Update] = []
        self._requests: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._requests.put(first)
        self._call = method(iter(self._requests.get, None), metadata=target.metadata)
        try:
            self._held = injection.Held(next(self._call))
        except grpc.RpcError as error:
            self._requests.put(None)
            target.fail(error)
        self.number = self._held.number
        """By which anybody may lift it."""
        self.table = self._held.table
        self._thread = threading.Thread(target=self._read, name=f"shadow-{self.number}", daemon=True)
        self._thread.start()

    def set(
        self,
        values: Mapping[str, object] | None = None,
        arrays: injection.Arrays | None = None,
        raw: injection.Raw = (),
    ) -> list[Outcome]:
        """Give values by path, by the columns of ``table``, or as raw bytes; wait for what became of them.

        PathError, ValueRangeError; CommandError: it was lifted; RemoteError.
        """
        values, raw = values or {}, list(raw)
        with self._turn:
            self._check()
            sequence, data = self._held.request(values, arrays, raw, answered=True)
            self._requests.put(data)
            if not self._turn.wait_for(lambda: sequence in self._answers or self._over, calls.WRITE_PATIENCE_S):
                raise RemoteError(f"{self._target.address}: it did not answer in time")
            if sequence not in self._answers:
                self._check()
            return injection.ends(values, self._answers.pop(sequence), more=bool(arrays or raw))

    def send(
        self,
        values: Mapping[str, object] | None = None,
        arrays: injection.Arrays | None = None,
        raw: injection.Raw = (),
    ) -> None:
        """The same without waiting. A value that is wrong ends the injection, which the next call tells."""
        with self._turn:
            self._check()
            self._requests.put(self._held.request(values or {}, arrays, raw, answered=False)[1])

    def __next__(self) -> Update:
        """The next original, waited for; ends when it is over. Asked for with ``originals``."""
        with self._turn:
            if not self._updates:
                self._turn.wait_for(lambda: self._held.waits or self._over)
                if not self._held.waits:
                    if self._error is not None:
                        raise self._error
                    raise StopIteration
                self._updates.extend(self._held.originals())
            return self._updates.pop(0)

    def _check(self) -> None:
        if self._error is not None:
            raise self._error
        if self._over:
            raise CommandError(f"the injection {self.number} is over")

    def _read(self) -> None:
        error: ShmioError | None = None
        try:
            for found in self._call:
                with self._turn:
                    self._held.keep(found)
                    self._answers |= {answer.sequence: answer.outcome for answer in found.answers}
                    self._turn.notify_all()
        except grpc.RpcError as caught:
            error = None if self._call.cancelled() else self._target.error(caught)
        except ShmioError as caught:
            error = caught
        with self._turn:
            self._error, self._over = error, True
            self._turn.notify_all()
        self._requests.put(None)

    def close(self) -> None:
        """Lift it, unless it is to be kept."""
        self._requests.put(None)
        self._thread.join(self._timeout_s)
        self._call.cancel()
        self._thread.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
