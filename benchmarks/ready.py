"""Collects the messages that an endpoint sends to a client that steps, so that a bare server can send them again."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import grpc

from shmio.wire import shmio_v1_pb2 as ours
from shmio.wire import simlog_v2_pb2 as v2
from shmio.wire import simserver_pb2 as sim

V2, SIM, OURS = "/simlog.server.SimlogAPI/", "/com.ttsnetwork.simulator3.SimServerAPI/", "/shmio.v1.Shmio/"


@dataclass(frozen=True)
class Ready:
    """The messages of a stream: ``first`` at its start, ``step`` for each step, and the answers to the calls.

    ``stream``, ``call`` and ``steps`` are the full names of the calls that deliver values, make one step and make
    many steps.
    """

    stream: str
    call: str
    answer: bytes
    first: tuple[bytes, ...]
    step: tuple[bytes, ...]
    steps: str = ""
    steps_answer: bytes = b""

    def to_json(self) -> str:
        """Return the messages as text for a command line."""
        return json.dumps({name: _text(value) for name, value in vars(self).items()})

    @classmethod
    def of(cls, text: str) -> Self:
        """Parse text that ``to_json`` returned."""
        found = json.loads(text)
        names = {"stream", "call", "steps"}
        return cls(**{name: value if name in names else _bytes(value) for name, value in found.items()})


def _text(value: Any) -> Any:
    if isinstance(value, tuple):
        return [part.hex() for part in value]
    return value.hex() if isinstance(value, bytes) else value


def _bytes(value: Any) -> Any:
    return tuple(map(bytes.fromhex, value)) if isinstance(value, list) else bytes.fromhex(value)


def version_2(target: str, paths: Sequence[str]) -> Ready:
    """Collect the messages of one SimlogAPI version 2 stream with these topics and the step's marker."""
    with grpc.insecure_channel(target) as channel:
        unary: Any = channel.unary_unary
        follow: Any = channel.unary_stream(V2 + "CreateSubscriber")
        uuid = f"ready-{time.monotonic_ns()}"
        stream = follow(v2.Subscriber(name="ready", uuid=uuid).SerializeToString())
        stream.initial_metadata()
        for path in [*paths, "SIMLOG://step"]:
            unary(V2 + "Subscribe")(v2.SubscriptionRequest(path=path, subscriberUUID=uuid).SerializeToString())
        first = tuple(next(stream) for _ in paths)
        answer = unary(SIM + "step")(sim.StepRequest().SerializeToString())
        step = tuple(next(stream) for _ in [*paths, "SIMLOG://step"])
        stream.cancel()
    return Ready(V2 + "CreateSubscriber", SIM + "step", answer, first, step)


def native(target: str, pattern: str) -> Ready:
    """Collect the messages of a subscriber of shmio.v1."""
    with grpc.insecure_channel(target) as channel:
        follow: Any = channel.unary_stream(OURS + "Subscribe")
        call: Any = channel.unary_unary(OURS + "Step")
        stream = follow(ours.SubscribeRequest(patterns=[pattern]).SerializeToString())
        first = [next(stream)]
        while not ours.SubscribeResponse.FromString(first[-1]).updates:
            first.append(next(stream))
        answer = call(b"")
        step = [next(stream)]
        while not ours.SubscribeResponse.FromString(step[-1]).HasField("step"):
            step.append(next(stream))
        stream.cancel()
    told = ours.Clock.FromString(answer)
    one = ours.StepsResponse(steps=[ours.Step(number=told.step, time_ns=told.time_ns)])
    return Ready(
        OURS + "Subscribe", OURS + "Step", answer, tuple(first), tuple(step), OURS + "Steps", one.SerializeToString()
    )
