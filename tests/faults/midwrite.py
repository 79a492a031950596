"""Kills a writer in the middle of a slot: one that publishes large frames as fast as it can.

``python -m tests.faults.midwrite INSTANCE`` is this writer.
"""

from __future__ import annotations

import random
import subprocess
import sys
import threading
from typing import Final

import numpy as np

from shmio.layout.model import Layout, Register
from shmio.segment import BlockSpec, Cursor, Frame, ProcessSpec, Segment
from tests.faults.checks import Complain
from tests.faults.deface import torn

SIZE: Final = 1 << 18
LAYOUT: Final = Layout("DB1", 1, SIZE, False, (Register("data", "BYTE", ((0, SIZE - 1),), 0, None, SIZE, SIZE),))
TURN_S: Final = 0.05


class MidWrite:
    """A separate segment whose writer is killed repeatedly. A context manager."""

    def __init__(self, instance: str, environment: dict[str, str], complain: Complain) -> None:
        self._environment = environment
        self._complain = complain
        block = BlockSpec("torn", LAYOUT, 1_000_000, 10**12, 1)
        self._segment = Segment.create(instance, [block], [ProcessSpec("torn", "source")])
        self._block = self._segment.blocks["torn"]
        self._cursor = self._block.cursor()
        self._last = 0
        self.frames = self.missed = self.kills = self.torn = 0

    def __enter__(self) -> MidWrite:
        return self

    def __exit__(self, *_: object) -> None:
        self._segment.unlink()
        self._segment.close()

    def strike(self, number: int) -> None:
        """Start a writer, read its frames, kill it, and check what is left.

        ``number`` determines the time of the kill.
        """
        command = [sys.executable, "-P", "-m", "tests.faults.midwrite", self._segment.instance]
        stopping = threading.Event()
        reader = threading.Thread(target=self._read, args=(stopping,))
        with subprocess.Popen(command, stdout=subprocess.PIPE, env=self._environment) as publisher:
            assert publisher.stdout is not None
            publisher.stdout.readline()
            reader.start()
            stopping.wait(random.Random(number).uniform(0.01, 0.1))
            publisher.kill()
        stopping.set()
        reader.join()
        self.kills += 1
        self.torn += torn(self._segment.memory, "torn")
        newest = self._block.latest()
        if newest is None or newest.number != self._block.ring.head():
            self._complain(f"after a writer's death the newest frame is {newest and newest.number}")

    def _read(self, stopping: threading.Event) -> None:
        """Check each frame and the newest frame until ``stopping`` is set."""
        missed = self._cursor.missed
        while not stopping.is_set():
            frame = self._cursor.next(TURN_S)
            if frame is not None:
                self._check(frame, self._cursor, missed)
                missed = self._cursor.missed
            newest = self._block.latest()
            if newest is not None and not whole(newest):
                self._complain(f"the newest frame {newest.number} is mixed")

    def _check(self, frame: Frame, cursor: Cursor[Frame], missed: int) -> None:
        lost = cursor.missed - missed
        if frame.number != self._last + 1 + lost:
            self._complain(f"frame {frame.number} comes after {self._last} with {lost} missed")
        if not whole(frame):
            self._complain(f"frame {frame.number} is mixed")
        self._last = frame.number
        self.frames += 1
        self.missed += lost


def whole(frame: Frame) -> bool:
    """Return whether each word of a frame is its number, as the writer writes them."""
    return bool((np.frombuffer(frame.raw, np.uint64) == frame.number).all())


def publish(instance: str) -> None:
    """Publish large frames as fast as possible, until the process is killed."""
    with Segment.open(instance, writable=True) as segment:
        writer = segment.writer("torn")
        print("ready", flush=True)
        number = segment.blocks["torn"].ring.head()
        while True:
            number += 1
            writer.publish(np.full(SIZE // 8, number, np.uint64).data, cycle=number)


if __name__ == "__main__":
    publish(sys.argv[1])
