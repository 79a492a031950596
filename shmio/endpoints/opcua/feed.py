"""Follows one source's block: keeps the newest frame, and notifies the watches of variables that have changed."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Any, Final, Protocol

from asyncua import ua
from asyncua.ua.ua_binary import struct_to_binary

from shmio.endpoints.opcua import values
from shmio.endpoints.opcua.commands import CommandClient
from shmio.layout.model import Register
from shmio.model.statuses import standard, status_area
from shmio.segment import Block, Frame, FrameFollower, Quality, QualityChange
from shmio.segment.changed_registers import ChangeScan, entries
from shmio.segment.doorbell import TURN_NS

log = logging.getLogger("shmio.opcua")

MAX_FRAMES_PER_TURN: Final = 8
"""Maximum number of frames that are read in one go, before the endpoint does other work."""
CATCH_UP_S: Final = 3.0
"""If the endpoint is further behind than this time in s, or half of the ring, it skips to the newest frame."""


class Listener(Protocol):
    """A monitored item, which a watch notifies of changes."""

    every: bool
    """True if the item also reports frames in which only the time has changed."""
    queues: bool
    """True if the item queues several values, not only the newest."""

    def changed(self) -> None:
        """Handle a change of the variable."""


class Watch:
    """Tracks the changes of one variable, for all clients that monitor it.

    A value is encoded once for all clients, when the first of them needs it.
    """

    __slots__ = ("_encoded", "_get", "_value", "feed", "gone", "key", "listeners")

    def __init__(self, feed: Feed, key: str, get: Callable[[], ua.DataValue]) -> None:
        self.feed, self.key = feed, key
        self.gone = False
        """True if the variable no longer exists."""
        self.listeners: dict[Listener, None] = {}
        self._get = get
        self._value: ua.DataValue | None = None
        self._encoded: bytes | None = None

    def add(self, listener: Listener) -> None:
        """Add a listener. From now on, it is notified of changes."""
        self.listeners[listener] = None
        self.feed.count()

    def remove(self, listener: Listener) -> None:
        """Remove a listener. The watch ends when its last listener is removed."""
        self.listeners.pop(listener, None)
        if not self.listeners:
            self.feed.release(self)
        self.feed.count()

    def renew(self, get: Callable[[], ua.DataValue] | None) -> None:
        """Replace the function that returns the value, after a reload.

        ``get`` is None if the variable no longer exists.
        """
        self.gone = get is None
        self._get = _unknown if get is None else get
        self.changed()

    def changed(self) -> None:
        """Handle a change of the value: notify the listeners."""
        self.forget()
        for listener in self.listeners:
            listener.changed()

    def forget(self) -> None:
        """Discard the cached value and its encoding."""
        self._value = self._encoded = None

    def fetch(self) -> bytes:
        """Compute the present value anew, without the cache, and return it encoded."""
        return struct_to_binary(self._get())

    @property
    def value(self) -> ua.DataValue:
        """The present value. It is cached until it changes."""
        if self._value is None:
            self._value = self._get()
        return self._value

    @property
    def encoded(self) -> bytes:
        """The present value, encoded. It is cached until it changes."""
        if self._encoded is None:
            self._encoded = struct_to_binary(self.value)
        return self._encoded


def _unknown() -> ua.DataValue:
    return ua.DataValue(StatusCode=ua.StatusCode(ua.StatusCodes.BadNodeIdUnknown))


class Feed:
    """Follows one source. Once it is created, use it only in the event loop's thread."""

    def __init__(self, block: Block, writer: int, namespace: str) -> None:
        """Create the feed. For a large layout this takes seconds.

        Args:
            block: The block to follow.
            writer: Number of this process's command queue.
            namespace: URI of the instance's namespace.

        """
        self.block, self.namespace = block, namespace
        self.follower = FrameFollower(block, catch_up_s=CATCH_UP_S)
        self.commands = CommandClient(block, writer)
        self.turn_ns = min(TURN_NS, block.stale_ns)
        """Interval in ns at which to poll even without a doorbell, because none rings when a frame becomes stale."""
        self._scan = _scan(block)
        self._index = {register.path: index for index, register in enumerate(block.layout.registers)}
        self._by_register: dict[int, dict[str, Watch]] = {}
        self._details: dict[str, Watch] = {}
        self._shown: dict[str, bytes] = {}
        self._injected: Sequence[Any] = ()
        self._injection_sequence = -1
        self._shown_sequence = -1
        """Sequence number of the list of injections at the last frame."""
        self._counted = True
        self._patient = True
        """True if all clients need only the newest values."""
        self._timed: list[tuple[Watch, Listener]] = []

    @property
    def watches(self) -> list[Watch]:
        """All watches of this source."""
        return [*(one for found in self._by_register.values() for one in found.values()), *self._details.values()]

    # ---- values ------------------------------------------------------------------------------------------------------

    def data_value(self, register: Register) -> ua.DataValue:
        """Return the present state of a register, an element or a part, as a value for OPC UA."""
        state = values.register_state(self.follower, register, self.injected())
        frame = self.follower.frame
        return ua.DataValue(
            None if state.value is None else values.variant(register, state.value),
            ua.StatusCode(standard(state.code)),
            values.moment(state.source_ns) if state.source_ns else None,
            values.moment(frame.source_ns) if frame is not None and frame.source_ns else None,
        )

    def injected(self) -> Sequence[Any]:
        """Return the present injections over ``/out``; none if the newest frame contains no injected value."""
        frame = self.follower.frame
        if frame is None or frame.effective is None:
            return ()
        injections = self.block.injections
        if injections.sequence != self._injection_sequence:
            self._injection_sequence = injections.sequence
            self._injected = [one for one in injections.read() if one.direction == "out"]
        return self._injected

    # ---- watches -----------------------------------------------------------------------------------------------------

    def watch(self, path: str, get: Callable[[], ua.DataValue]) -> Watch:
        """Return the watch of a register, an element or a part. Create it if there is none yet.

        Args:
            path: Path of the register, element or part.
            get: Returns its value, for a new watch.
        """
        index = self._register_of(path)
        found = self._by_register.setdefault(index, {})
        if path not in found:
            found[path] = Watch(self, f"{self.block.source}/{path}", get)
        return found[path]

    def watch_detail(self, key: str, get: Callable[[], ua.DataValue]) -> Watch:
        """Return the watch of a property. Create it if there is none yet.

        After each frame, the feed checks whether the property has changed.

        Args:
            key: Identifies the property.
            get: Returns its value, for a new watch.
        """
        if key not in self._details:
            self._details[key] = Watch(self, key, get)
            self._shown[key] = self._details[key].encoded
        return self._details[key]

    def adopt(self, watch: Watch, path: str | None, get: Callable[[], ua.DataValue] | None) -> None:
        """Take over a watch after a reload, usually from the feed that this feed replaces.

        Args:
            watch: The watch.
            path: Path of the register that it watches; None if it watches a property.
            get: Returns the variable's value; None if the variable no longer exists.

        """
        watch.feed = self
        self.count()
        if get is not None:
            if path is None:
                self._details[watch.key] = watch
            else:
                self._by_register.setdefault(self._register_of(path), {})[path] = watch
        watch.renew(get)
        if get is not None and path is None:
            self._shown[watch.key] = watch.encoded

    def _register_of(self, path: str) -> int:
        """Return the index of the register of a path, which may name an element or a part of the register."""
        while path not in self._index:
            path = path.rpartition("/")[0] if ".%" not in path else path.rpartition(".%")[0]
        return self._index[path]

    def release(self, watch: Watch) -> None:
        """Remove a watch that has no listeners."""
        path = watch.key.removeprefix(f"{self.block.source}/")
        if self._details.get(watch.key) is watch:
            del self._details[watch.key], self._shown[watch.key]
        elif "#" not in path and not watch.gone:
            index = self._register_of(path)
            found = self._by_register.get(index, {})
            if found.get(path) is watch:
                del found[path]
                if not found:
                    del self._by_register[index]

    def count(self) -> None:
        """Handle the addition or removal of listeners."""
        self._counted = False

    def _count(self) -> None:
        self._counted = True
        pairs = [(watch, one) for watch in self.watches for one in watch.listeners]
        self._patient = not any(one.queues or one.every for _, one in pairs)
        self._timed = [(watch, one) for watch, one in pairs if one.every]

    # ---- frames ------------------------------------------------------------------------------------------------------

    def poll(self) -> bool:
        """Read new frames and events. Return whether more are waiting."""
        self.commands.poll()
        if not self._counted:
            self._count()
        follower = self.follower
        if self._patient and follower.behind > 1:
            if (newest := follower.newest()) is not None:
                self._take(newest)
            return False
        for frame in follower.read(MAX_FRAMES_PER_TURN):
            self._take(frame)
        if follower.behind:
            return True
        if follower.became_stale():
            self._mark_everything()
        return False

    def _take(self, frame: Frame) -> None:
        follower = self.follower
        old = follower.frame
        change = follower.take(frame)
        sequence = self.block.injections.sequence
        other = old is None or (old.effective is None) != (frame.effective is None)
        other |= frame.effective is not None and sequence != self._shown_sequence
        self._shown_sequence = sequence
        if other or old is None or change is not QualityChange.NONE:
            self._mark_everything()
            return
        if follower.quality is not Quality.BAD and self._by_register:
            for index in self._scan.changed(old.image, frame.image):
                for watch in tuple(self._by_register.get(index, _NONE).values()):
                    watch.changed()
            for watch, listener in self._timed:
                watch.forget()
                listener.changed()
        if self._details:
            self._mark_details()

    def _mark_everything(self) -> None:
        for found in tuple(self._by_register.values()):
            for watch in tuple(found.values()):
                watch.changed()
        self._mark_details()

    def _mark_details(self) -> None:
        for key, watch in tuple(self._details.items()):
            new = watch.fetch()
            if new != self._shown[key]:
                self._shown[key] = new
                watch.changed()


_NONE: Final[dict[str, Watch]] = {}


def _scan(block: Block) -> ChangeScan:
    """Return a scan that finds changed values, and changed status codes if the block has them."""
    area = status_area(block.layout)
    if area is None:
        return ChangeScan(block.layout.registers)
    parts = []
    for index, register in enumerate(block.layout.registers):
        code = Register("", "DWORD", (), area.code_range(area.index(register))[0], None, 4, 1)
        parts.append(entries([register, code], index))
    return ChangeScan.joined(parts)
