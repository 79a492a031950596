"""Fifty readers in C, each in a separate process, that start and end all the time."""

from __future__ import annotations

import random
import re
import selectors
import subprocess
import time
from functools import partial

from tests.faults.checker import Checker
from tests.faults.checks import Counts, Source, ValueCheck

READERS = 50
ON_FASTEST = 4
"""Number of readers of the fastest source: few, because each frame is a line to check here."""
TURN_S = 0.1
LINE = re.compile(rb"(\d+) cycle (\d+) missed (\d+) (good|uncertain|bad) (\d+) (.*)")
GONE = re.compile(r"no instance|.* is starting|.* has stopped|source \S+ was changed")
"""Messages of a reader whose instance is not running or stops."""


class Reader:
    """One reader, from its start to its end."""

    def __init__(self, checker: Checker, source: Source, counts: Counts, chance: random.Random) -> None:
        self._checker = checker
        self._check = ValueCheck(source, checker.complain, counts)
        self._name = source.name
        self._number = self._missed = 0
        self._looked_ns = time.monotonic_ns()
        self._tail = b""
        self.killed = False
        frames = chance.choice((1, chance.randrange(2, 100), 1_000_000))
        self.end_s = time.monotonic() + chance.uniform(0.05, 5.0)
        description = checker.description
        self.popen = subprocess.Popen(
            [description.reader, description.instance, f"{source.name}/stamp", str(frames)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )

    def take(self, data: bytes) -> None:
        """Check what the reader has printed."""
        *lines, self._tail = (self._tail + data).split(b"\n")
        printed_ns, self._looked_ns = self._looked_ns, time.monotonic_ns()  # newer than the last call, which took all
        for line in lines:
            match = LINE.fullmatch(line)
            if match is None:
                self._checker.complain(f"the C reader of {self._name} printed {line!r}")
                continue
            number, missed = int(match[1]), int(match[3])
            again = number == self._number and match[6] == b"stale"
            if self._number and not again and number != self._number + 1 + missed - self._missed:
                self._checker.complain(
                    f"the C reader of {self._name} showed frame {number} after {self._number}, "
                    f"missed {missed} after {self._missed}"
                )
            self._check.counts.frames += 1
            self._check.counts.missed += missed - self._missed
            self._number, self._missed = number, missed
            if match[4] == b"good":
                self._check.value(int(match[5]), printed_ns, slack_ns=self._checker.slack_ns)

    def finish(self) -> None:
        """Wait for the reader's end, and check its exit status and messages."""
        assert self.popen.stdout is not None
        assert self.popen.stderr is not None
        words = self.popen.stderr.read(4096).decode("utf-8", "replace")
        status = self.popen.wait()
        self.popen.stdout.close()
        self.popen.stderr.close()
        right = status == 0 or (self.killed and status == -9) or (status == 1 and GONE.match(words))
        if not right or (status == 0 and words):
            self._checker.complain(f"the C reader of {self._name} ended with {status}: {words}")


def churn(checker: Checker) -> None:
    """Start new readers, check their output, and kill some, until the end."""
    chance = random.Random(checker.description.seed)
    fastest = min(checker.sources, key=lambda source: source.period_ns)
    counts = {source.name: checker.counts(f"readers {source.name}") for source in checker.sources}
    running: set[Reader] = set()
    with selectors.DefaultSelector() as selector:

        def start() -> None:
            on_fastest = sum(reader._name == fastest.name for reader in running) < ON_FASTEST
            others = [source for source in checker.sources if source is not fastest]
            source = fastest if on_fastest else chance.choice(others)
            reader = Reader(checker, source, counts[source.name], chance)
            assert reader.popen.stdout is not None
            running.add(reader)
            selector.register(reader.popen.stdout, selectors.EVENT_READ, reader)

        while not checker.stopping.is_set():
            for _ in range(min(2, READERS - len(running))):  # a few at a time
                start()
            for key, _ in selector.select(TURN_S):
                reader: Reader = key.data
                data = key.fileobj.read1(1 << 16)  # type: ignore[union-attr]
                reader.take(data)
                if not data:
                    selector.unregister(key.fileobj)
                    running.discard(reader)
                    reader.finish()
            for reader in running:
                if time.monotonic() > reader.end_s and not reader.killed:
                    reader.killed = True
                    reader.popen.kill()
            checker.stopping.wait(0.02)  # lets lines gather
        for reader in running:
            reader.killed = True
            reader.popen.kill()
            reader.finish()


def main() -> None:
    checker = Checker()
    checker.work(partial(churn, checker))
    checker.run()


if __name__ == "__main__":
    main()
