from __future__ import annotations

import struct
from itertools import accumulate

import pytest

from shmio.connectors.models.stepped import Inputs
from shmio.layout.topic import parse_topic
from shmio.model.statuses import BAD_NODE_ID_UNKNOWN
from shmio.segment import Attributes, BlockSpec, ProcessSpec, Segment
from tests.unit.endpoints.stepped import LAYOUT
from tests.unit.statuses import SPEED, first_image, plant


def test_an_input_keeps_its_value_while_its_register_is_bad(instance: str) -> None:
    with plant(instance) as (segment, writer):
        inputs = Inputs(segment, {name: parse_topic(f"plant/{name}", ("plant",), None) for name in ("speed", "count")})
        image = first_image()
        writer.publish(bytes(image), cycle=1)
        assert inputs.read(None) == ({"speed": 1.5, "count": 1}, "")
        image.fail(SPEED, BAD_NODE_ID_UNKNOWN)
        writer.publish(bytes(image), cycle=2)
        values, missing = inputs.read(None)
        assert values == {"count": 1}
        assert missing == "input speed keeps its value: plant: the device reports BadNodeIdUnknown (0x80340000)"


@pytest.mark.parametrize("ahead", [False, True], ids=["reads first", "reads after the other source"])
@pytest.mark.parametrize(
    "frames", [[1] * 12, [1, 3, 0, 2, 1, 0, 0, 4, 1], [1, 20, 1, 30, 2], [12, 1, 1, 1]], ids="frames of steps {}".format
)
def test_the_last_frame_before_a_step_counts(instance: str, frames: list[int], *, ahead: bool) -> None:
    """However many frames the other source publishes in a step, and whichever source completes a step first."""
    block = BlockSpec("sim", LAYOUT, 20_000_000, 10**15, 1 << 20, Attributes(stepped=True))
    last = [0, *accumulate(frames)]  # number of the last frame of each step
    with Segment.create(instance, [block], [ProcessSpec("sim", "source")]) as segment, Segment.open(instance) as opened:
        writer = segment.writer("sim")
        inputs = Inputs(opened, {"count": parse_topic("sim/count", ("sim",), None)})
        assert inputs.read(1) == ({}, "input count keeps its value: sim: no data yet")

        def publish(step: int) -> None:
            for number in range(last[step - 1] + 1, last[step] + 1):
                writer.publish(struct.pack(">i", number).ljust(LAYOUT.size, b"\0"), cycle=step)

        for step in range(1, len(frames) + 1):
            if ahead:
                publish(step)
            if step > 1:
                assert inputs.read(step) == ({"count": last[step - 1]}, "")
                assert inputs.read(step) == ({"count": last[step - 1]}, ""), "reading again changes nothing"
            if not ahead:
                publish(step)
        assert inputs.read(None) == ({"count": last[-1]}, "")
        segment.unlink()
