"""gRPC subscribers of all sources: streams on separate connections, renewed when they break."""

from __future__ import annotations

import time
from functools import partial

import grpc

from shmio.wire.simlog_v1_pb2 import TopicDescriptor
from shmio.wire.simlog_v1_pb2_grpc import SimlogAPIStub
from tests.faults.checker import Checker
from tests.faults.checks import Source, ValueCheck

STREAMS = 2
PAUSE_S = 0.1
BREAKS = {grpc.StatusCode.UNAVAILABLE, grpc.StatusCode.CANCELLED, grpc.StatusCode.DEADLINE_EXCEEDED}
"""Status codes of a stream whose server was killed, stopped or is not running."""
CALL_S = 20.0
"""Maximum duration of a stream, so that a frozen server does not block its client for ever."""
UNDER_WAY_NS = 3_000_000_000
"""Additional ns that a value may be late.

A paused endpoint delivers old messages when it continues, and messages of v1 have no quality.
"""
OPTIONS = [
    ("grpc.initial_reconnect_backoff_ms", 100),
    ("grpc.min_reconnect_backoff_ms", 100),
    ("grpc.max_reconnect_backoff_ms", 500),
    ("grpc.use_local_subchannel_pool", 1),
]


def subscribe(checker: Checker, source: Source, name: str) -> None:
    """Check the values of the block's first word."""
    check = ValueCheck(source, checker.complain, checker.counts(name))
    while not checker.stopping.wait(PAUSE_S):
        with grpc.insecure_channel(checker.description.grpc, options=OPTIONS) as channel:
            stub = SimlogAPIStub(channel)  # type: ignore[no-untyped-call]
            call = stub.Subscribe(TopicDescriptor(path=f"{source.name}/stamp"), timeout=CALL_S)
            try:
                for message in call:
                    check.value(int(message.value), time.monotonic_ns(), slack_ns=checker.slack_ns + UNDER_WAY_NS)
                    if checker.stopping.is_set():
                        call.cancel()
            except grpc.RpcError as error:
                if error.code() not in BREAKS:
                    checker.complain(f"{name} ended with {error.code()}: {error.details()}")


def main() -> None:
    checker = Checker()
    for source in checker.sources:
        for index in range(STREAMS):
            checker.work(partial(subscribe, checker, source, f"grpc {source.name} {index}"))
    checker.run()


if __name__ == "__main__":
    main()
