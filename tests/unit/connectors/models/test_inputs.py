from __future__ import annotations

from shmio.connectors.models.stepped import Inputs
from shmio.layout.topic import parse_topic
from shmio.model.statuses import BAD_NODE_ID_UNKNOWN
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
