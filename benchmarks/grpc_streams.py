"""gRPC streams: updates a second compared with a bare grpc.aio server that sends prepared bytes; latency at 1 kHz.

The clients use @grpc/grpc-js, in one process with a connection for each stream. A stream of version 1 has one
register, the same for all. A subscriber of version 2 has 100 registers. Frames are published as fast as the bare
server could send the changes, or slightly faster.

The source is a process that the bare server does not have beside it. On a machine with few cores, compare the
server's CPU time for an update rather than the rate. *Out of a queue* is the bare server with an asyncio.Queue for
each stream, filled at the pace of the frames: a server whose values come from elsewhere must do that.
"""

from __future__ import annotations

import base64
import json
import shutil
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, Final

from common import ROOT, Child, CpuTime, begin, interleave, quantiles, table
from frames import REGISTERS
from google.protobuf.message import Message

from shmio.wire import simlog_v1_pb2 as v1
from shmio.wire import simlog_v2_pb2 as v2

V1, V2 = "/simulation.server.SimlogAPI/", "/simlog.server.SimlogAPI/"
MESSAGE_BYTES: Final = 40
"""Size of the bare server's message, which is that of an update of version 1 or 2."""
WARM_UP_S = 0.3
OFFERED = 1.05
"""Ratio of the updates that are published to those that the bare server sends."""
BARE = "bare grpc.aio, ready bytes"


def call(method: str, request: Message) -> dict[str, Any]:
    return {"method": method, "request": base64.b64encode(request.SerializeToString()).decode(), "then": []}


def first(count: int) -> list[dict[str, Any]]:
    """Return the calls of so many streams of version 1."""
    return [call(V1 + "Subscribe", v1.TopicDescriptor(path="cell/r0"))] * count


def second(count: int, topics: int) -> list[dict[str, Any]]:
    """Return the calls of so many subscribers of version 2, each with so many topics."""
    streams = []
    for number in range(count):
        stream = call(V2 + "CreateSubscriber", v2.Subscriber(name="bench", uuid=f"bench {number}"))
        stream["then"] = [
            call(V2 + "Subscribe", v2.SubscriptionRequest(path=f"cell/r{topic}", subscriberUUID=f"bench {number}"))
            for topic in range(topics)
        ]
        streams.append(stream)
    return streams


@contextmanager
def clients(address: str, streams: list[dict[str, Any]], started_ns: int = 0, **stamps: Any) -> Iterator[Child]:
    """Start a process with these streams, and wait until each stream has received a message."""
    with Child("streams.js", address, started_ns) as child:
        child.ask(json.dumps({"streams": streams, "stamps": None} | stamps))
        yield child


class Contender:
    """A server under one load, with its updates a second and its CPU time for each update."""

    def __init__(self, address: str, pid: int, streams: list[dict[str, Any]], work: Callable[[float], object]) -> None:
        """Prepare to measure a server. ``work`` is called with a number of seconds, and makes updates for that time."""
        self._server = address, pid
        self._streams = streams
        self._work = work
        self.cost_us: list[float] = []

    def sample(self, duration_s: float) -> float:
        """Return the updates a second."""
        address, pid = self._server
        with clients(address, self._streams) as client:
            self._work(WARM_UP_S)
            client.ask("")
            cpu, begun_s = CpuTime.of(pid), time.monotonic()
            self._work(duration_s)
            used, taken_s = CpuTime.of(pid).since(cpu), time.monotonic() - begun_s
            count: int = client.ask("")["messages"]
        self.cost_us.append(1e6 * (used.user_s + used.system_s) / count)
        return count / taken_s


def measure_throughput(counts: Sequence[int], rounds: int, duration_s: float) -> None:
    """Print a table for each number of streams."""
    with Child("bare.py", MESSAGE_BYTES) as bare, Child("frames.py") as source:

        def publish(hz: float, seconds: float) -> None:
            source.ask(json.dumps({"hz": hz, "seconds": seconds}))

        ours = source.hello["address"], source.hello["pid"]
        for count in counts:
            limit = Contender(bare.hello, bare.pid, first(count), time.sleep)
            hz = OFFERED * limit.sample(duration_s) / count
            with Child("bare.py", MESSAGE_BYTES, hz) as paced:
                contenders = {
                    "version 1": Contender(*ours, first(count), partial(publish, hz)),
                    "version 2": Contender(*ours, second(count, REGISTERS), partial(publish, hz / REGISTERS)),
                    "bare, out of a queue": Contender(paced.hello, paced.pid, first(count), time.sleep),
                    BARE: limit,
                }
                samplers = {name: partial(contender.sample, duration_s) for name, contender in contenders.items()}
                samples = interleave(samplers, rounds)
            rates = {name: statistics.median(values) for name, values in samples.items()}
            costs = {name: statistics.median(contender.cost_us) for name, contender in contenders.items()}
            rows = [
                [
                    name,
                    f"{rate:.0f}",
                    f"{rate / rates[BARE]:.2f}",
                    f"{costs[name]:.1f}",
                    f"{costs[name] / costs[BARE]:.2f}",
                ]
                for name, rate in rates.items()
            ]
            table([f"{count} streams", "updates/s", "of bare", "server's CPU, us each", "of bare"], rows)


def measure_latency(duration_s: float) -> None:
    rows = []
    with Child("frames.py") as source:
        of_first = {"stamps": [9, 2, 2]}
        of_second = {"stamps": [1, 1], "seconds": True}
        for count in (1, 50):
            for name, streams, stamps in (
                ("version 1", first(count), of_first),
                ("version 2", second(count, 1), of_second),
            ):
                with clients(source.hello["address"], streams, source.hello["started_ns"], **stamps) as client:
                    source.ask(json.dumps({"hz": 1000, "seconds": WARM_UP_S}))
                    client.ask("")
                    cpu, begun_s = CpuTime.of(source.hello["pid"]), time.monotonic()
                    frames = source.ask(json.dumps({"hz": 1000, "seconds": duration_s}))
                    used, taken_s = CpuTime.of(source.hello["pid"]).since(cpu), time.monotonic() - begun_s
                    latencies = client.ask("")["latencies"]
                cells = [f"{cut / 1000:.2f}" for cut in quantiles(latencies)]
                share = 100 * (used.user_s + used.system_s) / taken_s
                came = 100 * len(latencies) / (frames * count)
                rows.append([f"{name}, {count} subscribers", *cells, f"{came:.1f}", f"{share:.0f}"])
    table(["frame published to client at 1 kHz, ms", "median", "p90", "p99", "came, %", "endpoint's CPU, %"], rows)


def main() -> None:
    quick = begin("gRPC streams: updates a second, and latency")
    if shutil.which("node") is None or not (ROOT / "tests/unit/endpoints/node/node_modules").exists():
        raise SystemExit("needs Node and its packages: npm ci --prefix tests/unit/endpoints/node")
    if quick:
        measure_throughput((2,), 1, 0.3)
        measure_latency(0.3)
    else:
        measure_throughput((1, 10, 50), 3, 2.0)
        measure_latency(5.0)


if __name__ == "__main__":
    main()
