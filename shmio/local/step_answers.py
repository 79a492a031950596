"""Answers of sources to a step of time, and the notes about it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

from shmio.errors import SegmentError
from shmio.model.values import Quality
from shmio.segment.block import Block
from shmio.segment.segment import Segment

_NOBODY: Final = (
    "no source uses the instance clock, so stepping has no effect; sources with a device continue in real time"
)
_REAL: Final = "; shmio step --release returns to real time"
_STANDS: Final = f"it is paused until the next step{_REAL}"


class StepWait(NamedTuple):
    """A wait within a step: until a doorbell differs from ``seen``, at most ``rest_ns``.

    The doorbell is that of ``block``, whose answer is awaited. If ``block`` is None it is the doorbell
    of the processes that deliver steps.
    """

    block: Block | None
    seen: int
    rest_ns: int


def step_answer(block: Block, number: int) -> str | None:
    """Return a block's answer to a step: empty if done, the reason if it failed, None if none came."""
    if block.retired:
        return ""  # a reload has retired the block
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
    """Describe a source that has not answered a step in time."""
    what = f"{block.source}: no answer within {hard_ns / 1e9:g} s"
    for slot in segment.processes:
        if slot.name == block.source:
            if slot.alive():
                return f"{what} from pid {slot.report.pid}"
            told = slot.supervised
            return f"{what}: its process does not run ({told.phase}{told.note and f': {told.note}'})"
    return what


def take_over_note(participants: Sequence[Block]) -> str:
    """Return the clock's note after time was taken over."""
    return _STANDS if participants else f"{_NOBODY}{_REAL}"


def unmoved_note(segment: Segment, participants: Sequence[Block]) -> str:
    """Describe what the next step will not move, with the remedy; empty if it moves everything."""
    if not participants:
        return _NOBODY if segment.clock.stepped else f"{_NOBODY}{_REAL}"
    found: dict[str, list[str]] = {"paused": [], "over": []}
    for block in participants:
        try:
            play = block.playhead.read() if block.playhead is not None else None
        except SegmentError:  # the step itself reports it
            continue
        if play is not None and play.paused:
            found["over" if play.over else "paused"].append(block.source)
    return "; ".join(
        f"the replay of {names[0]}{f' and {len(names) - 1} more' if names[1:] else ''} was {how} and did not move: "
        "shmio replay play starts it"
        for how, names in found.items()
        if names
    )
