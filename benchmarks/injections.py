"""The CPU time to publish one frame of DB201, with different injections active.

One process publishes into shared memory, and nobody reads. The first line is without any injection. Conditions are
evaluated once a cycle. Operations make the image that consumers see.
"""

from __future__ import annotations

import secrets
import statistics
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import msgspec
from common import begin, db201, interleave, table

from shmio.config import Declaration
from shmio.connectors.commands import CommandProcessor
from shmio.connectors.output import Image, Output
from shmio.segment import Attributes, BlockSpec, ProcessSpec, Provenance, Quality, Segment
from shmio.segment.injection_list import declared_document

LAYOUT = db201()
AXES = [f"cell/Robot_{robot}/Axs{axis}_Pos" for robot in (800, 825, 850) for axis in range(1, 7)]
PERIOD_NS = 20_000_000


def declaration(name: str, target: str, operation: str, **keys: Any) -> Declaration:
    return msgspec.convert({"name": name, "target": target, "operation": operation, **keys}, Declaration)


def of_all_axes(operation: str, count: int, **keys: Any) -> list[Declaration]:
    return [declaration(f"x{place}", AXES[place % len(AXES)], operation, **keys) for place in range(count)]


WAITING = "cell/Robot_800/Axs1_Pos > 90 and not cell/Outputs/13.%X0"
CASES: dict[str, list[Declaration]] = {
    "no injection": [],
    "1 that waits for its time": of_all_axes("set", 1, value=1, start_s=1e9),
    "1 that waits for a condition": of_all_axes("set", 1, value=1, when=WAITING),
    "set 1 REAL": of_all_axes("set", 1, value=1),
    "freeze 1 REAL": of_all_axes("freeze", 1),
    "delay 1 REAL by 10 cycles": of_all_axes("delay", 1, delay_cycles=10),
    "offset 1 REAL": of_all_axes("offset", 1, value=1),
    "noise on 1 REAL": of_all_axes("noise", 1, amplitude=1, distribution="gaussian"),
    "noise on 6 REALs at once": [declaration("x", "cell/Robot_800", "noise", amplitude=1, distribution="gaussian")],
    "flip a bit of the whole block": [declaration("x", "cell", "flip")],
    "8 noises, each with a condition": of_all_axes("noise", 8, amplitude=1, when="not (" + WAITING + ")"),
    "64 noises, each with a condition": of_all_axes("noise", 64, amplitude=1, when="not (" + WAITING + ")"),
}


def publisher(stack: ExitStack, declared: list[Declaration]) -> Callable[[], None]:
    """Return a function that publishes the frame of the next cycle at each call."""
    spec = BlockSpec(
        "cell", LAYOUT, PERIOD_NS, 10**9, 1 << 22, Attributes("s7", ("**",), True), declared_document(declared)
    )
    segment = stack.enter_context(
        Segment.create(f"bench-{secrets.token_hex(4)}", [spec], [ProcessSpec("cell", "source")])
    )
    stack.callback(segment.unlink)
    output = Output(segment.writer("cell"))
    CommandProcessor(output, ["**"], lambda: 0, armed=True)
    image = bytes(LAYOUT.size)
    cycle = 0

    def publish() -> None:
        nonlocal cycle
        cycle += 1
        output.publish(Image(image, cycle, 1, Quality.GOOD, Provenance.LIVE, ""))

    publish()
    return publish


def cpu_ns(function: Callable[[], object], calls: int) -> Callable[[], float]:
    """Make a sampler of the mean CPU time of one call in ns, over a number of calls."""

    def sample() -> float:
        begun_ns = time.thread_time_ns()
        for _ in range(calls):
            function()
        return (time.thread_time_ns() - begun_ns) / calls

    return sample


def main() -> None:
    quick = begin("CPU time to publish a frame with injections, µs")
    with ExitStack() as stack:
        calls, rounds = (20, 3) if quick else (50, 30)
        contenders = {name: cpu_ns(publisher(stack, declared), calls) for name, declared in CASES.items()}
        samples = interleave(contenders, rounds)
    none = min(samples["no injection"])
    rows = []
    for name, values in samples.items():
        best, middle = min(values), statistics.median(values)
        rows.append([name, f"{best / 1000:.1f}", f"{middle / 1000:.1f}", f"{(best - none) / 1000:+.1f}"])
    table(["injections", "best", "median", "beyond none"], rows)


if __name__ == "__main__":
    main()
