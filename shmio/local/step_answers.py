"""What a step waits for, and what has come of it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

from shmio.errors import SegmentError
from shmio.segment.block import Block
from shmio.segment.frame import Quality
from shmio.segment.segment import Segment

_NOBODY: Final = "no source lives on the instance's clock: steps move none; those with a device go on in real time"
_REAL: Final = "; shmio step --release brings real time back"
_STANDS: Final = f"it stands until it is stepped{_REAL}"


class StepWait(NamedTuple):
    """What a step waits for: that a bell differs from ``seen``, or for so long.

    It is the doorbell of ``block``, which has to answer; if that is None, the bell of those who deliver steps.
    """

    block: Block | None
    seen: int
    rest_ns: int


def step_answer(block: Block, number: int) -> str | None:
    """A participant's answer to a step: empty when it is done, why it failed, None as long as there is none."""
    if block.retired:
        return ""  # a reload has ended it
    try:
        if block.playhead is not None:
            play = block.playhead.read()
            return None if play is None or play.step < number else ""
        frame = block.latest()
    except SegmentError as error:
        return str(error)
    if frame is None or frame.cycle < number:
        return None
    return frame.reason or "it gave no reason" if frame.quality is Quality.BAD else ""


def describe_silence(segment: Segment, block: Block, hard_ns: int) -> str:
    """What is known of a participant that has not answered."""
    what = f"{block.source}: no answer within {hard_ns / 1e9:g} s"
    for slot in segment.processes:
        if slot.name == block.source:
            if slot.alive():
                return f"{what} from pid {slot.report.pid}"
            told = slot.supervised
            return f"{what}: its process does not run ({told.phase}{told.note and f': {told.note}'})"
    return what


def take_over_note(participants: Sequence[Block]) -> str:
    """What is told of time that was real until now."""
    return _STANDS if participants else f"{_NOBODY}{_REAL}"


def unmoved_note(segment: Segment, participants: Sequence[Block]) -> str:
    """What the next step does not move, though who steps may expect it, and the remedy; empty: it moves all."""
    if not participants:
        return _NOBODY if segment.clock.stepped else f"{_NOBODY}{_REAL}"
    found: dict[str, list[str]] = {"paused": [], "over": []}
    for block in participants:
        try:
            play = block.playhead.read() if block.playhead is not None else None
        except SegmentError:  # the step says so
            continue
        if play is not None and play.paused:
            found["over" if play.over else "paused"].append(block.source)
    return "; ".join(
        f"the replay of {names[0]}{f' and {len(names) - 1} more' if names[1:] else ''} was {how} and did not move: "
        "shmio replay play starts it"
        for how, names in found.items()
        if names
    )
