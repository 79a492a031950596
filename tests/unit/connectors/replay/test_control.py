"""A local program controls a replay: pause, play, seek, play to a change, an event or a time."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from shmio.connectors.replay.loop import GOES_ON, OVER, STOPPED
from shmio.errors import CommandError, PathError, ShmioError, ValueRangeError
from shmio.local import replays
from shmio.local.attach import Attachment, attach
from shmio.segment import EventKind, Quality, Record, Segment
from shmio.segment.playhead import MoveRequest, Playhead, PlayheadAnswer
from tests.unit.connectors.replay.harness import (
    BEGIN_NS,
    MS,
    PERIOD_NS,
    Playing,
    S,
    built,
    counts,
    image,
    record,
    recorded,
)


@pytest.fixture
def file(tmp_path: Path, instance: str) -> Path:
    return record(tmp_path, instance)


@pytest.fixture
def paused_replay(instance: str, file: Path) -> Iterator[tuple[Playing, Attachment]]:
    with (
        built(instance, stepped=False) as segment,
        Playing(segment, file, paused=True) as playing,
        attach(instance, writable=True) as attachment,
    ):
        assert counts([playing.next()]) == [0], "the first frame is shown at once"
        yield playing, attachment


def test_replay_stays_paused_until_it_is_played(paused_replay: tuple[Playing, Attachment]) -> None:
    playing, attachment = paused_replay
    [status] = attachment.replay.status()
    assert (status.source, status.paused, status.position_s, status.length_s) == ("cell", True, 0.0, 0.4)
    assert attachment.read("cell/count").quality is Quality.GOOD
    [status] = attachment.replay.play(4)
    assert (status.paused, status.speed) == (False, 4)
    assert counts([playing.next() for _ in range(19)]) == list(range(1, 20))
    assert playing.next().reason == "replay: the recording is over"
    [status] = attachment.replay.status()
    assert (status.over, status.paused, status.position_s) == (True, True, 0.4)
    attachment.replay.play()
    assert counts([playing.next() for _ in range(20)]) == list(range(20)), "play at the end starts from the beginning"


def test_seek_shows_the_recorded_frame(paused_replay: tuple[Playing, Attachment]) -> None:
    playing, attachment = paused_replay
    for position_s, count in ((0.2, 10), (0.35, 17), (0.05, 2), (0.0, 0)):
        [status] = attachment.replay.seek(position_s)
        assert status.position_s == position_s
        frame = playing.next()
        assert counts([frame]) == [count]
        assert frame.age_ns(playing.block.now_ns()) == round(position_s * 1e9) - count * PERIOD_NS + 3000
    [status] = attachment.replay.seek("1970-01-01T01:58:20.1+00:00")
    assert (status.position_s, status.time_s) == (0.1, 7100.1)


def test_play_to_the_next_change_and_pause(paused_replay: tuple[Playing, Attachment]) -> None:
    playing, attachment = paused_replay
    attachment.replay.to_change("cell/other")
    frames = [playing.next() for _ in range(10)]
    assert counts(frames) == list(range(1, 11))
    playing.until(lambda: attachment.replay.status()[0].paused)
    [status] = attachment.replay.status()
    assert (status.position_s, playing.frames()) == (0.2, [])
    with pytest.raises(CommandError, match="there is no change of other between here and the end"):
        attachment.replay.to_change("other")
    assert attachment.replay.seek(0)
    [status] = attachment.replay.to_change("other", jump=True)
    assert (status.position_s, status.paused) == (0.2, True)


def test_play_to_the_next_event(tmp_path: Path, instance: str) -> None:
    with recorded(tmp_path, instance) as [cell]:
        for number in range(10):
            cell.frame(BEGIN_NS + number * PERIOD_NS, image(number))
            if number == 6:
                cell.event(BEGIN_NS + number * PERIOD_NS + MS, Record(EventKind.ACCEPTED))
    [file] = tmp_path.glob("*.mem")
    with (
        built(instance) as segment,
        Playing(segment, file) as playing,
        attach(instance, writable=True) as attachment,
    ):
        attachment.replay.to_event("accepted")
        attachment.step(1.0)
        assert counts(playing.frames()) == list(range(7))
        assert [event.kind for event in playing.happened()] == [EventKind.ACCEPTED]
        assert attachment.replay.status()[0].paused
        with pytest.raises(CommandError, match=r"unknown kind of event 'none'; did you mean 'noted'"):
            attachment.replay.to_event("none")


@pytest.mark.parametrize(("injections", "at"), [("keep", 3), ("leave out", 6)])
def test_play_to_the_next_event_of_any_kind(tmp_path: Path, instance: str, injections: str, at: int) -> None:
    """Events that the replay omits do not count."""
    kinds = {1: EventKind.STARTED, 3: EventKind.INJECTED, 6: EventKind.NOTED}
    with recorded(tmp_path, instance) as [cell]:
        for number in range(10):
            cell.frame(BEGIN_NS + number * PERIOD_NS, image(number))
            if number in kinds:
                cell.event(BEGIN_NS + number * PERIOD_NS + MS, Record(kinds[number], "it"))
    [file] = tmp_path.glob("*.mem")
    with (
        built(instance, stepped=False) as segment,
        Playing(segment, file, paused=True, injections=injections) as playing,
        attach(instance, writable=True) as attachment,
    ):
        attachment.replay.to_event("any", jump=True)
        assert counts(playing.frames())[-1] == at


def test_search_stops_at_the_end_of_the_played_part(tmp_path: Path, instance: str) -> None:
    file = record(tmp_path, instance)
    with (
        built(instance, stepped=False) as segment,
        Playing(segment, file, paused=True, end=0.15),
        attach(instance, writable=True) as attachment,
        pytest.raises(CommandError, match=r"there is no change of other between here and the end of the played part"),
    ):
        attachment.replay.to_change("cell/other", jump=True)


@pytest.mark.parametrize(
    ("what", "error"),
    [
        (lambda replay: replay.speed(0), ValueRangeError),
        (lambda replay: replay.speed(float("nan")), ValueRangeError),
        (lambda replay: replay.seek(1), ValueRangeError),
        (lambda replay: replay.seek("yesterday"), ValueRangeError),
        (lambda replay: replay.to_change("cell/none"), PathError),
        (lambda replay: replay.to_change("none/count"), PathError),
        (lambda replay: replay.status(["none"]), PathError),
    ],
)
def test_invalid_requests_are_refused(
    paused_replay: tuple[Playing, Attachment], what: object, error: type[ShmioError]
) -> None:
    playing, attachment = paused_replay
    with pytest.raises(error):
        what(attachment.replay)  # type: ignore[operator]
    assert playing.frames() == []


def test_instance_without_a_replay_refuses_control(instance: str) -> None:
    with built(instance), attach(instance) as attachment:
        with pytest.raises(CommandError, match="plays no recording"):
            attachment.replay.status()
        with pytest.raises(CommandError, match="attach with writable=True"):
            attachment.replay.pause()


def test_sources_of_one_recording_move_together(tmp_path: Path, instance: str) -> None:
    with recorded(tmp_path, instance, "cell", "other") as both:
        for number in range(20):
            for one in both:
                one.frame(BEGIN_NS + number * PERIOD_NS, image(number, number // 5))
    [file] = tmp_path.glob("*.mem")
    with (
        built(instance, "cell", "other", stepped=False) as segment,
        Playing(segment, file, paused=True) as cell,
        Playing(segment, file, "other", paused=True) as other,
        attach(instance, writable=True) as attachment,
    ):
        assert [status.position_s for status in attachment.replay.seek(0.1)] == [0.1, 0.1]
        attachment.replay.to_change("other/other")
        assert counts([other.next(lambda frame: frame.raw[3] == 2)]) == [10]
        assert counts([cell.next(lambda frame: frame.raw[3] == 2)]) == [10]
        for playing in (cell, other):
            playing.until(lambda: all(status.paused for status in attachment.replay.status()))
        assert {status.position_s for status in attachment.replay.status()} == {0.2}


def test_play_until_a_past_time_is_refused(paused_replay: tuple[Playing, Attachment]) -> None:
    playing, attachment = paused_replay
    attachment.replay.seek(0.2)
    playing.next()
    with pytest.raises(
        CommandError, match=r"^cell: the requested time has passed: the replay is at 0\.200 s; seek to an earlier time$"
    ):
        attachment.replay.play_until(0.1)
    [status] = attachment.replay.status()
    assert (status.paused, status.position_s, status.until_s) == (True, 0.2, None)
    attachment.replay.play_until(0.3)
    playing.until(lambda: attachment.replay.status()[0].position_s == 0.3)
    assert counts(playing.frames()) == list(range(11, 16))


@contextmanager
def replay_without_other(folder: Path, instance: str) -> Iterator[tuple[Path, Segment, Playing, Attachment]]:
    """Start a paused replay of two sources. One of them has no process, and time-outs are short."""
    file = record(folder, instance, "cell", "other")
    with (
        built(instance, "cell", "other", stepped=False) as segment,
        Playing(segment, file, paused=True) as cell,
        attach(instance, writable=True) as attachment,
        pytest.MonkeyPatch.context() as monkeypatch,
    ):
        with Playing(segment, file, "other", paused=True) as other:
            other.next()
        monkeypatch.setattr(replays, "ANSWER_S", 1.0)
        yield file, segment, cell, attachment


def test_a_source_that_missed_requests_catches_up(tmp_path: Path, instance: str) -> None:
    with replay_without_other(tmp_path, instance) as (file, segment, cell, attachment):
        with pytest.raises(CommandError, match="does not answer"):
            attachment.replay.seek(0.1)
        cell.until(lambda: attachment.replay.status(["cell"])[0].position_s == 0.1)
        with pytest.raises(CommandError, match="does not answer"):
            attachment.replay.speed(0.5)
        with Playing(segment, file, "other", paused=True) as other:
            other.until(lambda: len({one.position_s for one in attachment.replay.status()}) == 1)
            assert counts([other.next(lambda frame: frame.quality is Quality.GOOD)]) == [5]
            assert [(one.position_s, one.speed) for one in attachment.replay.status()] == [(0.1, 0.5)] * 2
            assert counts([cell.next(lambda frame: frame.raw[1] == 5)]) == [5]


def test_source_that_starts_late_joins_the_others_at_the_end(tmp_path: Path, instance: str) -> None:
    file = record(tmp_path, instance, "cell", "other")
    with (
        built(instance, "cell", "other", stepped=False) as segment,
        Playing(segment, file) as cell,
        attach(instance, writable=True) as attachment,
    ):
        cell.until(lambda: attachment.replay.status()[0].over)
        with Playing(segment, file, "other") as other:
            shown = [other.next(), other.next()]
            assert [one.over for one in attachment.replay.status()] == [True, True]
    assert counts(shown) == [19, 19]
    assert [(frame.quality, frame.reason) for frame in shown] == [(Quality.GOOD, ""), (Quality.BAD, OVER)]


def test_source_that_missed_requests_catches_up_with_others_at_the_end(tmp_path: Path, instance: str) -> None:
    with replay_without_other(tmp_path, instance) as (file, segment, cell, attachment):
        with pytest.raises(CommandError, match="does not answer"):
            attachment.replay.seek(0.3)
        with pytest.raises(CommandError, match="does not answer"):
            attachment.replay.play()
        cell.until(lambda: attachment.replay.status()[0].over)
        with Playing(segment, file, "other", paused=True) as other:
            shown = [other.next(), other.next()]
            assert [one.over for one in attachment.replay.status()] == [True, True]
    assert counts(shown) == [19, 19]
    assert [(frame.quality, frame.reason) for frame in shown] == [(Quality.GOOD, ""), (Quality.BAD, OVER)]


def test_paused_replay_is_good_again_after_a_restart(tmp_path: Path, instance: str) -> None:
    file = record(tmp_path, instance)
    with built(instance, stepped=False) as segment, attach(instance, writable=True) as attachment:
        with Playing(segment, file, paused=True):
            attachment.replay.seek(0.2)
        assert attachment.read("cell/count").reason == STOPPED
        with Playing(segment, file, paused=True) as cell:
            frame = cell.next()
            assert (counts([frame]), frame.quality, frame.reason) == ([10], Quality.GOOD, "")
            told = [(event.kind, event.quality, event.text) for event in cell.happened()]
            assert told == [(EventKind.QUALITY, Quality.GOOD, GOES_ON)]
            attachment.replay.seek(0.3)
            assert counts(cell.frames()) == [15], "the frame is shown once"


def play_and_request_pause(segment: Segment, for_ns: int) -> tuple[Playhead, int]:
    """Set the playhead as if it had played for a time. Request a pause, which the next process answers."""
    head = segment.blocks["cell"].playhead
    assert head is not None
    play, now_ns = head.read(), segment.clock.present_ns()
    assert play is not None
    head.write(play._replace(paused=False, anchor_ns=now_ns - for_ns))
    with head.held():
        return head, head.ask(MoveRequest(now_ns, paused=True))


def test_request_in_the_next_round_waits_for_the_end_of_this_one(tmp_path: Path, instance: str) -> None:
    """A delayed source plays up to the position of the pause, and publishes no frame twice."""
    file = record(tmp_path, instance)
    with built(instance, stepped=False) as segment, attach(instance, writable=True) as attachment:
        with Playing(segment, file, loop=True, paused=True):
            attachment.replay.seek(0.3)
        play_and_request_pause(segment, 200 * MS)
        with Playing(segment, file) as cell:
            assert counts([cell.next() for _ in range(10)]) == [16, 17, 18, 19, 0, 1, 2, 3, 4, 5]
            [status] = attachment.replay.seek(0.2)
            assert (status.paused, counts(cell.frames())) == (True, [10]), "the replay is still paused"


def test_late_request_takes_effect_at_its_own_time(paused_replay: tuple[Playing, Attachment]) -> None:
    playing, _ = paused_replay
    head = playing.block.playhead
    assert head is not None
    now_ns = playing.block.clock.present_ns()
    with head.held():
        number = head.ask(MoveRequest(now_ns - 90 * S, paused=False, speed=0.01, position_ns=BEGIN_NS))
        playing.clock.nudge()
        playing.until(lambda: head.found(number) is not None)
        assert head.found(number) == PlayheadAnswer()
    assert playing.next(lambda frame: frame.quality is Quality.BAD).reason == "replay: the recording is over"


def test_frames_due_before_a_request_come_before_its_answer(tmp_path: Path, instance: str) -> None:
    """When a pause is answered, all frames up to the pause are there, and no more come."""
    file = record(tmp_path, instance, frames=400)
    with built(instance, stepped=False) as segment, attach(instance, writable=True) as attachment:
        with Playing(segment, file, paused=True):
            attachment.replay.seek(0.1)
        head, number = play_and_request_pause(segment, 6 * S)
        with Playing(segment, file) as cell:
            cell.until(lambda: head.found(number) is not None)
            assert counts(cell.frames()) == list(range(6, 306))


def test_request_just_after_a_wrap_takes_effect_in_the_next_round(tmp_path: Path, instance: str) -> None:
    """The requesting program may have read the clock later than the source did."""
    file = record(tmp_path, instance)
    with (
        built(instance, stepped=False) as segment,
        Playing(segment, file, loop=True, speed=0.1) as cell,
        attach(instance, writable=True) as attachment,
    ):
        cell.next()
        head = cell.block.playhead
        assert head is not None
        play = head.read()
        assert play is not None
        with head.held():
            number = head.ask(MoveRequest(play.next_round().anchor_ns + 5_000, paused=True))
            cell.clock.nudge()
            cell.until(lambda: head.found(number) is not None)
        [status] = attachment.replay.status()
        assert (status.paused, status.position_s < 0.001) == (True, True)
        assert counts(cell.frames())[-1] == 0


def test_request_just_before_a_wrap_takes_effect_in_that_round(tmp_path: Path, instance: str) -> None:
    """This source may have begun the next round, while others of its recording have not."""
    file = record(tmp_path, instance)
    with (
        built(instance, stepped=False) as segment,
        Playing(segment, file, loop=True, speed=0.1) as cell,
        attach(instance, writable=True) as attachment,
    ):
        attachment.replay.seek(0.38)
        cell.next(lambda frame: counts([frame]) == [19])
        assert counts([cell.next()]) == [0]
        head = cell.block.playhead
        assert head is not None
        play = head.read()
        assert play is not None
        with head.held():
            number = head.ask(MoveRequest(play.anchor_ns - 5_000, paused=True))
            cell.clock.nudge()
            cell.until(lambda: head.found(number) is not None)
        [status] = attachment.replay.status()
        assert (status.paused, round(status.position_s, 3)) == (True, 0.4)
        assert counts(cell.frames())[-1] == 19
