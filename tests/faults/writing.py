"""A program that writes the last word of each PLC's block, always another value, and asks the PLC what came of it."""

from __future__ import annotations

import random
from collections import deque
from functools import partial

from shmio.errors import CommandError
from shmio.segment import EventKind
from shmio.segment.attach import Attachment
from tests.faults.checker import Checker
from tests.faults.checks import Source, WriteCheck
from tests.faults.local import attached

PAUSE_S = 0.05
REMEMBERED = 200


def write(checker: Checker, source: Source) -> None:
    """Write, look, and look again later."""
    chance = random.Random(checker.description.seed)
    counts = checker.counts(f"writes {source.name}")
    check = WriteCheck(source, checker.complain, counts)
    past: deque[int] = deque(maxlen=REMEMBERED)
    value = 0

    def work(attachment: Attachment) -> None:
        nonlocal value
        while attachment.current and not checker.stopping.wait(PAUSE_S):
            value += 1
            try:
                (outcome,) = attachment.write({f"{source.name}/command": value}, chance.choice((0.05, 0.5, 2.0)))
                kind, text = outcome.kind, outcome.text
            except CommandError as error:
                kind, text = EventKind.REJECTED, str(error)
            check.outcome(value, kind, text)
            past.append(value)
            check.again(past[0])

    attached(checker, work, writable=True)


def main() -> None:
    checker = Checker()
    for source in checker.sources:
        if source.landed is not None:
            checker.work(partial(write, checker, source))
    checker.run()


if __name__ == "__main__":
    main()
