"""Steps a second of a source with a remote model, by gRPC, compared with the same model inside the instance.

The model has 100 registers, which all change with each step. The program that steps and the model are separate
processes.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from common import Child, begin, report
from counting import COUNT
from instance import Instance, started
from step import MODEL, local, remote

from shmio import attach
from shmio.segment import Quality, State

REMOTE = """
[[source]]
name = "sim"
connector = "remote"
layout = "{layout}"
outputs = ["**"]
"""
OURS = "a model elsewhere, a program on the host steps"


@contextmanager
def elsewhere() -> Iterator[Instance]:
    """Start an instance whose model runs in another process, and wait until the model has joined."""
    with ExitStack() as stack:
        layout = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "counting.toml"
        rows = [f'"values/r{index:02}" = "LREAL"\n' for index in range(COUNT)]
        layout.write_text(f'[registers]\n{"".join(rows)}row = "ARRAY[1..{COUNT}] OF LREAL"\n')
        running = stack.enter_context(
            started([], more=REMOTE.format(layout=layout), clock="stepped", until=State.DEGRADED)
        )
        stack.enter_context(Child("serving.py", running.grpc, "sim"))
        with attach(running.segment.instance) as reader:
            while reader.read("sim/row").quality is not Quality.GOOD:
                reader.wait("sim", timeout_s=1.0)
        yield running


@contextmanager
def here() -> Iterator[Instance]:
    """Start an instance that runs the model itself."""
    with started([], more=MODEL, clock="stepped") as running:
        yield running


def main() -> None:
    quick = begin("Steps of a model elsewhere, with 100 changing registers")
    duration_s, rounds = (0.5, 1) if quick else (3.0, 5)
    samples: dict[str, list[float]] = {}
    for _ in range(rounds):
        for where, instance in (("a model elsewhere", elsewhere), ("the same in the instance", here)):
            with instance() as running, Child("stepping.py") as client:
                for who, sample in (
                    ("a program on the host steps", local(running.segment.instance, duration_s)),
                    (
                        "a client of shmio.v1 steps, and has all values",
                        remote(client, str(running.grpc), "native", duration_s),
                    ),
                ):
                    samples.setdefault(f"{where}, {who}", []).append(sample())
    report("a model with 100 registers", "steps/s", samples, OURS, "more")


if __name__ == "__main__":
    main()
