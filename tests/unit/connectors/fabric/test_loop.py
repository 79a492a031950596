"""A mirror's loop: frames and events as the owner published them, gaps, late messages, and writes."""

from __future__ import annotations

import re
import time

import pytest

from shmio.connectors.fabric.order import Announced, Missing
from shmio.errors import CommandError
from shmio.fabric.messages import CommandReply, SourceState, encode_command
from shmio.local.writer import SourceWriter
from shmio.model.values import NO_WRITER
from shmio.recording.format.encoding import Gap, Reason
from shmio.segment import (
    Event,
    EventKind,
    Provenance,
    Quality,
)
from tests.unit.connectors.fabric.harness import LAYOUT, PATIENCE_S, STALE_NS, STREAM, Mirroring, S, frame, running


def test_frames_keep_what_the_owner_published(mirroring: Mirroring) -> None:
    doubtful = frame(8, 2, quality=Quality.UNCERTAIN, reason="2 of 4 nodes", effective=b"\0\x09\0\0")
    mirroring.send(frame(7, 1), doubtful)
    first, second = mirroring.next(), mirroring.next()
    assert (first.cycle, first.source_ns, first.raw) == (1007, 5 * S + 7, b"\0\1\0\0")
    assert (first.quality, first.provenance, first.effective) == (Quality.GOOD, Provenance.SIMULATED, None)
    assert (second.quality, second.reason, second.effective) == (Quality.UNCERTAIN, "2 of 4 nodes", b"\0\x09\0\0")
    assert first.delay_us >= 250


def test_readers_can_follow_what_comes_after_an_outage(mirroring: Mirroring) -> None:
    """The ring holds fewer frames than an outage brings; a reader that wakes up each 0.1 s misses none."""
    count = 3 * mirroring.block.ring.slot_count
    for first in range(7, 7 + count, 50):
        mirroring.send(*(frame(number, 1) for number in range(first, min(first + 50, 7 + count))), age_ns=30 * S)
    cycles = [mirroring.next().cycle]
    while cycles[-1] < 1006 + count:
        assert mirroring.cursor.behind < mirroring.block.ring.slot_count // 2
        cycles.append(mirroring.next().cycle)
    assert cycles == list(range(1007, 1007 + count))
    assert mirroring.cursor.missed == 0


def test_late_frames_are_stale_but_keep_their_quality(mirroring: Mirroring) -> None:
    mirroring.send(frame(7, 1), age_ns=30 * S)
    late = mirroring.next()
    assert late.quality is Quality.GOOD
    assert late.delay_us > 29_000_000
    assert mirroring.block.assess(late)[0] is Quality.BAD


def test_a_frame_that_waited_at_the_owner_is_as_old_as_it_is(mirroring: Mirroring) -> None:
    """The rule of a maximum rate may publish a frame long after its source."""
    held = frame(7, 1)._replace(publish_ns=2 * S)
    mirroring.send(held, made_ns=100 * S + 32 * S, zero_ns=100 * S)
    late = mirroring.next()
    assert late.delay_us > 29_000_000
    assert mirroring.block.assess(late)[0] is Quality.BAD


def test_messages_that_were_long_on_their_way_are_late(mirroring: Mirroring) -> None:
    """Both clocks may differ: what counts is how much longer a message took than others."""
    ahead_ns = 3600 * S
    for number in range(7, 10):
        mirroring.send(frame(number, 1), made_ns=time.time_ns() + ahead_ns)
        assert mirroring.next().delay_us < 1_000_000
    mirroring.send(frame(10, 2), made_ns=time.time_ns() + ahead_ns - 20 * S)
    late = mirroring.next()
    assert 19_000_000 < late.delay_us < 25_000_000
    assert mirroring.block.assess(late)[0] is Quality.BAD
    mirroring.send(frame(11, 3), made_ns=time.time_ns() + ahead_ns)
    assert mirroring.next().delay_us < 1_000_000


def test_false_times_in_the_owners_name_change_neither_ages_nor_deadlines(mirroring: Mirroring) -> None:
    later_ns = time.time_ns() + 3600 * S
    mirroring.send(frame(7, 1))
    mirroring.next()
    mirroring.event(EventKind.QUALITY)
    mirroring.link.answered(Announced(STREAM, 1, time.monotonic_ns()))
    mirroring.link.number = 0
    mirroring.send(frame(8, 66), made_ns=later_ns)  # its number was delivered
    mirroring.send(frame(8, 66), made_ns=1, stream=STREAM + 1)  # the owner has another stream
    mirroring.link.number = 1
    mirroring.send(frame(8, 2), made_ns=later_ns)  # only its time is false
    mirroring.send(frame(9, 3))
    mirroring.send(frame(10, 4), made_ns=time.time_ns() - 20 * S)
    assert [mirroring.next().delay_us < 1_000_000 for _ in range(3)] == [True, True, False]
    mirroring.link.reply = CommandReply(["written"], [""])
    SourceWriter(mirroring.block, 0).write({"count": 77})
    assert mirroring.link.commands[0].expires_ns < later_ns


def test_an_owner_whose_clock_was_set_forward_is_up_to_date(mirroring: Mirroring) -> None:
    mirroring.send(frame(7, 1))
    for number in range(8, 11):
        mirroring.send(frame(number, 1), made_ns=time.time_ns() + 3600 * S)
    mirroring.send(frame(11, 1))
    assert [mirroring.next().delay_us < 1_000_000 for _ in range(5)] == [True, True, True, True, False]


def test_a_restarted_uplink_that_publishes_nothing_is_asked_for_its_state(
    mirroring: Mirroring, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without it, commands would name the stream of the earlier uplink."""
    monkeypatch.setattr("shmio.connectors.fabric.loop.STATE_NS", 0)
    mirroring.send(frame(7, 1))
    mirroring.link.send(mirroring.link.state(SourceState((), S, False)))
    mirroring.next()
    mirroring.send(frame(8, 1))
    mirroring.next()
    states = mirroring.link.states
    mirroring.link.states_asked.clear()
    mirroring.send(frame(9, 1))
    mirroring.next()
    assert mirroring.link.states == states  # the state of this stream is known
    mirroring.link.answered(Announced(STREAM + 1, 0, time.monotonic_ns()))
    assert mirroring.link.states_asked.wait(PATIENCE_S)


def test_late_frames_do_not_open_the_source_for_writes(mirroring: Mirroring) -> None:
    mirroring.send(frame(7, 1), age_ns=30 * S)
    mirroring.next()
    mirroring.event(EventKind.QUALITY)
    [outcome] = SourceWriter(mirroring.block, 0).write({"count": 77})
    assert str(outcome.kind) == "rejected"
    assert mirroring.link.commands == []


def test_a_hole_is_not_given_up_while_there_is_no_connection(mirroring: Mirroring) -> None:
    mirroring.send(frame(7, 1))
    mirroring.next()
    missed = mirroring.link.message(frame(8, 2))
    mirroring.link.problem = "no connection"
    mirroring.send(frame(9, 3))
    assert not mirroring.link.asked.wait(1.0)
    mirroring.link.problem = ""
    mirroring.send(frame(10, 4))
    assert mirroring.link.asked.wait(PATIENCE_S)
    mirroring.link.send(missed)
    found = [mirroring.next()]
    while found[-1].cycle != 1010:
        found.append(mirroring.next())
    assert [one.cycle for one in found if one.quality is Quality.GOOD] == [1008, 1009, 1010]


def test_a_hole_is_not_given_up_while_the_connection_stalls(
    mirroring: Mirroring, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("shmio.connectors.fabric.order.PATIENCE_NS", 500_000_000)
    mirroring.send(frame(7, 1))
    mirroring.next()
    missed = mirroring.link.message(frame(8, 2))
    mirroring.link.stalled = True
    mirroring.send(frame(9, 3))
    assert mirroring.next().quality is Quality.BAD, "it has waited for its stale age"
    mirroring.link.send(missed)
    mirroring.link.stalled = False
    assert [mirroring.next().cycle for _ in range(2)] == [1008, 1009]


def test_frames_of_a_restarted_owner_are_no_gap(mirroring: Mirroring) -> None:
    mirroring.send(frame(7, 1), zero_ns=5)
    mirroring.send(frame(900, 2), zero_ns=6)
    assert [mirroring.next().cycle, mirroring.next().cycle] == [1007, 1900]
    assert mirroring.loop.missing == 0


def test_missing_messages_are_requested_and_come_before_later_ones(mirroring: Mirroring) -> None:
    mirroring.send(frame(7, 1))
    assert mirroring.next().cycle == 1007
    missed = mirroring.link.message(frame(8, 2))
    mirroring.send(frame(9, 3))
    assert mirroring.link.asked.wait(PATIENCE_S)
    assert mirroring.link.requests == [Missing(STREAM, 2, 2)]
    mirroring.link.send(missed)
    mirroring.link.answered(Missing(STREAM, 2, 2))
    assert [mirroring.next().cycle, mirroring.next().cycle] == [1008, 1009]
    assert mirroring.loop.missing == 0


def test_frames_that_the_owner_no_longer_has_are_reported_as_a_gap(mirroring: Mirroring) -> None:
    mirroring.send(frame(7, 1))
    mirroring.send(frame(57, 3), skip=49)
    assert mirroring.link.asked.wait(PATIENCE_S)
    mirroring.link.answered(mirroring.link.requests[0])
    assert "frames 8 to 56" in mirroring.event(EventKind.NOTED).text
    assert [mirroring.next().cycle, mirroring.next().cycle] == [1007, 1057]
    assert mirroring.loop.missing == mirroring.loop.counters.overruns == 49


def test_a_false_message_in_the_owners_name_does_not_keep_its_messages_away(mirroring: Mirroring) -> None:
    mirroring.send(frame(7, 1))
    mirroring.link.answered(Announced(STREAM, 1, time.monotonic_ns()))
    mirroring.link.send(mirroring.link.message(frame(8, 66), stream=STREAM + 1))
    mirroring.link.number = 1 << 40
    mirroring.link.send(mirroring.link.message(frame(9, 66)))
    mirroring.link.number = 1
    mirroring.send(frame(8, 2))
    assert [mirroring.next().cycle, mirroring.next().cycle] == [1007, 1008]
    assert not mirroring.link.requests


def test_frames_that_the_owners_rules_leave_out_are_no_gap(mirroring: Mirroring) -> None:
    mirroring.send(frame(7, 1))
    mirroring.send(frame(17, 2), left_out=9)
    mirroring.send(Gap("cell", 1, "frames", 18, 20, 3, Reason.OVERTAKEN), frame(21, 3), frame(23, 4), left_out=10)
    assert "frames 18 to 20" in mirroring.event(EventKind.NOTED).text
    mirroring.send(frame(24, 5), left_out=10)
    assert [mirroring.next().cycle for _ in range(5)] == [1007, 1017, 1021, 1023, 1024]
    assert mirroring.loop.missing == 3


def test_frames_that_the_owners_rules_leave_out_are_no_gap_if_messages_are_lost(mirroring: Mirroring) -> None:
    mirroring.send(frame(7, 1), left_out=(1 << 32) - 5)
    mirroring.send(frame(27, 3), skip=2, left_out=12)  # 17 were left out, and two messages with a frame each are lost
    assert mirroring.link.asked.wait(PATIENCE_S)
    mirroring.link.answered(mirroring.link.requests[0])
    assert [mirroring.next().cycle, mirroring.next().cycle] == [1007, 1027]
    assert "frames 8 to 9" in mirroring.event(EventKind.NOTED).text
    assert mirroring.loop.missing == mirroring.loop.counters.overruns == 2


def test_frames_of_one_message_are_published_as_those_of_several(mirroring: Mirroring) -> None:
    """A run of good frames is published at once; all that follows it, one at a time."""
    noted = Event(4, EventKind.NOTED, 10, 1010, 0, 0, 9, 3, Quality.GOOD, 5, 99, 1, 2, 0, 0, 0, b"", "by the owner")
    doubtful = frame(13, 13, quality=Quality.UNCERTAIN, reason="2 of 4 nodes")
    good = [frame(number, number, effective=b"\0\x09\0\0" if number == 9 else None) for number in range(7, 18)]
    mirroring.send(good[0])
    mirroring.next()
    mirroring.send(*good[1:4], noted, good[5], doubtful, *good[7:], age_ns=STALE_NS)  # frame 11 is missing
    frames = [mirroring.next() for _ in range(9)]
    assert [(one.cycle, one.source_ns, one.raw[1], one.effective) for one in frames] == [
        (1000 + number, 5 * S + number, number, b"\0\x09\0\0" if number == 9 else None)
        for number in (8, 9, 10, 12, 13, 14, 15, 16, 17)
    ]
    assert [one.quality for one in frames[3:6]] == [Quality.GOOD, Quality.UNCERTAIN, Quality.GOOD]
    assert all(one.delay_us >= STALE_NS // 1000 for one in frames)
    assert "frames 11 to 11 are missing" in (gap := mirroring.event(EventKind.NOTED)).text
    owners = mirroring.event(EventKind.NOTED)
    assert (owners.text, owners.cycle, gap.number + 1) == ("by the owner", 1010, owners.number)
    assert (frames[2].number, frames[3].event) == (gap.frame, owners.number)
    assert mirroring.loop.counters.polls == 10


def test_a_silent_owner_makes_the_source_bad_until_it_sends_again(mirroring: Mirroring) -> None:
    mirroring.send(frame(7, 1))
    mirroring.next()
    bad = mirroring.next()
    assert bad.quality is Quality.BAD
    assert "plant1.line3.a50" in bad.reason
    assert bad.raw == b"\0\1\0\0"
    mirroring.send(frame(8, 2))
    assert mirroring.next().quality is Quality.GOOD


def test_a_lost_connection_is_the_reason_for_bad_quality(mirroring: Mirroring) -> None:
    mirroring.send(frame(7, 1))
    mirroring.next()
    mirroring.link.problem = "the connection is lost"
    assert mirroring.next().reason == "the connection is lost"
    assert mirroring.loop.note == "the connection is lost"
    mirroring.link.problem = "the server does not know the credentials"
    assert mirroring.next().reason == "the server does not know the credentials"
    mirroring.link.problem = ""
    assert "plant1.line3.a50 sends nothing" in mirroring.next().reason, "the server has no JetStream, for example"


def test_a_bad_frame_of_the_mirror_takes_no_cycle_of_a_frame_that_comes_late(mirroring: Mirroring) -> None:
    """The owner publishes events of a cycle before its frame, and before a late frame of the cycle before."""
    accepted = Event(4, EventKind.ACCEPTED, 7, 1009, 0, 0, 9, 3, Quality.GOOD, 5, 99, 0, 1, 0, 0, 2, b"\0\5", "")
    mirroring.send(frame(7, 1), accepted)
    mirroring.next()
    mirroring.event(EventKind.ACCEPTED)
    mirroring.link.problem = "the connection is lost"
    assert mirroring.next().quality is Quality.BAD
    mirroring.link.problem = ""
    mirroring.send(frame(8, 2), frame(9, 3))
    assert [found.cycle for found in (mirroring.next(), mirroring.next())] == [1008, 1009]
    cycles = [found.cycle for number in range(1, 5) if (found := mirroring.block.read(number)) is not None]
    assert cycles == [1007, 1007, 1008, 1009]


def test_events_of_the_owner_have_no_writer(mirroring: Mirroring) -> None:
    written = Event(
        4, EventKind.WRITTEN, 7, 1007, 0, 0, 9, 3, Quality.GOOD, 5, 99, 1, 2, 0, 0, 2, b"", "by the owner",
        by="web: anonymous (127.0.0.1)",
    )  # fmt: skip
    quality = written._replace(kind=EventKind.QUALITY, number=5)
    mirroring.send(frame(7, 1), quality, written)
    event = mirroring.event(EventKind.WRITTEN)
    assert (event.writer, event.command, event.text, event.cycle) == (NO_WRITER, 99, "by the owner", 1007)
    assert re.fullmatch(r"cell \S+( on host \S+)?: web: anonymous \(127\.0\.0\.1\)", event.by)


def test_another_layout_makes_the_source_bad_and_asks_for_a_reload_once(mirroring: Mirroring) -> None:
    mirroring.send(frame(7, 1))
    mirroring.next()
    mirroring.send(frame(8, 2), layout=b"another!")
    bad = mirroring.next()
    assert (bad.quality, "reload" in bad.reason) == (Quality.BAD, True)
    mirroring.send(frame(9, 2), layout=b"another!")
    assert mirroring.changed.wait(PATIENCE_S)
    assert mirroring.changes == 1


def test_another_layout_than_that_of_a_file_is_no_reason_to_reload(instance: str) -> None:
    with running(instance, own_layout=True) as mirroring:
        mirroring.send(frame(7, 1), layout=b"another!")
        bad = mirroring.next()
        assert bad.quality is Quality.BAD
        assert "key layout" in bad.reason
        assert mirroring.changes == 0


def test_a_reload_that_came_too_early_is_repeated(mirroring: Mirroring, monkeypatch: pytest.MonkeyPatch) -> None:
    """The registry may still have had the old layout."""
    monkeypatch.setattr("shmio.connectors.fabric.loop.RELOAD_NS", 0)
    for _ in range(2):
        mirroring.changed.clear()
        mirroring.send(frame(8, 2), layout=b"another!")
        assert mirroring.changed.wait(PATIENCE_S)


def test_malformed_messages_change_nothing(mirroring: Mirroring) -> None:
    mirroring.link.send(b"\xff" * 100)
    mirroring.send(frame(7, 1)._replace(raw=b"too long for the block"))
    mirroring.send(frame(8, 2))
    assert mirroring.next().cycle == 1008


def written(mirroring: Mirroring, kind: str, reason: str = "") -> tuple[str, str]:
    mirroring.send(frame(7, 1))
    mirroring.next()
    mirroring.event(EventKind.QUALITY)
    mirroring.link.reply = CommandReply([kind], [reason])
    [outcome] = SourceWriter(mirroring.block, 0).write({"count": 77})
    return str(outcome.kind), outcome.text


def test_a_write_goes_to_the_owner_before_its_time_runs_out(mirroring: Mirroring) -> None:
    assert written(mirroring, "written") == ("written", "")
    [request] = mirroring.link.commands
    [item] = request.writes
    assert (item.offset, item.mask, item.data, request.layout) == (0, 0, b"\0\x4d", LAYOUT.hash[:8])
    assert abs(request.expires_ns - time.time_ns()) < 10 * S


@pytest.mark.parametrize(
    ("kind", "seen"),
    [
        ("refused", "refused"),
        ("rejected", "refused"),
        ("taken", "taken"),
        ("expired", "expired"),
        ("unknown", "unknown"),
        ("accepted", "unknown"),
    ],
)
def test_outcomes_of_the_owner(mirroring: Mirroring, kind: str, seen: str) -> None:
    assert written(mirroring, kind, "the reason")[0] == seen


def test_registers_that_are_not_writable_here_stay_here(mirroring: Mirroring) -> None:
    mirroring.send(frame(7, 1))
    mirroring.next()
    with pytest.raises(CommandError, match="writable"):
        SourceWriter(mirroring.block, 0).write({"other": 1})
    assert mirroring.link.commands == []


def test_a_flood_needs_bounded_memory(mirroring: Mirroring, monkeypatch: pytest.MonkeyPatch) -> None:
    """Messages that come faster than the mirror may publish them, and do not fit, are requested later."""
    monkeypatch.setattr("shmio.connectors.fabric.loop.MAX_WAITING_BYTES", 20_000)
    messages = [
        mirroring.link.message(*(frame(number, 1) for number in range(first, first + 50)), age_ns=30 * S)
        for first in range(7, 7 + 50 * 400, 50)
    ]
    for data in messages:
        mirroring.link.send(data)
    assert mirroring.loop._received_bytes < sum(map(len, messages)) // 2


def test_all_of_many_messages_at_once_are_published(mirroring: Mirroring) -> None:
    mirroring.send(frame(7, 1))
    mirroring.next()
    with mirroring.loop._output.lock:  # the loop stops
        for number in range(8, 309):
            mirroring.send(frame(number, 1))
    began = time.monotonic()
    assert [mirroring.next().cycle for _ in range(301)] == list(range(1008, 1309))
    assert time.monotonic() - began < 4, "the loop does not wait while messages wait"


def test_a_faulty_age_of_the_owner_gives_a_command_that_can_be_sent(mirroring: Mirroring) -> None:
    mirroring.send(frame(7, 1))
    mirroring.next()
    mirroring.event(EventKind.QUALITY)
    mirroring.send(frame(8, 1), age_ns=(1 << 64) - 1)
    mirroring.next()
    mirroring.link.reply = CommandReply(["expired"], [""])
    SourceWriter(mirroring.block, 0).write({"count": 77})
    assert encode_command(mirroring.link.commands[0])
