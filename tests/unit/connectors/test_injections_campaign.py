"""Declared injections in virtual time: a campaign is reproducible, whichever process is faster."""

from __future__ import annotations

import random
import threading
from collections.abc import Callable
from contextlib import ExitStack

import msgspec
import pytest

from shmio.config import Declaration
from shmio.local.time_control import Coordinator
from shmio.local.writer import SourceWriter
from shmio.segment import Attributes, BlockSpec, ProcessSpec, Segment
from shmio.segment.injection_list import declared_document
from tests.unit.connectors.models.test_stepped import GUEST, LAYOUT, MS, PERIOD_NS, Adder, Running

CAMPAIGN = {
    "noise": {"target": "two/sum", "operation": "noise", "amplitude": 1000, "seed": 5, "start_s": 0.1, "end_s": 0.3},
    "blind": {"target": "two/other", "operation": "set", "value": 99, "when": "one/sum >= 4 and two/sum < 100"},
    "late": {"target": "two/given/in", "operation": "delay", "delay_ms": 100},
}
Shown = tuple[int, bytes, bytes | None]


def played(instance: str, trouble: Callable[[int], None]) -> list[Shown]:
    """Run two models for ten steps of 50 ms. Return the frames of the model to which the campaign applies."""
    declared = [msgspec.convert({"name": name, **keys}, Declaration) for name, keys in CAMPAIGN.items()]
    attributes = Attributes("simulation", ("given",), stepped=True)
    blocks = [
        BlockSpec(
            name, LAYOUT, PERIOD_NS, 500 * MS, 1 << 20, attributes, declared_document(declared if name == "two" else [])
        )
        for name in ("one", "two")
    ]
    with ExitStack() as stack:
        processes = [ProcessSpec(name, "source") for name in ("one", "two")]
        segment = stack.enter_context(Segment.create(instance, blocks, processes, stepped=True))
        stack.callback(segment.unlink)
        models = [stack.enter_context(Running(segment, name, Adder(trouble))) for name in ("one", "two")]
        coordinator = Coordinator(segment)
        stack.callback(coordinator.close)
        coordinator.take_over()
        writer = SourceWriter(segment.blocks["two"], GUEST)
        for step in range(10):
            if step == 4:
                writer.submit({"given": 7})
                judged = writer.shadow(1, {"given": 0})  # refused, after the write before it is judged
                assert "no injection" in judged[0].text
            coordinator.step(50 * MS)
        return [(frame.cycle, frame.raw, frame.effective) for frame in models[1].frames() if frame.cycle]


def test_campaign_continues_after_time_is_released(instance: str) -> None:
    start_s = 3600.2
    declared = Declaration("late", "one/sum", "set", value=7, start_s=start_s)
    attributes = Attributes("simulation", ("given",), stepped=True)
    block = BlockSpec("one", LAYOUT, PERIOD_NS, 500 * MS, 1 << 20, attributes, declared_document([declared]))
    with Segment.create(instance, [block], [ProcessSpec("one", "source")]) as segment:
        with Running(segment, "one", Adder()) as model:
            coordinator = Coordinator(segment)
            coordinator.step(3_600_000 * MS)
            coordinator.release()
            before = frame = model.next()
            while frame.effective is None:
                before, frame = frame, model.next()
        assert before.cycle <= frame.cycle
        assert frame.clock_ns >= start_s * 1e9, "start_s is by the instance's clock"
        segment.unlink()


@pytest.mark.parametrize("seed", [1, 2])
def test_two_runs_give_the_same_frames(instance: str, seed: int) -> None:
    turns = random.Random(seed)
    never = threading.Event()

    def dawdle(_: int) -> None:
        never.wait(turns.random() / 100)

    plain = played(instance, lambda _: None)
    again = played(instance, dawdle)
    assert plain == again
    shown = {cycle: (raw, effective) for cycle, raw, effective in plain}
    assert list(shown) == list(range(1, 11))
    noisy = [cycle for cycle, (raw, effective) in shown.items() if effective and effective[:4] != raw[:4]]
    assert noisy == [2, 3, 4, 5], "from 0.1 s to before 0.3 s of simulation time"
    blind = [cycle for cycle, (_, effective) in shown.items() if effective and effective[8:] == b"\0\0\0\x63"]
    assert blind == [5, 6, 7, 8, 9, 10], "the condition reads the other model's previous step"
    given = [cycle for cycle, (raw, _) in shown.items() if raw[4:8] == b"\0\0\0\x07"]
    assert given[0] == 6, "written after step 4 (0.2 s), sent on 0.1 s later"
