"""The connector mtconnect: its keys of ``[[source]]``, and how an agent's stream becomes images."""

from __future__ import annotations

import logging
import threading
import time
from collections import defaultdict
from typing import Annotated, Final
from urllib.parse import urlsplit

import msgspec

from shmio.connectors.base import Connector
from shmio.connectors.browsing import Browsed, Wanted
from shmio.connectors.register_image import RegisterImage, no_status_area
from shmio.connectors.request_count import CycleRequests
from shmio.errors import ConnectorError
from shmio.layout.model import Layout
from shmio.model.statuses import BAD_WAITING_FOR_INITIAL_DATA
from shmio.wording import counted
from shmio_mtconnect.browse import offers
from shmio_mtconnect.documents import DataItem, DevicesDocument, Streams, StreamsDocument
from shmio_mtconnect.http import Exchange
from shmio_mtconnect.values import Target, find, parse

MAX_REPORTED: Final = 20
"""Most registers without a data item that a connection names in the log."""
CLOSE_S: Final = 2.0

log = logging.getLogger("shmio.source")


class MTConnectOptions(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """The connector's own keys of ``[[source]]``.

    Raises:
        ValueError: The URL is invalid.

    """

    url: Annotated[str, msgspec.Meta(min_length=8, max_length=1000)]
    """``http://HOST:PORT`` of the agent. If a path follows, it precedes the path of each request."""
    timeout: Annotated[int, msgspec.Meta(ge=1, le=600_000)] = 2000
    """Time-out in ms for each document, and for a late heartbeat."""
    interval: Annotated[int, msgspec.Meta(ge=1, le=60_000)] = 100
    """Shortest time in ms between two documents of the stream."""
    heartbeat: Annotated[int, msgspec.Meta(ge=1, le=600_000)] = 1000
    """Longest time in ms between two documents of the stream."""
    count: Annotated[int, msgspec.Meta(ge=1, le=100_000)] = 1000
    """Most observations in one document. The agent may refuse a number larger than its buffer."""

    def __post_init__(self) -> None:
        try:
            parts = urlsplit(self.url)
            valid = parts.scheme in ("http", "https") and bool(parts.hostname) and (parts.port or 1) > 0
        except ValueError:
            valid = False
        if not valid or not self.url.isascii() or not self.url.isprintable() or " " in self.url:
            raise ValueError(f"url: {self.url[:80]!r} is not the address of an agent, such as http://192.168.0.20:5000")
        if parts.query or parts.fragment or parts.username is not None:
            raise ValueError("url: remove the user and everything from ? or # on; expected http://HOST:PORT/PATH")


class MTConnectConnector(Connector):
    """Follows the stream of an agent, and gives the present state as the image of each cycle."""

    Options = MTConnectOptions
    register_quality = True

    @classmethod
    def browse(cls, options: MTConnectOptions, wanted: Wanted) -> Browsed:
        """List the data items of the agent's devices.

        Raises:
            ConnectorError: The agent cannot be reached, or the peer is not an agent.

        """
        return offers(_probe(options), wanted)

    def __init__(self, options: MTConnectOptions, layout: Layout) -> None:
        self._options, self._layout = options, layout
        self._addresses = [parse(register) for register in layout.registers]
        self._image = RegisterImage(layout) if layout.status_offset is not None else None
        self._lock = threading.Lock()  # of the image, and of the state of the stream below
        self._follower: _Follower | None = None

    @property
    def timeout_s(self) -> float:
        """Longest time in s that a method blocks: a connection makes three requests and finds data items."""
        return 5 * self._options.timeout / 1000 + CLOSE_S

    @property
    def doubt(self) -> str:
        """The reason why values are uncertain: the stream is behind the agent. Empty if they are not."""
        behind = self._follower.behind if self._follower is not None else 0
        if behind <= self._options.count:
            return ""
        return f"the stream is {behind} observations behind the agent; raise count, or reduce interval"

    def describe(self) -> str:
        """Return the peer and how it is read, for the log."""
        known = len(self._follower.targets) if self._follower is not None else 0
        return f"to {self._options.url}, {known} data items"

    def cycle_requests(self) -> CycleRequests:
        """Return what the agent sends. There are no repeated requests, because the agent sends a stream."""
        note = f"the agent sends what has changed, at most every {self._options.interval} ms"
        return CycleRequests(counted(len(self._addresses), "data item"), note=note)

    def connect(self) -> None:
        """Ask for the device model and the present state, and open the stream that continues it.

        Raises:
            ConnectorError: The agent cannot be reached, or the peer is not an agent.

        """
        self.close()
        if self._image is None:
            raise no_status_area()
        for index in range(len(self._addresses)):
            self._image.fail(index, BAD_WAITING_FOR_INITIAL_DATA)
        self._follower = _Follower(self._options, self._image, self._lock, self._targets(self._image))
        self._follower.start()

    def read(self) -> bytes:
        """Return the present state, if the stream is certainly alive.

        Raises:
            ConnectorError: The stream is lost, or its heartbeat is missing.

        """
        if self._follower is None or self._image is None:
            raise ConnectorError(f"not connected to {self._options.url}")
        with self._lock:
            self._follower.check()
            return bytes(self._image)

    def close(self) -> None:
        """Close the stream. It may be called at any time and more than once."""
        if self._follower is not None:
            self._follower.close()
            self._follower = None

    def _targets(self, image: RegisterImage) -> dict[str, list[Target]]:
        """Ask for the device model. Return the registers of each data item."""
        items = _probe(self._options)
        deadline = time.monotonic() + self._options.timeout / 1000
        by_name: dict[str, list[DataItem]] = defaultdict(list)
        for one in items:
            for name in one.names[-1]:
                by_name[name].append(one)
        found: dict[str, list[Target]] = defaultdict(list)
        missing = 0
        for index, (register, address) in enumerate(zip(self._layout.registers, self._addresses, strict=True)):
            if time.monotonic() > deadline:
                raise ConnectorError(
                    f"finding the data items takes longer than {self._options.timeout} ms; "
                    "use dataItemIds as addresses, or raise timeout"
                )
            item, code, why = find(address, by_name.get(address.parts[-1], []))
            if item is not None:
                found[item.id].append(Target(index, register, address, item))
                continue
            image.fail(index, code)
            missing += 1
            if missing <= MAX_REPORTED:
                log.warning("%s: %s", register.path, why)
        if missing > MAX_REPORTED:
            log.warning("%d more registers have no data item: shmio get shows all", missing - MAX_REPORTED)
        return dict(found)


def _probe(options: MTConnectOptions) -> list[DataItem]:
    """Ask the agent for its device model; return its data items."""
    devices = DevicesDocument()
    exchange = Exchange(options.url, options.timeout)
    try:
        exchange.document("probe", devices)
    finally:
        exchange.close()
    return devices.items


class _Follower:
    """Follows the stream of one connection in a thread. The thread ends after an error."""

    def __init__(
        self, options: MTConnectOptions, image: RegisterImage, lock: threading.Lock, targets: dict[str, list[Target]]
    ) -> None:
        self._options, self._image, self._lock, self.targets = options, image, lock, targets
        self._stream = Exchange(options.url, options.timeout)
        self._thread: threading.Thread | None = None
        self._instance = ""
        self._next = 0
        self._error = ""
        self._heard_ns = 0
        self.behind = 0
        """Number of observations that the agent had not sent yet when it sent the last document."""

    def start(self) -> None:
        """Read the whole state, and open the stream that continues it. Raise ConnectorError if that fails."""
        current = StreamsDocument(self.targets)
        exchange = Exchange(self._options.url, self._options.timeout)
        try:
            exchange.document("current", current)
        finally:
            exchange.close()
        self._instance, self._next = current.streams.instance_id, current.streams.next_sequence
        with self._lock:
            self._store(current.streams, whole=True)
        options = self._options
        request = f"sample?from={self._next}&interval={options.interval}&count={options.count}"
        with self._stream.answer_within():
            self._stream.begin(f"{request}&heartbeat={options.heartbeat}")
        self._stream.keep_waiting((options.heartbeat + options.interval + options.timeout) / 1000)
        self._heard_ns = time.monotonic_ns()
        self._thread = threading.Thread(target=self._follow, name="mtconnect", daemon=True)
        self._thread.start()

    def check(self) -> None:
        """Raise ConnectorError unless the last document is recent. The caller holds the lock."""
        if self._error:
            raise ConnectorError(self._error)
        limit_ms = self._options.heartbeat + self._options.interval + self._options.timeout
        if time.monotonic_ns() - self._heard_ns > limit_ms * 1_000_000:
            raise ConnectorError(f"no answer from {self._stream.peer} within {limit_ms} ms: the heartbeat is missing")

    def close(self) -> None:
        """Close the stream, and wait for the thread."""
        self._stream.close()
        if self._thread is not None:
            self._thread.join(CLOSE_S)

    def _follow(self) -> None:
        try:
            for part in self._stream.parts():
                document = StreamsDocument(self.targets)
                document.feed(part)
                document.finish()
                self._take(document.streams)
        except ConnectorError as error:
            self._error = str(error)
        except Exception as error:
            log.exception("the thread of the stream has failed")
            self._error = f"the thread of the stream has failed: {error}"

    def _take(self, streams: Streams) -> None:
        if streams.instance_id != self._instance:
            raise ConnectorError(f"{self._stream.peer} has restarted: its instanceId is {streams.instance_id!r} now")
        if streams.next_sequence < self._next:
            raise ConnectorError(
                f"{self._stream.peer} went back from observation {self._next} to {streams.next_sequence}"
            )
        with self._lock:
            self._store(streams, whole=False)
            self._next = streams.next_sequence
            self.behind = max(0, streams.last_sequence + 1 - streams.next_sequence)
            self._heard_ns = time.monotonic_ns()

    def _store(self, streams: Streams, *, whole: bool) -> None:
        for observation in streams.observations:
            for target in self.targets[observation.item]:
                target.put(self._image, observation, whole=whole)
