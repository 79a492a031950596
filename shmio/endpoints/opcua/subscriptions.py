"""Subscriptions and their monitored items, with limits.

They replace the subscriptions of asyncua, where each item keeps a copy of each value, and clients
can use each other's subscriptions. Here, a value is encoded once for all clients. An item with a
queue of length one stores no value: it sends the newest value when its subscription publishes.
"""

from __future__ import annotations

import asyncio
import logging
import math
import struct
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Final

from asyncua import ua
from asyncua.common.utils import ServiceError
from asyncua.ua.ua_binary import struct_to_binary

from shmio.endpoints.opcua.feed import Watch

MIN_PUBLISHING_MS: Final = 20.0
MAX_PUBLISHING_MS: Final = 60_000.0
MAX_KEEP_ALIVE: Final = 3_000
MAX_LIFETIME: Final = 9_000
MAX_SUBSCRIPTIONS: Final = 200
MAX_SUBSCRIPTIONS_PER_SESSION: Final = 20
MAX_ITEMS: Final = 200_000
MAX_ITEMS_PER_SESSION: Final = 50_000
MAX_QUEUE: Final = 100
"""Maximum length of an item's queue."""
MAX_QUEUED_BYTES: Final = 4 << 20
"""Size of a subscription's queues, in bytes, above which each item keeps only its newest value."""
MAX_MESSAGE_BYTES: Final = 1 << 20
"""Size in bytes at which a message is complete. Further values go into the next message."""
MAX_UNACKNOWLEDGED: Final = 8
"""Maximum number of unacknowledged messages that a subscription keeps."""
MAX_UNACKNOWLEDGED_BYTES: Final = 4 << 20
MAX_NOTIFICATIONS: Final = 10_000
"""Maximum number of values in a message."""

_OVERFLOW: Final = 0x00000480
"""Info bits that mean an overflow of a DataValue (OPC 10000-4, section 7.39)."""
_HANDLE: Final = struct.Struct("<I")
_DATA_CHANGE: Final = ua.NodeId(ua.ObjectIds.DataChangeNotification_Encoding_DefaultBinary)
_NO_DIAGNOSTICS: Final = struct.pack("<i", -1)

log = logging.getLogger("shmio.opcua")

Fault = ua.StatusCodes


class Item:
    """A monitored item: a variable that a client monitors, with the values to send."""

    __slots__ = (
        "_at_s", "_deadband", "_sampling_s", "_sent", "_status_only", "_subscription", "every", "handle", "id",
        "mode", "queue", "queues", "size", "watch",
    )  # fmt: skip

    def __init__(
        self, subscription: Subscription, number: int, watch: Watch, handle: int, mode: ua.MonitoringMode
    ) -> None:
        self._subscription, self.id, self.watch, self.handle, self.mode = subscription, number, watch, handle, mode
        self.size = 1
        self.queues = self.every = self._status_only = False
        self.queue: deque[bytes] = deque()
        self._deadband = self._sampling_s = self._at_s = 0.0
        self._sent: ua.DataValue | None = None

    def revise(self, asked: ua.MonitoringParameters, slowest_ms: float, fastest_ms: float) -> tuple[float, int]:
        """Apply the parameters that the client requests, within the limits.

        Args:
            asked: The requested parameters.
            slowest_ms: The publishing interval, in ms. It replaces a requested sampling interval of
                -1.
            fastest_ms: The shortest sampling interval, in ms: the source's period.

        Returns:
            The revised sampling interval in ms, and the revised length of the queue.

        Raises:
            ServiceError: The filter is not supported.

        """
        self._filter(asked.Filter)
        interval_ms = asked.SamplingInterval
        if not math.isfinite(interval_ms) or interval_ms < 0:
            interval_ms = slowest_ms
        interval_ms = min(max(interval_ms, fastest_ms), 3_600_000.0)
        self.handle = asked.ClientHandle
        self.size = min(max(asked.QueueSize, 1), MAX_QUEUE)
        self._sampling_s = interval_ms / 1e3 if interval_ms > fastest_ms else 0.0
        self.queues = self.size > 1
        while len(self.queue) > self.size:
            self._drop()
        return interval_ms, self.size

    def _filter(self, asked: Any) -> None:
        self.every = self._status_only = False
        self._deadband = 0.0
        if asked is None or (isinstance(asked, ua.ExtensionObject) and asked.Body is None):
            return
        if not isinstance(asked, ua.DataChangeFilter):
            raise ServiceError(Fault.BadMonitoredItemFilterUnsupported)
        if asked.DeadbandType not in (ua.DeadbandType.None_, ua.DeadbandType.Absolute):
            raise ServiceError(Fault.BadMonitoredItemFilterUnsupported)  # percents need a range, which no register has
        if asked.DeadbandType == ua.DeadbandType.Absolute:
            if not (math.isfinite(asked.DeadbandValue) and asked.DeadbandValue >= 0):
                raise ServiceError(Fault.BadDeadbandFilterInvalid)
            value = self.watch.value.Value
            if value is not None and value.VariantType in _TEXTS:
                raise ServiceError(Fault.BadFilterNotAllowed)
            self._deadband = asked.DeadbandValue
        self.every = asked.Trigger == ua.DataChangeTrigger.StatusValueTimestamp
        self._status_only = asked.Trigger == ua.DataChangeTrigger.Status

    def changed(self) -> None:
        """Handle a change of the variable: queue the value to be sent, if it passes the filter."""
        if self.mode == ua.MonitoringMode.Disabled:
            return
        if (self._deadband or self._status_only) and not self._matters():
            return
        if self.size > 1:
            self._keep()
        if self.mode == ua.MonitoringMode.Reporting:
            self._subscription.mark(self)

    def _matters(self) -> bool:
        """Return whether the present value passes the filter. If so, remember it for the next comparison."""
        old, new = self._sent, self.watch.value
        status = old is None or old.StatusCode != new.StatusCode
        if not status and self._status_only:
            return False
        if not status and old is not None and not _apart(old, new, self._deadband):
            return False
        self._sent = new
        return True

    def _keep(self) -> None:
        now_s = time.monotonic()
        if self.queue and now_s - self._at_s < self._sampling_s:
            self._subscription.queued_bytes -= len(
                self.queue.pop()
            )  # within a sampling interval, only the newest value counts
        else:
            self._at_s = now_s
        full = self._subscription.queued_bytes > MAX_QUEUED_BYTES
        while len(self.queue) >= self.size or (full and self.queue):
            self._drop()
        self.queue.append(self.watch.encoded)
        self._subscription.queued_bytes += len(self.queue[-1])

    def _drop(self) -> None:
        """Drop the oldest value, and mark the next one with an overflow."""
        self._subscription.queued_bytes -= len(self.queue.popleft())
        if self.queue:
            old = self.queue[0]
            self.queue[0] = overflowed(old)
            self._subscription.queued_bytes += len(self.queue[0]) - len(old)

    def take(self) -> Iterator[bytes]:
        """Remove the values to send from the queue, and yield them encoded."""
        if self.size == 1:
            yield self.watch.encoded
            return
        while self.queue:
            value = self.queue.popleft()
            self._subscription.queued_bytes -= len(value)
            yield value

    def clear(self) -> None:
        """Discard the waiting values."""
        self._subscription.queued_bytes -= sum(map(len, self.queue))
        self.queue.clear()
        self._subscription.dirty.pop(self, None)


_TEXTS: Final = (ua.VariantType.String, ua.VariantType.LocalizedText, ua.VariantType.ExtensionObject)


def overflowed(encoded: bytes) -> bytes:
    """Return an encoded value with the overflow bits set in its status."""
    from asyncua.common.utils import Buffer  # noqa: PLC0415
    from asyncua.ua.ua_binary import struct_from_binary  # noqa: PLC0415

    value = struct_from_binary(ua.DataValue, Buffer(encoded))
    value.StatusCode = ua.StatusCode((value.StatusCode.value if value.StatusCode else 0) | _OVERFLOW)
    return struct_to_binary(value)


def _apart(old: ua.DataValue, new: ua.DataValue, deadband: float) -> bool:
    before = None if old.Value is None else old.Value.Value
    after = None if new.Value is None else new.Value.Value
    pairs = list(zip(_flat(before), _flat(after), strict=False))
    if not pairs or not all(isinstance(a, int | float) and isinstance(b, int | float) for a, b in pairs):
        return bool(before != after)
    return any(not abs(b - a) <= deadband for a, b in pairs)


def _flat(value: Any) -> Iterator[Any]:
    if isinstance(value, list):
        for one in value:
            yield from _flat(one)
    else:
        yield value


class Subscription:
    """A client's subscription. It publishes the changes of its items at a fixed interval."""

    def __init__(
        self, number: int, owner: Any, asked: ua.CreateSubscriptionParameters, on_end: Callable[[], Any]
    ) -> None:
        self.id, self.owner = number, owner
        self.session_id = owner.session_id
        self.items: dict[int, Item] = {}
        self.dirty: dict[Item, None] = {}
        """Items with something to send, in the order in which they changed."""
        self.queued_bytes = 0
        self.enabled = bool(asked.PublishingEnabled)
        self.can_send: Callable[[], bool] = lambda: True
        self.pub_result_callback: Any
        self.pub_request_callback: Callable[[int], Any]
        self._on_end = on_end
        self._sequence = 1
        self._kept: dict[int, tuple[ua.NotificationMessage, int]] = {}
        self._next_item = 1
        self._silent = 0
        self._idle_intervals = 0
        self._first = True
        self._timer: asyncio.TimerHandle | None = None
        self._due_s = 0.0
        self._idle = False
        """True if the last interval ended without changes: the next change is published at once."""
        self.revise(asked)

    def revise(self, asked: Any) -> None:
        """Apply the parameters that the client requests, within the limits."""
        interval = asked.RequestedPublishingInterval
        interval = interval if math.isfinite(interval) else MAX_PUBLISHING_MS
        self.interval_ms = min(max(interval, MIN_PUBLISHING_MS), MAX_PUBLISHING_MS)
        self.keep_alive = min(asked.RequestedMaxKeepAliveCount or MAX_KEEP_ALIVE, MAX_KEEP_ALIVE)
        self.lifetime = min(max(asked.RequestedLifetimeCount or MAX_LIFETIME, 3 * self.keep_alive), MAX_LIFETIME)
        self.most = min(asked.MaxNotificationsPerPublish or MAX_NOTIFICATIONS, MAX_NOTIFICATIONS)
        if self._timer is not None:  # the new interval starts now, even if the old one was long
            self._timer.cancel()
            self._due_s = asyncio.get_running_loop().time()
            self._schedule()

    # ---- publishing --------------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Start to publish."""
        self._due_s = asyncio.get_running_loop().time()
        self._schedule()

    def _schedule(self) -> None:
        loop = asyncio.get_running_loop()
        # After a delay, intervals are skipped: they would only repeat what the next one sends.
        self._due_s = max(self._due_s + self.interval_ms / 1e3, loop.time())
        self._timer = loop.call_at(self._due_s, self._tick)

    def _tick(self) -> None:
        self._schedule()
        self._silent += 1
        self._idle_intervals += 1
        if self._idle_intervals > self.lifetime:
            log.info("a subscription has ended: its client sent no request for %d intervals", self.lifetime)
            self.stop()
            self._on_end()
            return
        self._publish()
        self._idle = not self.dirty

    def mark(self, item: Item) -> None:
        """Record that an item has values to send. If the last interval had no changes, publish them at once.

        If a source changes its values as often as the subscription publishes, some changes come
        just after the end of an interval. If these waited for the next end, newer values would
        replace them.
        """
        self.dirty[item] = None
        if self._idle:
            self._idle = False
            asyncio.get_running_loop().call_soon(self._publish_early)  # after all changes of the frame are marked

    def _publish_early(self) -> None:
        if self._timer is None:
            return
        self._timer.cancel()
        self._due_s = asyncio.get_running_loop().time()
        self._schedule()
        self._publish()

    def _publish(self) -> None:
        while self._wants() and self.can_send() and (request := self.pub_request_callback(self.id)) is not None:
            self._send(request)

    def _wants(self) -> bool:
        return self._first or (self.enabled and bool(self.dirty)) or self._silent >= self.keep_alive

    async def publish_results(self, request: Any) -> bool:
        """Answer a Publish request at once, if a publication is waiting for one.

        Returns:
            True if a publication was waiting.
        """
        self._idle_intervals = 0
        if not self._wants():
            return False
        self._send(request)
        return True

    def reset_lifetime(self) -> None:
        """Count the intervals without a Publish request from 0 again, because the client has sent one."""
        self._idle_intervals = 0

    def _send(self, request: Any) -> None:
        result = ua.PublishResult()
        result.SubscriptionId = self.id
        message = result.NotificationMessage
        message.SequenceNumber = self._sequence
        self._first, self._silent, self._idle_intervals = False, 0, 0
        if self.enabled and self.dirty:
            body = self._pop()
            message.NotificationData = [ua.ExtensionObject(_DATA_CHANGE, body)]
            self._sequence = self._sequence % 0xFFFFFFFF + 1
            self._keep(message, len(body))
        result.MoreNotifications = bool(self.dirty) and self.enabled
        result.AvailableSequenceNumbers = list(self._kept)
        self.owner.sent(result, request, self)

    def _pop(self) -> bytes:
        """Return the body of a notification with the waiting values."""
        parts, count, size = [b""], 0, 0
        while self.dirty and count < self.most and size < MAX_MESSAGE_BYTES:
            item = next(iter(self.dirty))
            del self.dirty[item]
            handle = _HANDLE.pack(item.handle)
            for value in item.take():
                parts += (handle, value)
                size += 4 + len(value)
                count += 1
        parts[0] = struct.pack("<i", count)
        parts.append(_NO_DIAGNOSTICS)
        return b"".join(parts)

    def _keep(self, message: ua.NotificationMessage, size: int) -> None:
        self._kept[message.SequenceNumber] = message, size
        while len(self._kept) > MAX_UNACKNOWLEDGED or (
            len(self._kept) > 1 and sum(one for _, one in self._kept.values()) > MAX_UNACKNOWLEDGED_BYTES
        ):
            del self._kept[next(iter(self._kept))]

    def acknowledge(self, number: int) -> int:
        """Discard a message that the client has acknowledged. Return the status of the acknowledgement."""
        return Fault.Good if self._kept.pop(number, None) else Fault.BadSequenceNumberUnknown

    def republish(self, number: int) -> ua.NotificationMessage:
        """Return an unacknowledged message.

        Raises:
            ServiceError: The subscription does not have this message any more.
        """
        if number not in self._kept:
            raise ServiceError(Fault.BadMessageNotAvailable)
        return self._kept[number][0]

    def stop(self) -> None:
        """End the subscription, and stop monitoring its items."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        for number in list(self.items):
            self.remove(number)

    # ---- items -------------------------------------------------------------------------------------------------------

    def add(
        self, watch: Watch, asked: ua.MonitoredItemCreateRequest, fastest_ms: float
    ) -> ua.MonitoredItemCreateResult:
        """Start to monitor a variable.

        Args:
            watch: The watch of the variable.
            asked: The request.
            fastest_ms: The shortest sampling interval, in ms.

        Raises:
            ServiceError: The filter is not supported.
        """
        mode = ua.MonitoringMode(asked.MonitoringMode)
        item = Item(self, self._next_item, watch, asked.RequestedParameters.ClientHandle, mode)
        interval_ms, size = item.revise(asked.RequestedParameters, self.interval_ms, fastest_ms)
        self._next_item += 1
        self.items[item.id] = item
        watch.add(item)
        item.changed()  # the first notification has the present value
        return ua.MonitoredItemCreateResult(ua.StatusCode(), item.id, interval_ms, size)

    def modify(self, asked: ua.MonitoredItemModifyRequest, fastest_ms: float) -> ua.MonitoredItemModifyResult:
        """Change the parameters of an item.

        Args:
            asked: The request.
            fastest_ms: The shortest sampling interval, in ms.

        Raises:
            ServiceError: The item does not exist, or its filter is not supported.
        """
        item = self._item(asked.MonitoredItemId)
        interval_ms, size = item.revise(asked.RequestedParameters, self.interval_ms, fastest_ms)
        item.watch.feed.count()
        return ua.MonitoredItemModifyResult(ua.StatusCode(), interval_ms, size)

    def set_mode(self, number: int, mode: ua.MonitoringMode) -> None:
        """Change the monitoring mode of an item.

        Raises:
            ServiceError: The item does not exist.
        """
        item = self._item(number)
        before, item.mode = item.mode, mode
        if mode == ua.MonitoringMode.Disabled:
            item.clear()
        elif before == ua.MonitoringMode.Disabled:
            item.changed()
        elif mode == ua.MonitoringMode.Reporting and item.queue:
            self.mark(item)
        elif mode == ua.MonitoringMode.Sampling:
            self.dirty.pop(item, None)

    def remove(self, number: int) -> None:
        """Remove an item.

        Raises:
            ServiceError: The item does not exist.
        """
        item = self._item(number)
        item.clear()
        item.watch.remove(item)
        del self.items[number]

    def _item(self, number: int) -> Item:
        item = self.items.get(number)
        if item is None:
            raise ServiceError(Fault.BadMonitoredItemIdInvalid)
        return item


class Subscriptions:
    """The subscriptions of all sessions. Use it only in the event loop's thread."""

    def __init__(self) -> None:
        self.subscriptions: dict[int, Subscription] = {}
        self._next = 1

    @property
    def items(self) -> int:
        """Number of monitored items of all subscriptions."""
        return sum(len(one.items) for one in self.subscriptions.values())

    def of(self, owner: Any) -> list[Subscription]:
        """Return the subscriptions of a session."""
        return [one for one in self.subscriptions.values() if one.owner is owner]

    def find(self, number: int, owner: Any) -> Subscription:
        """Return the subscription of a session with this number.

        Raises:
            ServiceError: The session has no such subscription.
        """
        found = self.subscriptions.get(number)
        if found is None or found.owner is not owner:
            raise ServiceError(Fault.BadSubscriptionIdInvalid)
        return found

    def create(self, owner: Any, asked: ua.CreateSubscriptionParameters) -> Subscription:
        """Create a subscription for a session, without starting it.

        Raises:
            ServiceError: There are too many subscriptions.
        """
        if len(self.subscriptions) >= MAX_SUBSCRIPTIONS or len(self.of(owner)) >= MAX_SUBSCRIPTIONS_PER_SESSION:
            raise ServiceError(Fault.BadTooManySubscriptions)
        number, self._next = self._next, self._next + 1
        found = Subscription(number, owner, asked, lambda: self.subscriptions.pop(number, None))
        self.subscriptions[number] = found
        return found

    def delete(self, found: Iterable[Subscription]) -> None:
        """End these subscriptions."""
        for one in list(found):
            one.stop()
            self.subscriptions.pop(one.id, None)

    def room(self, owner: Any) -> int:
        """Return how many more items a session may monitor."""
        own = sum(len(one.items) for one in self.of(owner))
        return max(0, min(MAX_ITEMS_PER_SESSION - own, MAX_ITEMS - self.items))
