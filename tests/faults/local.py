"""Local readers: of every frame and of the newest frame, and one slower than its ring."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

import shmio
from shmio.errors import NotRunningError, QualityError, SegmentError
from shmio.local.attach import Attachment
from shmio.segment import Block, Quality
from tests.faults.checker import Checker
from tests.faults.checks import FrameCheck, Source

PAUSE_S = 0.05
LOOK_S = 0.007
TURN_S = 0.2
FRAMES, SLEEP_S = 20, 3.0
"""The slow reader sleeps after this many frames, longer than the ring keeps a frame."""


def attached(checker: Checker, work: Callable[[Attachment], None], *, writable: bool = False) -> None:
    """Attach and call ``work``, again after each restart of the instance."""
    while not checker.stopping.is_set():
        try:
            with shmio.attach(checker.description.instance, writable=writable) as attachment:
                work(attachment)
        except (NotRunningError, SegmentError):  # not running, incomplete or stopped: try again
            checker.stopping.wait(PAUSE_S)


def started_ns(attachment: Attachment) -> int:
    """Return CLOCK_MONOTONIC of the instance's start."""
    return attachment._segment.header.started_ns


def follow(checker: Checker, source: Source, *, slow: bool) -> None:
    """Read every frame once. With ``slow``, sleep in between, and read only the frames that the ring still has."""
    check = FrameCheck(source, checker.complain, checker.counts(f"{'slow' if slow else 'stream'} {source.name}"))

    def work(attachment: Attachment) -> None:
        block = attachment.block(source.name)
        drain(attachment, block, block.ring.head())
        while block.retired and attachment.current and not checker.stopping.is_set():
            block = attachment.block(source.name)
            drain(attachment, block, 0)

    def drain(attachment: Attachment, block: Block, after: int) -> None:
        check.begin(started_ns(attachment))
        cursor = block.cursor(after=after)
        delivered = missed = 0
        while attachment.current and not checker.stopping.is_set():
            frame = cursor.next(timeout_s=TURN_S)
            if frame is None and block.retired and not cursor.behind:
                break
            if frame is not None:
                delivered += 1
                check.frame(frame, cursor.missed - missed, time.monotonic_ns())
                missed = cursor.missed
            if slow and delivered % FRAMES == 0 and checker.stopping.wait(SLEEP_S):
                break
        if delivered + missed != cursor.last - after:
            checker.complain(
                f"{source.name}: {delivered} frames and {missed} missed are not {after + 1}..{cursor.last}"
            )

    attached(checker, work)


def look(checker: Checker, source: Source) -> None:
    """Read the newest frame and value repeatedly, even while no new frame arrives."""
    check = FrameCheck(source, checker.complain, checker.counts(f"newest {source.name}"))

    def work(attachment: Attachment) -> None:
        check.begin(started_ns(attachment))
        number = section = 0
        while attachment.current and not checker.stopping.wait(LOOK_S):
            try:
                view = attachment.frame(source.name)
            except QualityError:
                continue  # no frame yet
            now_ns = time.monotonic_ns()
            frame = view.frame
            if view.section != section:  # a reload has replaced the block
                number, section = 0, view.section
                check.begin(started_ns(attachment))
            if frame.number < number:
                checker.complain(f"{source.name}: frame {frame.number} is the newest after {number}")
            if frame.number > number:
                check.frame(frame, max(0, frame.number - number - 1), now_ns)
            else:
                check.age(frame, now_ns)
            number = frame.number
            reading = attachment.read(f"{source.name}/stamp")
            if reading.quality is Quality.BAD and not reading.reason:
                checker.complain(f"{source.name}: a bad value without a reason")

    attached(checker, work)


def main() -> None:
    checker = Checker()
    for source in checker.sources:
        checker.work(partial(follow, checker, source, slow=False))
        checker.work(partial(look, checker, source))
    fastest = min(checker.sources, key=lambda source: source.period_ns)
    checker.work(partial(follow, checker, fastest, slow=True))
    checker.run()


if __name__ == "__main__":
    main()
