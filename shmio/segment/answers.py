"""What a step waits for, and what has come of it."""

from __future__ import annotations

from typing import NamedTuple

from shmio.errors import SegmentError
from shmio.segment.block import Block
from shmio.segment.frame import Quality
from shmio.segment.segment import Segment


class Wait(NamedTuple):
    """What a step waits for: that a bell differs from ``seen``, or for so long.

    It is the doorbell of ``block``, which has to answer; if that is None, the bell of those who deliver steps.
    """

    block: Block | None
    seen: int
    rest_ns: int


def answer(block: Block, number: int) -> str | None:
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


def silence(segment: Segment, block: Block, hard_ns: int) -> str:
    """What is known of a participant that has not answered."""
    what = f"{block.source}: no answer within {hard_ns / 1e9:g} s"
    for slot in segment.processes:
        if slot.name == block.source:
            if slot.alive():
                return f"{what} from pid {slot.report.pid}"
            told = slot.supervised
            return f"{what}: its process does not run ({told.phase}{told.note and f': {told.note}'})"
    return what
