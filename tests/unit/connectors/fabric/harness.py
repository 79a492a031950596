"""A mirror's process, run in threads, and the fabric's side of its link."""

from __future__ import annotations

import os
import struct
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from typing import Any, cast

from shmio.connectors.fabric.link import Link
from shmio.connectors.fabric.loop import MirrorLoop
from shmio.connectors.fabric.order import Announced, Missing
from shmio.connectors.fabric.source import Mirror
from shmio.connectors.injection_layers import Owner
from shmio.connectors.models.stepped import PageClock
from shmio.fabric.messages import (
    CommandReply,
    CommandRequest,
    Entry,
    Header,
    SourceState,
    encode,
    encode_state,
    with_age,
)
from shmio.layout.model import Layout, Register
from shmio.segment import (
    Attributes,
    BlockSpec,
    Event,
    EventKind,
    Frame,
    ProcessSpec,
    Provenance,
    Quality,
    Segment,
)

LAYOUT = Layout(
    "DB1", 1, 4, False, (Register("count", "INT", (), 0, None, 2, 1), Register("other", "INT", (), 2, None, 2, 1))
)
MS = 1_000_000
S = 1_000 * MS
STALE_NS = 1500 * MS
PATIENCE_S = 20.0
STREAM = 11


def frame(number: int, count: int, **told: Any) -> Frame:
    values: dict[str, Any] = {"quality": Quality.GOOD, "provenance": Provenance.SIMULATED, "reason": ""} | told
    return Frame(
        number, 1000 + number, 0, number, 5 * S + number, 3, values["quality"], values["provenance"], 0, 250,
        values["reason"], struct.pack(">HH", count, 0), values.get("effective"),
    )  # fmt: skip


class FakeLink:
    """The fabric's side of a mirror."""

    def __init__(self, received: Callable[[bytes], None], answered: Callable[[Missing | Announced], None]) -> None:
        self.send, self.answered = received, answered
        self.problem = ""
        self.host = "near.example"
        self.requests: list[Missing] = []
        self.asked = threading.Event()
        self.commands: list[CommandRequest] = []
        self.all: list[CommandRequest] = []
        self.reply = CommandReply([], [])
        self.sent = threading.Semaphore(0)
        self.silent = self.stalled = False
        self.number = self.states = 0
        self.states_asked = threading.Event()

    @property
    def connected(self) -> bool:
        return not self.problem

    def start(self) -> None:
        """Be connected from the start."""

    def close(self) -> None:
        """Hold nothing."""

    def request(self, missing: Missing) -> None:
        self.requests.append(missing)
        self.asked.set()

    def request_state(self) -> None:
        self.states += 1
        self.states_asked.set()

    def command(self, request: CommandRequest, timeout_s: float) -> Future[CommandReply]:
        assert timeout_s > 0
        self.commands.append(request)
        self.all.append(request)
        self.sent.release()
        future: Future[CommandReply] = Future()
        if not self.silent:
            future.set_result(self.reply)
        return future

    def state(self, state: SourceState) -> bytes:
        """Return the next message of the stream, with a state."""
        self.number += 1
        return bytes(encode_state(Header(0, STREAM, self.number, LAYOUT.hash[:8], time.time_ns()), state))

    def message(self, *entries: Entry, skip: int = 0, age_ns: int = 0, left_out: int = 0, **head: Any) -> bytes:
        """Return the next message of the stream; ``skip`` leaves out numbers before it."""
        self.number += 1 + skip
        values: dict[str, Any] = {"layout": LAYOUT.hash[:8], "stream": STREAM} | head
        made_ns, zero_ns = head.get("made_ns", time.time_ns()), head.get("zero_ns", 0)
        header = Header(left_out, values["stream"], self.number, values["layout"], made_ns, zero_ns=zero_ns)
        return with_age(encode(header, entries), age_ns)


class Mirroring:
    """A mirror's process, run in threads."""

    def __init__(self, segment: Segment, *, own_layout: bool = False) -> None:
        self.segment = segment
        slot = segment.processes.find("cell")
        assert slot.take()
        self.block = segment.blocks["cell"]
        self.cursor, self.events = self.block.cursor(), self.block.events.cursor()
        self.clock = PageClock(segment.clock, slot.index)
        self.gone: set[int] = set()
        """Writers whose processes have ended."""
        self.changes = 0
        self.changed = threading.Event()

        def connect(received: Callable[[bytes], None], answered: Callable[[Missing | Announced], None]) -> Link:
            self.link = FakeLink(received, answered)
            return cast("Link", self.link)

        self.ending = False
        self.loop = MirrorLoop(
            Mirror(Mirror.Options(cell="plant1.line3.a50"), "cell"),
            segment.writer("cell"),
            self.clock,
            connect,
            ("count",),
            owner_of=lambda writer: None if writer in self.gone else Owner(writer, os.getpid()),
            own_layout=own_layout,
            changed=self._changed,
            ending=lambda: self.ending,
        )
        self._threads = [threading.Thread(target=run) for run in (self.loop.run, self.loop.commands.run)]
        for thread in self._threads:
            thread.start()

    def _changed(self) -> None:
        self.changes += 1
        self.changed.set()

    def send(self, *entries: Entry, **more: Any) -> None:
        self.link.send(self.link.message(*entries, **more))

    def next(self) -> Frame:
        found = self.cursor.next(PATIENCE_S)
        assert found is not None, "no frame"
        return found

    def event(self, kind: EventKind) -> Event:
        """Return the next event of a kind."""
        while True:
            found = self.events.next(PATIENCE_S)
            assert found is not None, f"no event {kind}"
            if found.kind == kind:
                return found

    def stop(self) -> None:
        self.clock.stop()
        for thread in self._threads:
            thread.join()


@contextmanager
def running(instance: str, *, own_layout: bool = False) -> Iterator[Mirroring]:
    block = BlockSpec("cell", LAYOUT, 20 * MS, STALE_NS, 1 << 20, Attributes("fabric", ("count",)))
    with Segment.create(instance, [block], [ProcessSpec("cell", "source")]) as segment:
        mirroring = Mirroring(segment, own_layout=own_layout)
        try:
            yield mirroring
        finally:
            mirroring.stop()
            segment.unlink()
