"""A PLC program as a class, and as a model without a controller."""

from __future__ import annotations

from typing import Any

import pytest

from shmio.errors import ModelError
from shmio.layout.topic import find
from shmio.layout.values.codec import codec
from shmio.plc import TON, Input, Output, Program
from shmio.simulation import ModelRunner


class Door(Program):
    closed = Input("BOOL")
    locked = Output("BOOL")
    scans = Output("INT")
    settled = TON(0.05)

    def scan(self, time_s: float, dt_s: float) -> None:
        self.locked = self.settled(self.closed)
        self.scans += 1


def test_a_program_runs_as_a_model_one_scan_a_step() -> None:
    runner = ModelRunner(Door)
    runner.connect({"closed": True})
    locked = codec(find(runner.layout, "locked"), runner.layout.byte_order)
    seen = [locked.decode(runner.step(step * 10_000_000, 10_000_000)) for step in range(8)]
    assert seen == [False] * 5 + [True] * 3


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ({"period_ms": 0}, "period_ms: 0"),
        ({"period_ms": "10"}, "period_ms: '10'"),
        ({"step": lambda self, time_s, dt_s: None}, r"step\(\).*scan\(\)"),
        ({"start": TON(1.0)}, "start.*reserved"),
    ],
)
def test_wrong_programs_are_refused_when_the_class_is_made(body: dict[str, Any], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        type("Wrong", (Program,), {"scan": lambda self, time_s, dt_s: None, **body})
