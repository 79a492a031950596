"""The channel between a block and its remote model. Two mappings of one segment play both processes."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
from collections.abc import Iterator

import pytest

from shmio.errors import ConfigError, FormatError
from shmio.layout.model import Layout, Register
from shmio.segment import Attributes, BlockSpec, ProcessSpec, Segment
from shmio.segment.header import SectionKind, read_sections, table_state
from shmio.segment.model_channel import ConnectedModel, ModelChannel, ModelRequest, model_ports

LAYOUT = Layout(
    "DRIVE",
    None,
    12,
    False,
    (
        Register("target", "REAL", (), 0, None, 4, 1),
        Register("axis/position", "REAL", (), 4, None, 4, 1),
        Register("axis/moving", "BOOL", (), 8, 0, 1, 1),
        Register("axis/ready", "BOOL", (), 8, 1, 1, 1),
        Register("lamps", "BOOL", ((0, 7),), 10, 0, 1, 8),
    ),
)
HOLD = """
import sys, time
from shmio.segment import Segment
with Segment.open(sys.argv[1], writable=True) as segment:
    assert segment.blocks["drive"].model_channel.join("held")
    print("joined", flush=True)
    time.sleep(3600)
"""


@pytest.fixture
def segment(instance: str) -> Iterator[Segment]:
    attributes = Attributes("remote", stepped=True, outputs=("axis",), inouts=("lamps",))
    blocks = [BlockSpec("drive", LAYOUT, 20_000_000, 500_000_000, 1 << 20, attributes)]
    blocks.append(BlockSpec("panel", LAYOUT, 20_000_000, 500_000_000, 1 << 20))
    with Segment.create(instance, blocks, [ProcessSpec("drive", "source")]) as segment:
        yield segment
        segment.unlink()


def link_of(segment: Segment) -> ModelChannel:
    link = segment.blocks["drive"].model_channel
    assert link is not None
    return link


def ask(step: int, doubt: str = "") -> ModelRequest:
    return ModelRequest(0, step, step * 1000, 1000, 77, doubt, struct.pack(">f8x", step), bytes(12))


def test_only_a_block_with_outputs_has_a_channel(segment: Segment) -> None:
    assert segment.blocks["panel"].model_channel is None
    assert link_of(segment).frame_size == LAYOUT.size
    assert link_of(segment).model() is None


def test_a_model_connects_while_every_process_slot_is_taken(segment: Segment) -> None:
    slots = [slot.index for slot in (*segment.processes, *segment.processes.external)]
    assert slots[-1] == segment.header.process_capacity - 1
    with (
        Segment.open(segment.instance, writable=True) as others,
        Segment.open(segment.instance, writable=True) as other,
    ):
        assert all(slot.take() for slot in (*others.processes, *others.processes.external))
        assert link_of(other).join("belt")


def test_requests_are_matched_with_their_answers(segment: Segment) -> None:
    with Segment.open(segment.instance, writable=True) as other:
        source, model = link_of(segment), link_of(other)
        source.asked.begin()
        assert model.newest() is None
        assert model.join("belt")
        assert source.model() == ConnectedModel(1, os.getpid(), "belt")
        number = source.ask(ask(5, "input target keeps its value"), 123)
        assert source.answer_to(number) is None
        found = model.newest()
        assert found == ask(5, "input target keeps its value")._replace(number=number)
        assert found is not None
        model.answer(found, 456, b"\1" * 12)
        answer = source.answer_to(number)
        assert answer is not None
        assert (answer.image, answer.failure) == (b"\1" * 12, None)
        again = source.ask(ask(5), 123)
        assert source.answer_to(again) is None, "the same step, but another request"
        model.answer(found, 456, b"\2" * 12)
        assert source.answer_to(again) is None, "a late answer"
        model.answer(found._replace(number=again), 456, b"\3" * 12, "ä" * 200)
        answer = source.answer_to(again)
        assert answer is not None
        assert answer.failure == "ä" * 128


def test_one_model_at_a_time_can_join_and_each_has_its_number(segment: Segment) -> None:
    with (
        Segment.open(segment.instance, writable=True) as first,
        Segment.open(segment.instance, writable=True) as second,
    ):
        source = link_of(segment)
        assert link_of(first).join("one")
        assert not link_of(second).join("two")
        assert source.model() == ConnectedModel(1, os.getpid(), "one")
        seen = source.answered.doorbell()
        link_of(first).leave()
        assert source.answered.doorbell() != seen, "a waiting source is woken"
        assert source.model() is None
        assert link_of(second).join("ä" * 200)
        assert source.model() == ConnectedModel(2, os.getpid(), "ä" * 51)


def test_computed_is_true_after_the_first_answered_step_of_any_model(segment: Segment) -> None:
    source = link_of(segment)
    source.asked.begin()
    with Segment.open(segment.instance, writable=True) as other:
        model = link_of(other)
        assert model.join("belt")
        found = ask(5)._replace(number=source.ask(ask(5), 123))
        model.answer(found, 456, b"\1" * 12, "it has failed")
        assert not source.computed()
        model.answer(found, 456, b"\1" * 12)
        assert source.computed()
        assert source.model() == ConnectedModel(1, os.getpid(), "belt"), "the model is the same"
        model.leave()
        assert model.join("belt")
        assert source.computed()


def test_a_killed_model_has_left(segment: Segment) -> None:
    command = [sys.executable, "-c", HOLD, segment.instance]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as holder:
        try:
            assert holder.stdout is not None
            assert holder.stdout.readline() == b"joined\n"
            assert link_of(segment).model() == ConnectedModel(1, holder.pid, "held")
        finally:
            holder.kill()
            holder.wait()
        assert link_of(segment).model() is None


def test_patterns_choose_inputs_and_outputs() -> None:
    ends = model_ports(LAYOUT, ["axis"], ["lamps"])
    assert [register.path for register in ends.inputs] == ["target", "lamps"]
    assert [register.path for register in ends.outputs] == ["axis/position", "axis/moving", "axis/ready", "lamps"]
    assert model_ports(LAYOUT, ["**"], []).inputs == ()


@pytest.mark.parametrize(
    ("outputs", "inouts", "message"),
    [
        (["axis", "axes"], [], "outputs: 'axes' matches no register of DRIVE"),
        (["axis"], ["lamps/3"], "inouts: 'lamps/3' matches no register of DRIVE; only whole registers are allowed"),
        ([""], [], "outputs: "),
        (["axis"], ["axis/moving"], "inouts: axis/moving is in outputs, too"),
    ],
)
def test_patterns_that_match_nothing_are_refused(outputs: list[str], inouts: list[str], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        model_ports(LAYOUT, outputs, inouts)
    assert str(caught.value).startswith(message)


@pytest.mark.parametrize("size", [0, 1 << 40, 2**64 - 1])
def test_a_contradictory_channel_is_refused(segment: Segment, size: int) -> None:
    entries = read_sections(segment.memory, segment.header, table_state(segment.memory)[1], "")
    (entry,) = [entry for entry in entries if entry.kind == SectionKind.LINK]
    segment.memory[entry.offset : entry.offset + 8] = struct.pack("<Q", size)
    with pytest.raises(FormatError, match="block drive: the model channel's rings do not fit in its section"):
        Segment.open(segment.instance)
