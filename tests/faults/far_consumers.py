"""Consumers on the host of a mirror: a gRPC client, which must see every frame of the owner, and a model."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Sequence
from itertools import groupby
from typing import Any, Final

import shmio
from shmio.layout.topic import find
from shmio.layout.values.codec import codec
from shmio.segment import Block, Frame, Segment

FOLLOWER: Final = '''
from shmio.simulation import Input, Model, Output


class Follower(Model):
    """Passes on what it receives."""

    value = Input("REAL")
    seen = Output("REAL")

    def step(self, time_s, dt_s):
        self.seen = self.value
'''
"""``follower.py``: a model with the input ``value``."""


class FrameWatcher(threading.Thread):
    """Follows all frames of a source of an instance."""

    def __init__(self, cell: Segment, source: str = "cell") -> None:
        super().__init__(daemon=True)
        self.block = cell.blocks[source]
        self._cursor = self.block.cursor()
        self._ends = threading.Event()
        self.frames: list[Frame] = []
        self.start()

    def run(self) -> None:
        """Collect frames until :meth:`stop`."""
        while not self._ends.is_set():
            if (frame := self._cursor.next(0.2)) is not None:
                self.frames.append(frame)

    def stop(self) -> list[Frame]:
        """Return the frames."""
        self._ends.set()
        self.join()
        assert self._cursor.missed == 0, "the test missed frames"
        return self.frames


class GrpcClient(threading.Thread):
    """Receives every frame of a source by shmio.v1."""

    def __init__(self, address: str, source: str) -> None:
        super().__init__(daemon=True)
        self._address, self._source = address, source
        self._ends = threading.Event()
        self.updates: list[Any] = []
        self.start()

    def run(self) -> None:
        """Collect updates until :meth:`stop`."""
        with (
            shmio.connect(self._address) as client,
            client.subscribe(f"{self._source}/**", every_frame=True, frames=True) as updates,
        ):
            for update in updates:
                self.updates.append((update.cycle, update.missed, update.source_ns, update.image))
                if self._ends.is_set():
                    return

    def stop(self) -> list[Any]:
        """Return the updates."""
        self._ends.set()
        self.join()
        return self.updates


def check_client(updates: Sequence[Any], owner: Iterable[Frame]) -> int:
    """Compare what a client has received with the owner's frames; return the number of frames compared."""
    assert not any(missed for _, missed, _, _ in updates[1:]), "the client missed frames"
    sent = {frame.cycle: frame for frame in owner}
    got = [one for one in updates if one[0] in sent]
    first, last = got[0][0], got[-1][0]
    assert [one[0] for one in got] == [cycle for cycle in sent if first <= cycle <= last]
    for cycle, _, source_ns, image in got:
        assert (source_ns, image) == (sent[cycle].source_ns, sent[cycle].image)
    return len(got)


def values(block: Block, path: str, frames: Iterable[Frame]) -> list[Any]:
    """Return the values of a register in frames, without those that equal the one before."""
    register = find(block.layout, path)
    decoder = codec(register, block.layout.byte_order)
    return [value for value, _ in groupby(decoder.decode(frame.image) for frame in frames)]


def check_model(model: Sequence[Any], owner: Sequence[Any]) -> tuple[int, int]:
    """Check that a model has received the owner's values in their order.

    Before each step, a model reads the newest frame. It passes over a frame if the next one comes before its step.

    Returns:
        The number of values that the model has received, and how many of the owner's it has passed over.

    """
    places, at = [], 0
    for value in model:
        at = owner.index(value, at)
        places.append(at)
    return len(places), places[-1] - places[0] + 1 - len(places)
