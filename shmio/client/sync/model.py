"""A model as a program with threads serves it."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Self

import grpc

from shmio.client import model
from shmio.client.calls import Target
from shmio.client.model import Member, Part, Work
from shmio.errors import ConflictError, RemoteError

Step = Callable[[float, float, model.Values], Mapping[str, object] | None]
"""Computes outputs from ``(time_s, dt_s, inputs)``: those of ``time_s``, ``dt_s`` after the step before."""


class Simulation(Member, Iterator[Work]):
    """A source that this program computes: iterate over the steps, and answer each. Close it, or use ``with``.

    For one thread, :meth:`close` for any.
    """

    def __init__(self, method: Any, target: Target, source: str, name: str) -> None:
        self._target = target
        self._requests: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._requests.put(model.join(source, name))
        self._call = method(iter(self._requests.get, None), metadata=target.metadata)
        self._closed = False
        try:
            super().__init__(Part(next(self._call, None)))
        except grpc.RpcError as error:
            self.close()
            target.fail(error)
        except BaseException:
            self.close()
            raise

    def __next__(self) -> Work:
        """The next step, waited for; ends when it is closed.

        LostError: the endpoint has ended, or a reload has changed the source; RemoteError.
        """
        try:
            self._work = self._part.take(next(self._call))
        except grpc.RpcError as error:
            if self._closed:
                raise StopIteration from None
            self._target.fail(error)
        return self._work

    def done(self, outputs: Mapping[str, object]) -> None:
        """Answer the present step with outputs by their paths; those that are left out keep what they have.

        PathError, ValueRangeError: nothing has been sent.
        """
        self._requests.put(self._part.done(self._present(), outputs))
        self._work = None

    def fail(self, reason: str) -> None:
        """Answer the present step: it has failed, and why. Nothing of it is shown."""
        self._requests.put(self._part.failed(self._present(), reason))
        self._work = None

    def compute(self, work: Work, step: Step, rejoining: model.Rejoining) -> None:
        """Answer a step with what a program's code says to it, and with what that raises."""
        rejoining.heed(self._part, work)
        try:
            answer = rejoining.answer(self._part, work, step(work.time_s, work.dt_s, work.inputs))
        except Exception as error:  # noqa: BLE001  whatever it is, the step has failed with it
            answer = rejoining.failed(self._part, work, error)
        self._requests.put(answer)
        self._work = None

    def close(self) -> None:
        """Leave: steps fail until another joins."""
        self._closed = True
        self._requests.put(None)
        self._call.cancel()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def serve(
    join: Callable[[], Simulation],
    step: Step,
    start: Callable[[Simulation], object] | None,
    patience_s: float,
    closed: Callable[[], bool],
) -> None:
    """Compute a source until it is ``closed``; what :meth:`Client.simulate` says."""
    rejoining = model.Rejoining(patience_s)
    while not closed():
        try:
            with join() as simulation:
                if start is not None:
                    start(simulation)
                rejoining.joined()
                for work in simulation:
                    simulation.compute(work, step, rejoining)
                return
        except (RemoteError, ConflictError) as error:
            if closed():
                return
            if not rejoining.patient(error):
                raise
            time.sleep(model.RETRY_S)
        except ValueError:  # the channel was closed just before
            if closed():
                return
            raise
