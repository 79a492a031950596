"""What observations mean: numbers of elements, times and qualities."""

from __future__ import annotations

import pytest

from shmio.connectors.register_image import RegisterImage
from shmio.layout.tags import place_tags
from shmio.model.statuses import BAD_OUT_OF_RANGE, GOOD, UNCERTAIN, UNREADABLE_TIME, StatusArea
from shmio_mtconnect.documents import DataItem, Observation
from shmio_mtconnect.values import Target, parse


def statuses(representation: str, *observations: Observation, type_: str = "ARRAY[0..2] OF LREAL") -> list[int]:
    """Return the status of a register after each observation."""
    layout = place_tags("cnc", {"pos": {"type": type_, "address": "pos"}}).with_statuses()
    register, image, area = layout.registers[0], RegisterImage(layout), StatusArea(layout)
    item = DataItem("pos", "SAMPLE", (), (), representation, "POSITION", "")
    target = Target(0, register, parse(register), item)
    codes = []
    for one in observations:
        target.put(image, one, whole=False)
        codes.append(area.get(bytes(image), 0).code)
    return codes


def position(sequence: int, text: str, *, at_ns: int = 5, quality: str = "VALID") -> Observation:
    """Return an observation of a position."""
    return Observation("pos", sequence, at_ns, "Position", text, "", quality)


def test_an_array_of_another_length_is_bad_except_for_a_time_series() -> None:
    """A time series has more values than the register, of which the newest count."""
    texts = [position(1, "1 2 3"), position(2, "1 2 3 4"), position(3, "1 2")]
    assert statuses("VALUE", *texts) == [GOOD, BAD_OUT_OF_RANGE, BAD_OUT_OF_RANGE]
    assert statuses("TIME_SERIES", *texts) == [GOOD, GOOD, BAD_OUT_OF_RANGE]


def test_doubtful_values_are_uncertain(caplog: pytest.LogCaptureFixture) -> None:
    """The register keeps the value, and the log says once why it is uncertain."""
    found = statuses(
        "VALUE", position(1, "1"), position(2, "2", at_ns=0), position(3, "3", at_ns=0), position(4, "4"),
        position(5, "5", quality="UNVERIFIABLE"), position(6, "6", quality="INVALID"), type_="LREAL",
    )  # fmt: skip
    assert found == [GOOD, UNREADABLE_TIME, UNREADABLE_TIME, GOOD, UNCERTAIN, UNCERTAIN]
    assert [record.getMessage() for record in caplog.records] == [
        "pos: its timestamp cannot be read, so its value is uncertain",
        "pos: the agent reports the quality UNVERIFIABLE, so its value is uncertain",
    ]
