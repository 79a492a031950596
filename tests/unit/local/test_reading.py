"""What a local program sees of a source that gives each register a status."""

from __future__ import annotations

import pytest

import shmio
from shmio.connectors.register_image import RegisterImage
from shmio.errors import QualityError
from shmio.model.statuses import (
    BAD_NODE_ID_UNKNOWN,
    BAD_WAITING_FOR_INITIAL_DATA,
    UNCERTAIN_LAST_USABLE_VALUE,
    RegisterStatus,
)
from shmio.model.values import Quality
from tests.unit.statuses import COUNT, LAYOUT, ROW, SOURCE_NS, SPEED, first_image, plant

UNKNOWN = "the device reports BadNodeIdUnknown (0x80340000)"


def test_one_bad_register_leaves_the_others_good(instance: str) -> None:
    image = first_image()
    image.fail(SPEED, BAD_NODE_ID_UNKNOWN, SOURCE_NS + 9)
    image.put(ROW, [5, 6, 7, 8], SOURCE_NS, UNCERTAIN_LAST_USABLE_VALUE)
    with plant(instance) as (_, writer), shmio.attach(instance) as cell:
        writer.publish(bytes(image), cycle=1)
        speed = cell.read("speed")
        assert (speed.value, speed.quality, speed.reason) == (1.5, Quality.BAD, UNKNOWN)
        assert speed.source_time == (SOURCE_NS + 9) / 1e9
        with pytest.raises(QualityError, match="BadNodeIdUnknown"):
            cell["speed"]
        assert (cell["count"], cell.read("count").quality) == (1, Quality.GOOD)
        assert cell.read("row/2").quality is Quality.UNCERTAIN
        assert cell.frame().status("speed") == RegisterStatus(BAD_NODE_ID_UNKNOWN, SOURCE_NS + 9)
        assert cell.frame().quality is Quality.GOOD


def test_a_register_without_a_value_yet_says_so_instead_of_showing_one(instance: str) -> None:
    image = RegisterImage(LAYOUT)
    with plant(instance) as (_, writer), shmio.attach(instance) as cell:
        writer.publish(bytes(image), cycle=1)
        speed = cell.read("speed")
        assert (speed.value, speed.quality, speed.source_time) == (None, Quality.BAD, None)
        assert speed.reason.startswith("no data yet")
        image.put(SPEED, 1.5, SOURCE_NS)
        image.fail(SPEED, BAD_WAITING_FOR_INITIAL_DATA, SOURCE_NS)  # it had a value
        writer.publish(bytes(image), cycle=2)
        assert cell.read("speed").value == 1.5


def test_a_bad_source_makes_all_its_registers_bad(instance: str) -> None:
    with plant(instance) as (_, writer), shmio.attach(instance) as cell:
        writer.publish(bytes(first_image()), cycle=1, quality=Quality.BAD, reason="unplugged")
        assert (cell.read("count").quality, cell.read("count").reason) == (Quality.BAD, "unplugged")


def test_a_register_without_a_time_has_the_time_of_the_frame(instance: str) -> None:
    image = first_image()
    image.put(COUNT, 3)
    with plant(instance) as (_, writer), shmio.attach(instance) as cell:
        writer.publish(bytes(image), cycle=1, source_ns=SOURCE_NS + 10**9)
        assert cell.read("count").source_time == SOURCE_NS / 1e9 + 1


def test_a_change_of_a_status_is_an_update_and_one_of_a_time_is_not(instance: str) -> None:
    image = first_image()
    with plant(instance) as (_, writer), shmio.attach(instance) as cell:
        writer.publish(bytes(image), cycle=1)
        with cell.subscribe("plant") as updates:
            assert len(next(updates).readings) == 4
            image.put(COUNT, 1, SOURCE_NS + 50)
            writer.publish(bytes(image), cycle=2)
            image.fail(SPEED, BAD_NODE_ID_UNKNOWN)
            writer.publish(bytes(image), cycle=3)
            (reading,) = next(updates).readings
            assert (reading.path, reading.quality) == ("plant/speed", Quality.BAD)
            image.put(SPEED, 1.5)
            writer.publish(bytes(image), cycle=4)
            (reading,) = next(updates).readings
            assert (reading.path, reading.quality, reading.value) == ("plant/speed", Quality.GOOD, 1.5)
