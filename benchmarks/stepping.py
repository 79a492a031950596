"""A process with a client that steps, and has subscribed to the changes.

It reads lines with an address, a kind of client and a number of seconds, and prints the steps a second. It makes a
step when it has received everything of the step before. The kind ``alone`` has no subscription.
"""

from __future__ import annotations

import argparse
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from queue import SimpleQueue
from typing import Any

import grpc
from common import tell
from counting import COUNT

from shmio.client import connect
from shmio.wire import simlog_v1_pb2 as v1
from shmio.wire import simlog_v2_pb2 as v2
from shmio.wire import simserver_pb2 as sim
from shmio.wire.simlog_v1_pb2_grpc import SimlogAPIStub as V1Stub
from shmio.wire.simlog_v2_pb2_grpc import SimlogAPIStub as V2Stub
from shmio.wire.simserver_pb2_grpc import SimServerAPIStub

PATHS = [f"sim/values/r{index:02}" for index in range(COUNT)]
PATIENCE_S = 30
MANY = 1_000_000
"""More steps than a sample can make."""


@contextmanager
def alone(channel: grpc.Channel) -> Iterator[Callable[[], None]]:
    """Step without a subscription."""
    stub: Any = SimServerAPIStub(channel)  # type: ignore[no-untyped-call]

    def step() -> None:
        stub.step(sim.StepRequest(), timeout=PATIENCE_S)

    yield step


@contextmanager
def version_2(channel: grpc.Channel, paths: list[str]) -> Iterator[Callable[[], None]]:
    """Step with one SimlogAPI version 2 stream. A step is complete when all values and its marker have arrived."""
    stub: Any = V2Stub(channel)  # type: ignore[no-untyped-call]
    uuid = f"benchmark-{time.monotonic_ns()}"
    stream = stub.CreateSubscriber(v2.Subscriber(name="benchmark", uuid=uuid))
    stream.initial_metadata()
    for path in [*paths, "SIMLOG://step"]:
        stub.Subscribe(v2.SubscriptionRequest(path=path, subscriberUUID=uuid), timeout=PATIENCE_S)
    for _ in paths:
        next(stream)
    with alone(channel) as call:

        def step() -> None:
            call()
            for _ in paths:
                next(stream)
            if next(stream).header.path != "SIMLOG://step":
                raise SystemExit("the step's marker did not come after the step's values")

        yield step
    stream.cancel()


@contextmanager
def native(target: str) -> Iterator[Callable[[], None]]:
    """Step by shmio.v1, where one update has all changes of a step."""
    with connect(target) as client, client.subscribe("sim/values/*") as updates:
        next(updates)

        def step() -> None:
            number = client.step().step
            while next(updates).cycle < number:
                pass

        yield step


@contextmanager
def native_stream(target: str) -> Iterator[Callable[[], None]]:
    """Step by a stream of shmio.v1, in place of a call for each step.

    Ask for a step when the one before has arrived.
    """
    with connect(target) as client, client.subscribe("sim/values/*") as updates, client.steps() as steps:
        next(updates)

        def step() -> None:
            number = steps.step().step
            while next(updates).cycle < number:
                pass

        yield step


@contextmanager
def native_many(target: str) -> Iterator[Callable[[], None]]:
    """Step by a stream of shmio.v1 that asks for all steps at once. A step is complete when its values have arrived."""
    with connect(target) as client, client.subscribe("sim/values/*") as updates, client.steps(MANY) as steps:
        next(updates)

        def step() -> None:
            number = next(steps).step
            while seen[0] < number:
                seen[0] = next(updates).cycle

        seen = [0]
        yield step


@contextmanager
def version_1(channel: grpc.Channel) -> Iterator[Callable[[], None]]:
    """Step with a SimlogAPI version 1 stream for each register and for the clock, each followed in a thread."""
    stub: Any = V1Stub(channel)  # type: ignore[no-untyped-call]
    came: SimpleQueue[None] = SimpleQueue()

    def follow(stream: Any) -> None:
        try:
            for _ in stream:
                came.put(None)
        except grpc.RpcError:
            return

    streams = [stub.Subscribe(v1.TopicDescriptor(path=path)) for path in [*PATHS, "model/clock"]]
    threads = [threading.Thread(target=follow, args=(stream,), daemon=True) for stream in streams]
    for thread in threads:
        thread.start()
    for _ in streams:
        came.get(timeout=PATIENCE_S)

    def step() -> None:
        if stub.step(v1.StepRequest(), timeout=PATIENCE_S).code:
            raise SystemExit("a step failed: see the log of the endpoint")
        for _ in streams:
            came.get(timeout=PATIENCE_S)

    yield step
    for stream in streams:
        stream.cancel()
    for thread in threads:
        thread.join()


def main() -> None:
    argparse.ArgumentParser(description=__doc__).parse_args()
    kinds: dict[str, Callable[[grpc.Channel, str], Any]] = {
        "alone": lambda channel, _: alone(channel),
        "v2": lambda channel, _: version_2(channel, PATHS),
        "v2-array": lambda channel, _: version_2(channel, ["sim/row"]),
        "v2-structure": lambda channel, _: version_2(channel, ["sim/values"]),
        "v1": lambda channel, _: version_1(channel),
        "native": lambda _, target: native(target),
        "native-stream": lambda _, target: native_stream(target),
        "native-many": lambda _, target: native_many(target),
    }
    tell("ready")
    for line in sys.stdin:
        target, kind, duration_s = line.split()
        with grpc.insecure_channel(target) as channel, kinds[kind](channel, target) as step:
            step()
            steps, begun_s = 0, time.perf_counter()
            while (taken_s := time.perf_counter() - begun_s) < float(duration_s):
                step()
                steps += 1
        tell(steps / taken_s)
    tell("done")


if __name__ == "__main__":
    main()
