"""Steps a second: a model with 100 registers that all change, stepped by another process that receives them.

Each client steps, waits for the answer and for everything that it has subscribed to. Model, endpoint and client are
separate processes. The clients take turns; while one steps, no other client has subscriptions. The bare server has no
model, and computes nothing: it sends the same client the same prepared messages. Its figure shows the cost of the
client itself. The chain is a bare server that also steps the model's process in an instance without an endpoint: its
figure is the limit for an endpoint whose own work costs nothing.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable
from contextlib import ExitStack

import ready
from common import HERE, Child, begin, interleave, keep, median_ratio, per_second, report, table
from instance import started
from stepping import PATHS

from shmio import attach

OURS = "v2, 100 topics in one stream"
BARE = "a bare server: {}"
CHAIN = "the chain: {}"
NATIVE = "shmio.v1, 100 registers in one update"
LOCAL = "a program on the host, no subscriber"
MODEL = f"""
[[source]]
name = "sim"
connector = "simulation"
model = "counting:Counting"
folder = "{HERE}"
"""
CONTENDERS = {
    OURS: "v2",
    "v2, a structure of 100 as one topic": "v2-structure",
    "v2, an array of 100 as one topic": "v2-array",
    "v1, 100 topics and model/clock": "v1",
    NATIVE: "native",
    "the same, steps on a stream, one by one": "native-stream",
    "the same, many steps for one request": "native-many",
    "SimServerAPI.step, no subscriber": "alone",
}


def local(instance: str, duration_s: float) -> Callable[[], float]:
    """Make a sampler of a program on the host that steps without subscribers."""

    def sample() -> float:
        with attach(instance, writable=True) as program:
            program.step()
            return per_second(program.step, duration_s)()

    return sample


def remote(client: Child, target: str, kind: str, duration_s: float) -> Callable[[], float]:
    """Make a sampler of a client in another process, which connects for each sample."""
    return lambda: float(client.ask(f"{target} {kind} {duration_s}"))


def main() -> None:
    quick = begin("Steps: a model with 100 changing registers")
    duration_s, rounds = (0.1, 1) if quick else (0.5, 9)
    with ExitStack() as stack:
        running = stack.enter_context(started([], more=MODEL, clock="stepped"))
        client = stack.enter_context(Child("stepping.py"))
        target = str(running.grpc)
        contenders = {name: remote(client, target, kind, duration_s) for name, kind in CONTENDERS.items()}
        alone = stack.enter_context(started([], more=MODEL, clock="stepped", endpoint=False))
        for kinds, messages in _ready(target).items():
            server = stack.enter_context(Child("bare_steps.py", messages.to_json()))
            chain = stack.enter_context(Child("bare_steps.py", messages.to_json(), alone.segment.instance))
            contenders |= {
                title.format(name): remote(client, process.hello, kind, duration_s)
                for title, process in ((BARE, server), (CHAIN, chain))
                for name, kind in CONTENDERS.items()
                if kind in kinds
            }
        contenders[LOCAL] = local(running.segment.instance, duration_s)
        samples = interleave(contenders, rounds)
    report("a model with 100 registers", "steps/s", samples, OURS, "more")
    for name in (NATIVE, LOCAL):
        keep(f"a model with 100 registers: {name}", statistics.median(samples[name]), "steps/s", "more")
    rows = [
        [name, *(f"{median_ratio(samples[one], samples[bare]):.2f}" for one in (name, CHAIN.format(name)))]
        for name in CONTENDERS
        if (bare := BARE.format(name)) in samples
    ]
    for name, ratio, _ in rows:
        keep(f"{name}: rate relative to a bare server", float(ratio), "ratio", "more")
    table(["beside a bare server with the same client", "of its rate", "the chain"], rows)


def _ready(target: str) -> dict[tuple[str, ...], ready.Ready]:
    """Collect the messages of bare servers, by the kinds of clients that receive the same."""
    return {
        ("v2",): ready.version_2(target, PATHS),
        ("v2-array",): ready.version_2(target, ["sim/row"]),
        ("native", "native-stream"): ready.native(target, "sim/values/*"),
    }


if __name__ == "__main__":
    main()
