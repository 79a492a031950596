"""A program that moves time: ``python -m tests.faults.stepper INSTANCE GRPC WAY SEED``.

It steps, attached or through the endpoint, checks the result of each step, and prints a JSON line
for each. It ends when its standard input ends.
"""

from __future__ import annotations

import json
import random
import sys
import threading
import time
from typing import Final

import shmio
from shmio.client import Client, Target
from shmio.errors import NotRunningError, RemoteError, SegmentError, ShmioError
from shmio.local.attach import Attachment
from shmio.local.reading import View
from shmio.segment import Block
from tests.faults.step_checks import PARTICIPANTS, Answer, StepCheck

WAYS: Final = ("local", "shmio")
PAUSE_S: Final = 0.05
DTS_MS: Final = (1, 20, 50)


class Stepper:
    """Moves the time of an instance, also after each restart of the instance."""

    def __init__(self, instance: str, grpc: str, way: str, seed: int) -> None:
        self._instance, self._grpc, self._way = instance, grpc, way
        self._chance = random.Random(seed)
        self._check = StepCheck(lambda problem: say(violation=problem))
        self.stopping = threading.Event()

    def run(self) -> None:
        """Step until ``stopping`` is set."""
        while not self.stopping.wait(PAUSE_S):
            try:
                with shmio.attach(self._instance, writable=self._way == "local") as cell:
                    self._attached(cell)
            except (NotRunningError, SegmentError):  # not running, incomplete or stopped: try again
                continue
            except ShmioError as error:  # the death of the last owner is not known yet, or the endpoint is gone
                say(refused=str(error))

    def _attached(self, cell: Attachment) -> None:
        remote = Client(Target(self._grpc)) if self._way == "shmio" else None
        try:
            # This takes control of time after any step that is under way.
            remote.pause() if remote else cell.pause()
            while cell.current and not self.stopping.is_set():
                self._step(cell, remote)
                self.stopping.wait(self._chance.choice((0.0, 0.0, 0.002, 0.02)))
        finally:
            if remote is not None:
                remote.close()

    def _step(self, cell: Attachment, remote: Client | None) -> None:
        dt_ms = self._chance.choice(DTS_MS)
        before, begun_ns = cell.clock, time.monotonic_ns()
        try:
            number = (remote or cell).step(dt_ms / 1000).step
        except RemoteError as error:  # it is unknown whether the step was done
            self._check.unclear(before, dt_ms * 10**6, cell.clock)
            raise SegmentError(str(error)) from None
        except ShmioError as error:
            if not cell.current:
                return
            after = cell.clock
            self._check.failed(before, str(error), dt_ms * 10**6, after)
            say(failed=str(error), epoch=_epoch(cell), undone=0 if after.done == after.step else after.step)
            return
        after = cell.clock
        answers = {name: answer for name in PARTICIPANTS if (answer := _answer(cell.block(name), number))}
        self._check.done(before, number, dt_ms * 10**6, after, answers)
        say(step=number, begun_ns=begun_ns, epoch=_epoch(cell))


def _epoch(cell: Attachment) -> str:
    """Return the epoch, which identifies a run of the instance, as in recordings."""
    return f"{cell._segment.header.epoch:016x}"


def _answer(block: Block, number: int) -> Answer | None:
    """Return the first frame for a step.

    Later frames with the same cycle come from a restarted process, or from one that stopped.
    """
    found = None
    for at in range(block.ring.head(), 0, -1):
        frame = block.read(at)
        if frame is None or frame.cycle < number:
            break
        found = frame if frame.cycle == number else found
    if found is None:
        return None
    view = View(block, found)
    names = {register.path for register in block.layout.registers}
    values: dict[str, object] = {name: view[name] for name in ("at_s", "count", "seen") if name in names}
    return Answer(found.cycle, found.clock_ns, found.quality, values)


def say(**message: object) -> None:
    """Print a message as a JSON line."""
    print(json.dumps(message), flush=True)


def main() -> None:
    instance, grpc, way, seed = sys.argv[1:]
    stepper = Stepper(instance, grpc, way, int(seed))

    def wait() -> None:
        sys.stdin.read()
        stepper.stopping.set()

    threading.Thread(target=wait, daemon=True).start()
    stepper.run()


if __name__ == "__main__":
    main()
