"""Follows one source's block: keeps the newest frame, and notifies the watches of variables that have changed."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any, Final, Protocol

from asyncua import ua
from asyncua.ua.ua_binary import struct_to_binary

from shmio.endpoints.opcua import values
from shmio.endpoints.opcua.commands import CommandClient
from shmio.layout.model import Register
from shmio.model.statuses import status_area
from shmio.segment import Block, Frame, FrameFollower, Quality, QualityChange
from shmio.segment.changed_registers import ChangeScan, entries
from shmio.segment.doorbell import TURN_NS

log = logging.getLogger("shmio.opcua")

MAX_FRAMES_PER_TURN: Final = 8
"""Maximum number of frames that are read in one go, before the endpoint does other work."""
MAX_ENCODED: Final = 20_000
"""Maximum number of encoded values that are kept until the next frame."""
CATCH_UP_S: Final = 3.0
"""If the endpoint is further behind than this time in s, or half of the ring, it skips to the newest frame."""


class Listener(Protocol):
    """A monitored item, which a watch notifies of changes."""

    every: bool
    """True if the item also reports frames in which only the time has changed."""
    queues: bool
    """True if the item queues several values, not only the newest."""

    def changed(self) -> None:
        """Handle a change of the variable. No other change is reported until the item is armed again."""


class Readable(Protocol):
    """A variable, or a part of its value."""

    def value(self) -> ua.DataValue:
        """Return the present value."""

    def encoded(self) -> bytes:
        """Return the present value, encoded."""


class Changes:
    """The changes of one register, and the watches of its value, its elements and its parts.

    A change costs nothing for watches whose items have not sent their last value yet.
    """

    __slots__ = ("armed", "count", "watches")

    def __init__(self) -> None:
        self.count = 0
        self.watches: dict[str, Watch] = {}
        self.armed: dict[Watch, None] = {}
        """The watches with items that wait for a change."""

    def changed(self) -> None:
        """Handle a change of the register: notify the watches."""
        self.count += 1
        if self.armed:
            armed, self.armed = self.armed, {}
            for watch in armed:
                watch.notify()


class Watch:
    """Tracks the changes of one variable, for all clients that monitor it.

    A value is encoded once for all clients, when the first of them needs it.
    """

    __slots__ = ("_armed", "_at", "_encoded", "_source", "changes", "feed", "gone", "index_range", "key", "listeners")

    def __init__(
        self, feed: Feed, key: str, source: Readable, changes: Changes | None = None, index_range: str = ""
    ) -> None:
        self.feed, self.key, self.index_range = feed, key, index_range
        self.changes = Changes() if changes is None else changes
        self.gone = False
        """True if the variable no longer exists."""
        self.listeners: dict[Listener, None] = {}
        self._armed: dict[Listener, None] = {}
        self._source = source
        self._encoded = b""
        self._at = -1
        """The number of changes before ``_encoded``."""

    def add(self, listener: Listener) -> None:
        """Add a listener, which is not armed yet."""
        self.listeners[listener] = None
        self.feed.count()

    def arm(self, listener: Listener) -> None:
        """Notify a listener of the next change."""
        self._armed[listener] = None
        self.changes.armed[self] = None
        if listener.every:
            self.feed.timed[listener] = self

    def awaits(self, listener: Listener) -> bool:
        """Return whether a listener is armed: whether no change has come since then."""
        return listener in self._armed

    def remove(self, listener: Listener) -> None:
        """Remove a listener. The watch ends when its last listener is removed."""
        self.listeners.pop(listener, None)
        self._armed.pop(listener, None)
        self.feed.timed.pop(listener, None)
        if not self.listeners:
            self.changes.armed.pop(self, None)
            self.feed.release(self)
        self.feed.count()

    def renew(self, source: Readable | None) -> None:
        """Replace the variable, after a reload. ``source`` is None if the variable no longer exists."""
        self.gone = source is None
        self._source = _UNKNOWN if source is None else source
        self._at = -1
        self.changed()

    def changed(self) -> None:
        """Handle a change of this variable alone."""
        self.changes.count += 1
        self.changes.armed.pop(self, None)
        self.notify()

    def notify(self) -> None:
        """Notify the armed listeners."""
        armed, self._armed = self._armed, {}
        for listener in armed:
            if listener.every:
                self.feed.timed.pop(listener, None)
            listener.changed()

    def notify_of_time(self, listener: Listener) -> None:
        """Notify a listener of a frame in which perhaps only the time has changed."""
        self.changes.count += 1
        if self._armed.pop(listener, self) is None:
            listener.changed()

    def fetch(self) -> bytes:
        """Compute the present value anew, without the cache, and return it encoded."""
        return self._source.encoded()

    @property
    def value(self) -> ua.DataValue:
        """The present value."""
        return self._source.value()

    @property
    def encoded(self) -> bytes:
        """The present value, encoded. It is cached until it changes."""
        if self._at != self.changes.count:
            self._encoded = self._source.encoded()
            self._at = self.changes.count
        return self._encoded


class _Unknown:
    """The variable that a reload has removed."""

    def value(self) -> ua.DataValue:
        """Return the status of a node that does not exist."""
        return ua.DataValue(StatusCode=ua.StatusCode(ua.StatusCodes.BadNodeIdUnknown))

    def encoded(self) -> bytes:
        """Return the status, encoded."""
        return struct_to_binary(self.value())


_UNKNOWN: Final = _Unknown()


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
        self._by_register: dict[int, Changes] = {}
        self._details: dict[str, Watch] = {}
        self._shown: dict[str, bytes] = {}
        self._injected: Sequence[Any] = ()
        self._injection_sequence = -1
        self._shown_sequence = -1
        """Sequence number of the list of injections at the last frame."""
        self._counted = True
        self._patient = True
        """True if all clients need only the newest values."""
        self.timed: dict[Listener, Watch] = {}
        """The armed items that also report frames in which only the time has changed."""
        self._encoded: dict[str, bytes] = {}
        """The encoded values of the newest frame that clients have read, by path."""
        self._about: tuple[object, ...] = ()
        """All that properties depend on, at the last frame."""

    @property
    def watches(self) -> list[Watch]:
        """All watches of this source."""
        registers = (one for found in self._by_register.values() for one in found.watches.values())
        return [*registers, *self._details.values()]

    # ---- values ------------------------------------------------------------------------------------------------------

    def data_value(self, register: Register) -> ua.DataValue:
        """Return the present state of a register, an element or a part, as a value for OPC UA."""
        state = values.register_state(self.follower, register, self.injected())
        frame = self.follower.frame
        return ua.DataValue(
            None if state.value is None else values.variant(register, state.value),
            ua.StatusCode(state.code),
            values.moment(state.source_ns) if state.source_ns else None,
            values.moment(frame.source_ns) if frame is not None and frame.source_ns else None,
        )

    def encoded(self, register: Register) -> bytes:
        """Return what :meth:`data_value` returns, encoded. It is encoded once for all that read it."""
        found = self._encoded.get(register.path)
        if found is None:
            state = values.register_state(self.follower, register, self.injected())
            frame = self.follower.frame
            found = values.encode(register, state, 0 if frame is None else frame.source_ns)
            if len(self._encoded) < MAX_ENCODED:
                self._encoded[register.path] = found
        return found

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

    def watch(self, path: str, source: Readable, index_range: str = "") -> Watch:
        """Return the watch of a register, an element or a part. Create it if there is none yet.

        Args:
            path: Path of the register, element or part.
            source: The variable, for a new watch.
            index_range: The part of the value that ``source`` returns; "" for all of it.
        """
        changes = self._by_register.setdefault(self._register_of(path), Changes())
        name = path + "?" + index_range
        if name not in changes.watches:
            key = f"{self.block.source}/{path}"
            changes.watches[name] = Watch(self, key, source, changes, index_range)
        return changes.watches[name]

    def watch_detail(self, key: str, source: Readable) -> Watch:
        """Return the watch of a property. Create it if there is none yet.

        After each frame, the feed checks whether the property has changed.

        Args:
            key: Identifies the property.
            source: The property, for a new watch.
        """
        if key not in self._details:
            self._details[key] = Watch(self, key, source)
            self._shown[key] = self._details[key].encoded
        return self._details[key]

    def adopt(self, watch: Watch, path: str | None, source: Readable | None) -> None:
        """Take over a watch after a reload, usually from the feed that this feed replaces.

        Args:
            watch: The watch.
            path: Path of the register that it watches; None if it watches a property.
            source: The variable; None if it no longer exists.

        """
        watch.feed, watch.changes = self, Changes()
        self.count()
        if source is not None:
            if path is None:
                self._details[watch.key] = watch
            else:
                watch.changes = self._by_register.setdefault(self._register_of(path), Changes())
                watch.changes.watches[path + "?" + watch.index_range] = watch
        watch.renew(source)
        if source is not None and path is None:
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
            index, name = self._register_of(path), path + "?" + watch.index_range
            if watch.changes.watches.get(name) is watch:
                del watch.changes.watches[name]
                if not watch.changes.watches and self._by_register.get(index) is watch.changes:
                    del self._by_register[index]

    def count(self) -> None:
        """Handle the addition or removal of listeners."""
        self._counted = False

    def _count(self) -> None:
        self._counted = True
        self._patient = not any(one.queues or one.every for watch in self.watches for one in watch.listeners)

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
        self._encoded.clear()
        if other or old is None or change is not QualityChange.NONE:
            self._mark_everything()
            return
        if follower.quality is not Quality.BAD and self._by_register:
            for index in self._scan.changed(old.image, frame.image):
                if (changes := self._by_register.get(index)) is not None:
                    changes.changed()
            if self.timed:
                timed, self.timed = self.timed, {}
                for listener, watch in timed.items():
                    watch.notify_of_time(listener)
        about = (frame.provenance, follower.quality, follower.reason)
        if self._details and about != self._about:
            self._about = about
            self._mark_details()

    def _mark_everything(self) -> None:
        self._encoded.clear()
        for changes in tuple(self._by_register.values()):
            changes.changed()
        self._mark_details()

    def _mark_details(self) -> None:
        for key, watch in tuple(self._details.items()):
            new = watch.fetch()
            if new != self._shown[key]:
                self._shown[key] = new
                watch.changed()


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
