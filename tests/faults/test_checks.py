"""The checkers accept a correct history, and detect each kind of error."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from shmio.segment import Frame, Provenance, Quality
from tests.faults import report
from tests.faults.checks import (
    Complain,
    Counts,
    FrameCheck,
    Process,
    Source,
    ValueCheck,
    check_bystanders,
    check_restarts,
)
from tests.faults.configuration import CHAINED, DECLARED
from tests.faults.plc import CHAINED_AT, DECLARED_AT, OTHERS, SHOWN_AT, WORD
from tests.faults.resources import Resources
from tests.faults.suite import Record
from tests.faults.truth import ENTRIES, Truth, generations, image, places

MS = 1_000_000
SIZE = 72
PERIOD_NS, STALE_NS, TOLERANCE_NS = 20 * MS, 500 * MS, 50 * MS
STARTED_NS = 1_000 * MS
FIRST = 50
"""Number of a generation. Generation g begins at g times 10 ms; the last one is 2 * FIRST - 1."""


@pytest.fixture
def truth(tmp_path: Path) -> Iterator[Truth]:
    truth = Truth(tmp_path / "truth", create=True)
    for generation in range(1, 2 * FIRST):
        truth.record(generation, STARTED_NS + generation * 10 * MS)
    yield truth
    truth.close()


@pytest.fixture
def found() -> list[str]:
    return []


@pytest.fixture
def source(truth: Truth) -> Source:
    return Source("cell", SIZE, PERIOD_NS, STALE_NS, TOLERANCE_NS, True, truth)


@pytest.fixture
def check(source: Source, found: list[str]) -> FrameCheck:
    check = FrameCheck(source, found.append)
    check.begin(STARTED_NS)
    return check


def block(generation: int) -> bytes:
    """Return the image of a generation. The PLC's program does not write the last words."""
    others = b"\xff" * SHOWN_AT + bytes(WORD) + b"\xff" * WORD + bytes(2 * WORD)
    return image(generation, places(SIZE - OTHERS)) + others


def frame(number: int, generation: int = FIRST, **changes: Any) -> Frame:
    """Return frame ``number``, read in time, with an image that is a few ms old."""
    publish_ns = STARTED_NS + FIRST * 10 * MS + number * PERIOD_NS + 5 * MS
    made = Frame(
        number=number,
        cycle=FIRST // 2 + number,
        publish_ns=publish_ns,
        clock_ns=publish_ns - STARTED_NS,
        source_ns=1,
        incarnation=1,
        quality=Quality.GOOD,
        provenance=Provenance.LIVE,
        event=0,
        delay_us=0,
        reason="",
        raw=block(generation),
        effective=None,
    )
    return made._replace(**changes)


def good(number: int, **changes: Any) -> Frame:
    return frame(number, FIRST + 2 * number, **changes)


def feed(check: FrameCheck, *frames: tuple[Frame, int]) -> None:
    for one, missed in frames:
        check.frame(one, missed, one.publish_ns + MS)


def test_a_late_frame_passes_only_with_the_age_of_its_image(check: FrameCheck, found: list[str]) -> None:
    late = good(1)
    late = late._replace(publish_ns=late.publish_ns + 5000 * MS, clock_ns=late.clock_ns + 5000 * MS)
    feed(check, (late._replace(delay_us=5_000_000), 0))
    assert found == []
    check.begin(STARTED_NS)
    feed(check, (late, 0))
    assert "after its cycle was due, its image 0.0 ms old" in found[0]


def test_a_good_history_passes(check: FrameCheck, found: list[str]) -> None:
    lost = good(5, quality=Quality.BAD, reason="no answer")
    feed(check, (good(1), 0), (good(2), 0), (good(5), 2), (lost._replace(number=6, raw=good(5).raw), 0))
    again = good(9, incarnation=2)
    feed(check, (again, 2))
    assert found == []
    assert (check.counts.frames, check.counts.missed, check.counts.good) == (5, 4, 4)
    assert check.counts.since_ns == STARTED_NS + (FIRST + 18) * 10 * MS


BAD: dict[str, tuple[list[tuple[Frame, int]], str]] = {
    "a lost frame": ([(good(1), 0), (good(3), 0)], "comes after frame 1 with 0 missed"),
    "a frame twice": ([(good(1), 0), (good(1), 0)], "comes after frame 1"),
    "a wrong count": ([(good(1), 0), (good(3), 2)], "with 2 missed"),
    "an old incarnation": ([(good(1, incarnation=2), 0), (good(2), 0)], "incarnation 2 came before"),
    "a cycle twice": ([(good(1), 0), (good(2, cycle=good(1).cycle), 0)], "cycle 26 came before"),
    "a cycle too early": ([(good(1, cycle=50), 0)], "after its cycle was due"),
    "a cycle too late": ([(good(200, cycle=1), 0)], "after its cycle was due"),
    "another clock": ([(good(1, clock_ns=5), 0)], "the clock says 5"),
    "time going back": ([(good(2), 0), (good(3, publish_ns=good(1).publish_ns), 0)], "published before frame 2"),
    "good with a reason": ([(good(1, reason="?"), 0)], "good frames have no reason"),
    "bad without one": ([(good(1, quality=Quality.BAD), 0)], "others have one"),
    "a torn image": ([(good(1, raw=block(FIRST)[:16] + block(FIRST + 1)[16:]), 0)], "mixes generations"),
    "half a word": ([(good(1, raw=block(FIRST + 1)[:20] + bytes(SIZE - 20)), 0)], "never had"),
    "foreign bytes": ([(good(1, raw=bytes(range(SIZE))), 0)], "never had"),
    "what never was": ([(frame(1, 3 * FIRST), 0)], "never had"),
    "a short image": ([(good(1, raw=b"1234"), 0)], "has 4 bytes"),
    "a value of before": ([(good(2), 0), (good(3, raw=block(FIRST)), 0)], "word 0 went back from 54 to 50"),
    "bad with other bytes": (
        [(good(1), 0), (good(2, quality=Quality.BAD, reason="no answer"), 0)],
        "not those of the frame before",
    ),
    "a value of later": ([(frame(1, FIRST + 20), 0)], "which the PLC got later"),
    "an old value": ([(frame(40, FIRST), 0)], "the PLC has not had generation 50 for"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_history_is_found(name: str, check: FrameCheck, found: list[str]) -> None:
    frames, problem = BAD[name]
    feed(check, *frames)
    assert any(problem in line for line in found), found


def test_a_frame_that_stays_turns_bad_in_time(check: FrameCheck, found: list[str]) -> None:
    one = good(1)
    feed(check, (one, 0))
    for late_ns in range(0, STALE_NS * 2, 10 * MS):
        check.age(one, one.publish_ns + late_ns)
    assert found == []


def injected(number: int, shown: int, declared: int = DECLARED, chained: int = CHAINED, **changes: Any) -> Frame:
    """Return a good frame with these values in the words under injections."""
    one = good(number, **changes)
    effective = bytearray(one.raw)
    for place, word in ((SHOWN_AT, shown), (DECLARED_AT, declared), (CHAINED_AT, chained)):
        at = SIZE - OTHERS + place
        effective[at : at + WORD] = word.to_bytes(WORD, "big")
    return one._replace(effective=bytes(effective))


def test_what_is_injected_was_given_and_leaves_the_rest_alone(source: Source, tmp_path: Path, found: list[str]) -> None:
    given = Truth(tmp_path / "given", create=True)
    given.land(6, good(1).publish_ns)
    given.land(7, good(2).publish_ns)
    check = FrameCheck(replace(source, given=given), found.append)
    check.begin(STARTED_NS)
    feed(check, (injected(1, 0), 0), (injected(2, 6), 0), (injected(3, 7), 0), (injected(4, 0), 0), (injected(5, 0), 0))
    assert found == []
    other = injected(10, 7)
    effective = other.image[:8] + b"?" + other.image[9:]
    raw = good(11, raw=injected(11, 6).image, effective=None)
    feed(check, (injected(6, 6), 0), (injected(7, 8), 0), (injected(8, 6, publish_ns=good(1).publish_ns - 1), 0))
    feed(check, (injected(9, 7), 0), (other._replace(effective=effective), 0), (raw, 0))
    expected = ("shows 6, injected before 7", "shows 8, which nobody", "has changed others", "has 6, which was")
    assert [any(part in line for line in found) for part in expected] == [True] * 4
    given.close()


def test_what_is_declared_stands_in_every_frame_over_what_clients_give(
    source: Source, tmp_path: Path, found: list[str]
) -> None:
    chained = Truth(tmp_path / "chained", create=True)
    for value in (8, 9, 12):
        chained.land(value, good(1).publish_ns)
    chained.land(13, good(5).publish_ns)
    check = FrameCheck(replace(source, given=chained, chained=chained), found.append)
    check.begin(STARTED_NS)
    never_one = frame(0, raw=bytes(SIZE), quality=Quality.BAD, reason="no answer", cycle=25)
    feed(check, (never_one, 0))
    values = enumerate((0, 8, 9, 8, 12), 1)
    feed(check, *((injected(number, 0, chained=CHAINED + value), 0) for number, value in values))
    assert found == []
    feed(check, (injected(6, 0, chained=CHAINED + 9), 0), (injected(7, 0, chained=CHAINED + 10), 0))
    feed(check, (injected(8, 0, chained=CHAINED + 16), 0), (injected(9, 0, chained=12), 0))
    feed(check, (injected(10, 0, chained=CHAINED + 13, publish_ns=good(5).publish_ns - 1), 0), (injected(11, 0, 22), 0))
    expected = (
        "shows 9 of a chain, given before 12",
        *(f"shows {value} of a chain, which nobody had given" for value in (10, 16, 12 - CHAINED, 13)),
        f"shows 22, where declared injections make {DECLARED}",
    )
    assert [any(part in line for line in found) for part in expected] == [True] * len(expected), found
    chained.close()


def test_who_does_not_need_the_broker_goes_on(found: list[str]) -> None:
    def goes_on(**ages_ms: int) -> bool:
        counts = {name.replace("_", " "): Counts(since_ns=5000 * MS - ms * MS) for name, ms in ages_ms.items()}
        return check_bystanders(counts, 5000 * MS, 2000 * MS, found.append)

    assert goes_on(mqtt_cell=4000, slow_cell=4000, stream_cell=1999, newest_cell=100, grpc_cell_0=5000)
    assert found == []
    assert not goes_on(stream_cell=100, grpc_cell_0=2001)
    assert found == ["grpc cell 0 has had nothing new for 2.0 s, and only the broker was broken"]


def test_good_beyond_its_age_is_found(check: FrameCheck, found: list[str]) -> None:
    """The frame is recent, but the value in it is too old, because the PLC's answer was delayed."""
    one = frame(10, FIRST)
    feed(check, (one, 0))
    assert found == []
    check.age(one, one.publish_ns + STALE_NS - MS)
    assert "is good at" in found[0]


def test_a_dead_plc_has_no_value(check: FrameCheck, truth: Truth, found: list[str]) -> None:
    newest = 2 * FIRST - 1
    one = frame(30, newest)
    truth.bury(one.publish_ns)
    feed(check, (one, 0))
    assert found == []
    truth.bury(one.publish_ns - STALE_NS - 2 * TOLERANCE_NS)
    check.age(one, one.publish_ns + MS)
    assert "is good at" in found[0]


def test_several_pdus_may_be_of_several_cycles(source: Source, truth: Truth, found: list[str]) -> None:
    several = Source("cell", SIZE, PERIOD_NS, STALE_NS, TOLERANCE_NS, False, truth)
    check = FrameCheck(several, found.append)
    check.begin(STARTED_NS)
    feed(check, (good(1, raw=block(FIRST)[:16] + block(FIRST + 1)[16:]), 0))
    assert found == []
    feed(check, (good(2, raw=block(FIRST)), 0))
    assert "word 2 went back from 51 to 50" in found[0]


def test_without_truth_foreign_bytes_are_found(found: list[str]) -> None:
    check = FrameCheck(Source("demo", SIZE, PERIOD_NS, STALE_NS, TOLERANCE_NS, False), found.append)
    check.begin(STARTED_NS)
    feed(check, *((good(number, raw=image(generation, places(SIZE))), 0) for number, generation in ((1, 9), (2, 3))))
    assert found == []
    feed(check, (good(3, raw=bytes(range(SIZE))), 0))
    assert "bytes that the PLC never had" in found[0]


def test_values_are_held_to_the_truth(source: Source, found: list[str]) -> None:
    now_ns = STARTED_NS + (FIRST + 10) * 10 * MS
    check = ValueCheck(source, found.append)
    check.value(FIRST, now_ns)
    check.value(FIRST, now_ns)
    check.value(FIRST + 9, now_ns)
    assert found == []
    check.value(FIRST + 8, now_ns)
    check.value(12345, now_ns)
    check.value(FIRST + 10, now_ns + 1000 * MS)
    check.value(FIRST + 11, now_ns + 1000 * MS, slack_ns=1000 * MS)
    assert ["comes after" in found[0], "the PLC never had" in found[1], "is good, but" in found[2]] == [True] * 3
    assert len(found) == 3


def test_restarts_are_of_those_who_were_hit(found: list[str]) -> None:
    def after(complain: Complain, hit: set[str], *new: str, replaced: bool = False, **changes: Process | None) -> None:
        before = {name: Process(pid, 0) for name, pid in (("plc", 1), ("cell", 2), ("grpc", 3))}
        now = {name: changes.get(name, process) for name, process in before.items()}
        kept = {name: process for name, process in now.items() if process is not None}
        check_restarts(before, kept, hit, set(new), replaced=replaced, complain=complain)

    after(found.append, set())
    after(found.append, {"cell"}, cell=Process(9, 1))
    after(found.append, set(), "cell", cell=Process(9, 0))
    new = {"plc": Process(7, 0), "cell": Process(8, 0), "grpc": Process(9, 0)}
    after(found.append, set(), replaced=True, **new)
    after(found.append, set(), "cell")  # a reload need not replace the process
    assert found == []
    after(found.append, {"cell"}, cell=Process(9, 1), grpc=Process(8, 1))
    after(found.append, {"cell"})
    after(found.append, {"cell"}, cell=Process(9, 0))
    after(found.append, set(), cell=Process(2, 1))
    after(found.append, set(), cell=Process(None, 0))
    after(found.append, set(), cell=None)
    after(found.append, set(), replaced=True, **{**new, "grpc": Process(3, 0)})
    for line, part in zip(
        found,
        (
            "grpc was not hit",
            "cell was to be replaced",
            "cell was restarted, but counts 0",  # in addition to the old pid
            "cell was restarted, but counts 0",
            "cell was not hit",
            "cell is not there",
            "processes were",
            "grpc was to be replaced",
        ),
        strict=True,
    ):
        assert part in line


def test_growth_is_found(found: list[str]) -> None:
    resources = Resources(found.append)
    resources.note("grpc", 1, 20.0, 30)
    resources.note("grpc", 1, 90.0, 30)
    resources.note("grpc", 2, 150.0, 30)
    assert found == []
    resources.note("grpc", 1, 130.0, 30)
    resources.note("grpc", 1, 20.0, 900)
    assert ["grew from 20 to 130 MB" in found[0], "900 descriptors" in found[1]] == [True, True]


def test_the_truth_forgets_in_order(truth: Truth) -> None:
    assert truth.since_ns(0) is None
    assert truth.since_ns(FIRST) == STARTED_NS + FIRST * 10 * MS
    truth.record(FIRST + ENTRIES, 7)
    assert truth.since_ns(FIRST) is None
    assert list(generations(block(FIRST)[:-OTHERS], places(SIZE - OTHERS))) == [FIRST] * ((SIZE - OTHERS) // 8)


def test_a_violation_is_in_the_report() -> None:
    record = Record(7)
    assert "**No violation.** The run with seed 7 began on" in report.write(record)
    record.violated, record.violations = 1, ["cell: frame 3 is torn"]
    text = report.write(record)
    assert "**1 violations**" in text
    assert "cell: frame 3 is torn" in text
