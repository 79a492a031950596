"""Subscriptions and their monitored items, with limits.

They replace the subscriptions of asyncua, where each item keeps a copy of each value, and clients
can use each other's subscriptions. Here, a value is encoded once for all clients. An item with a
queue of length one stores no value: it sends the newest value when its subscription publishes.

The items of a client take at most its share of the endpoint's time (``shares.py``). If it asks for more,
the sampling intervals are revised. If the work takes longer all the same, values are sampled and
published later, and items with a queue of length one skip some.
"""

from __future__ import annotations

import asyncio
import logging
import math
import struct
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from heapq import heappop, heappush
from typing import Any, Final

from asyncua import ua
from asyncua.common.utils import ServiceError
from asyncua.ua.ua_binary import struct_to_binary
from asyncua.ua.uaprotocol_auto import DataChangeFilter  # ua.DataChangeFilter is a subclass, which is never decoded

from shmio.endpoints.opcua.feed import Watch
from shmio.endpoints.opcua.requests import MAX_OWN_ITEMS, MAX_OWN_SUBSCRIPTIONS
from shmio.endpoints.shares import ALL_SHARE, BYTE_S, CLIENT_SHARE, Share, Shares

MIN_PUBLISHING_MS: Final = 20.0
MAX_PUBLISHING_MS: Final = 60_000.0
MAX_KEEP_ALIVE: Final = 3_000
MAX_LIFETIME: Final = 9_000
MAX_SUBSCRIPTIONS: Final = MAX_OWN_SUBSCRIPTIONS
MAX_SUBSCRIPTIONS_PER_SESSION: Final = 20
MAX_ITEMS: Final = 200_000
MAX_ITEMS_PER_SESSION: Final = MAX_OWN_ITEMS
MAX_QUEUE: Final = 100
"""Maximum length of an item's queue."""
MAX_QUEUED_BYTES: Final = 4 << 20
"""Size of a subscription's queues, in bytes, above which each item keeps only its newest value."""
MAX_MESSAGE_BYTES: Final = 1 << 18
"""Size in bytes at which a message is complete. Further values go into the next message."""
MAX_UNACKNOWLEDGED: Final = 32
"""Maximum number of unacknowledged messages that a subscription keeps."""
MAX_UNACKNOWLEDGED_BYTES: Final = 4 << 20
MAX_NOTIFICATIONS: Final = 10_000
"""Maximum number of values in a message."""

ITEM_S: Final = 10e-6
"""Assumed time in s that it takes to sample, encode and send a value."""
FAST_MS: Final = 1_000.0
"""Items with a longer sampling interval than this, in ms, do not count when intervals are revised."""
MAX_SAMPLING_MS: Final = 3_600_000.0

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
        "_deadband", "_due_s", "_sampling_s", "_sent", "_status_only", "_subscription", "_waits", "cost_s", "every",
        "handle", "id", "mode", "queue", "queues", "size", "watch",
    )  # fmt: skip

    def __init__(
        self, subscription: Subscription, number: int, watch: Watch, handle: int, mode: ua.MonitoringMode
    ) -> None:
        self._subscription, self.id, self.watch, self.handle, self.mode = subscription, number, watch, handle, mode
        self.size = 1
        self.queues = self.every = self._status_only = False
        self.queue: deque[bytes] = deque()
        self._deadband = self._sampling_s = self._due_s = 0.0
        self._sent: ua.DataValue | None = None
        self._waits = False
        """True if the variable has changed since the last sample, and the item waits for the next one."""
        self.cost_s = 0.0
        """Assumed time of a sample, in s, if the sampling interval is short; else 0."""

    def revise(
        self, asked: ua.MonitoringParameters, slowest_ms: float, fastest_ms: float, companions: int
    ) -> tuple[float, int]:
        """Apply the parameters that the client requests, within the limits.

        Args:
            asked: The requested parameters.
            slowest_ms: The publishing interval, in ms. It replaces a requested sampling interval of
                -1.
            fastest_ms: The shortest sampling interval, in ms: the source's period.
            companions: The number of items that the same request adds.

        Returns:
            The revised sampling interval in ms, and the revised length of the queue.

        Raises:
            ServiceError: The filter is not supported.

        """
        self._filter(asked.Filter)
        interval_ms = asked.SamplingInterval
        if not math.isfinite(interval_ms) or interval_ms < 0:
            interval_ms = slowest_ms
        cost_s = ITEM_S + BYTE_S * len(self.watch.encoded) if interval_ms < FAST_MS else 0.0
        fair_ms = self._subscription.costs.interval_ms(self._subscription, cost_s - self.cost_s, companions)
        if cost_s:
            interval_ms = max(interval_ms, fair_ms)
        self._subscription.costs.add(self._subscription, cost_s - self.cost_s)
        self.cost_s = cost_s
        interval_ms = min(max(interval_ms, fastest_ms), MAX_SAMPLING_MS)
        self.handle = asked.ClientHandle
        self.size = min(max(asked.QueueSize, 1), MAX_QUEUE)
        self.queues = self.size > 1
        shortest_ms = fastest_ms if self._needs_each_change else max(fastest_ms, slowest_ms)
        self._sampling_s = interval_ms / 1e3 if interval_ms > shortest_ms else 0.0
        while len(self.queue) > self.size:
            self._drop()
        return interval_ms, self.size

    @property
    def _needs_each_change(self) -> bool:
        """True if the item has to see each change, because it queues values or has a filter."""
        return self.size > 1 or bool(self._deadband) or self._status_only

    def _filter(self, asked: Any) -> None:
        self.every = self._status_only = False
        self._deadband = 0.0
        if asked is None or (isinstance(asked, ua.ExtensionObject) and asked.Body is None):
            return
        if not isinstance(asked, DataChangeFilter):
            raise ServiceError(Fault.BadMonitoredItemFilterUnsupported)
        if asked.Trigger not in _TRIGGERS:
            raise ServiceError(Fault.BadMonitoredItemFilterInvalid)
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
        """Handle a change of the variable: sample it now, or when its sampling interval is over."""
        if self.mode == ua.MonitoringMode.Disabled:
            return
        now_s = self._subscription.now_s()
        due_s = self._due_s
        if self._needs_each_change:
            due_s = max(due_s, now_s + self._subscription.share.wait_s)
        if due_s <= now_s:
            self.sample(now_s)
        elif not self._waits:
            self._waits = True
            self._subscription.sample_at(due_s, self)

    def sample(self, now_s: float) -> None:
        """Take the present value, to send it if it passes the filter."""
        self._waits = False
        if self.mode == ua.MonitoringMode.Disabled:
            return
        self._due_s = now_s + self._sampling_s
        if self._needs_each_change:
            with self._subscription.share:
                matters = not (self._deadband or self._status_only) or self._matters()
                if matters and self.size > 1:
                    self._keep()
            self.watch.arm(self)
            if not matters:
                return
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
            if not self._needs_each_change:
                self.watch.arm(self)
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


_TRIGGERS: Final = frozenset(ua.DataChangeTrigger)
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
        self,
        number: int,
        owner: Any,
        asked: ua.CreateSubscriptionParameters,
        on_end: Callable[[], Any],
        costs: Costs | None = None,
    ) -> None:
        self.id, self.owner = number, owner
        self.costs = Costs() if costs is None else costs
        self.share = Share(Shares())
        """The client's share of the endpoint's time, once the subscription is attached to a connection."""
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
        self._next: asyncio.Handle | None = None
        """The call that publishes the next message, if the present interval has more than one."""
        self._samples: list[tuple[float, int, Item]] = []
        """The items that wait for a sample, with the time of it, as a heap."""
        self._sampler: asyncio.TimerHandle | None = None
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
        """Publish a message, and arrange for the next one, so that other clients proceed in between."""
        if self._next is not None or not (self._wants() and self.can_send()):
            return
        if (wait_s := self.share.wait_s) > 0:
            self._next = asyncio.get_running_loop().call_later(wait_s, self._publish_next)
            return
        if (request := self.pub_request_callback(self.id)) is not None:
            self._send(request)
            if self._wants():
                self._next = asyncio.get_running_loop().call_soon(self._publish_next)

    def _publish_next(self) -> None:
        self._next = None
        if self._timer is not None:
            self._publish()

    def now_s(self) -> float:
        """Return the present time on the event loop's clock."""
        return asyncio.get_running_loop().time()

    def sample_at(self, due_s: float, item: Item) -> None:
        """Sample an item at a time."""
        heappush(self._samples, (due_s, item.id, item))
        self._arrange_sample(due_s)

    def _arrange_sample(self, due_s: float) -> None:
        if self._sampler is not None:
            if self._sampler.when() <= due_s:
                return
            self._sampler.cancel()
        self._sampler = asyncio.get_running_loop().call_at(due_s, self._sample)

    def _sample(self) -> None:
        """Sample the items that are due, within the client's share of the time."""
        self._sampler = None
        now_s = self.now_s()
        with self.share:
            while self._samples and self._samples[0][0] <= now_s and not self.share.over:
                _, number, item = heappop(self._samples)
                if self.items.get(number) is item:
                    item.sample(now_s)
        if self._samples:
            self._arrange_sample(max(self._samples[0][0], now_s + self.share.wait_s))

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
        with self.share:
            self._send_within_share(request)

    def _send_within_share(self, request: Any) -> None:
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
        while self.dirty and count < self.most and size < MAX_MESSAGE_BYTES and not (count and self.share.over):
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
        for handle in (self._timer, self._next, self._sampler):
            if handle is not None:
                handle.cancel()
        self._timer = self._next = self._sampler = None
        for number in list(self.items):
            self.remove(number)

    # ---- items -------------------------------------------------------------------------------------------------------

    def add(
        self, watch: Watch, asked: ua.MonitoredItemCreateRequest, fastest_ms: float, companions: int
    ) -> ua.MonitoredItemCreateResult:
        """Start to monitor a variable.

        Args:
            watch: The watch of the variable.
            asked: The request.
            fastest_ms: The shortest sampling interval, in ms.
            companions: The number of items that the same request adds.

        Raises:
            ServiceError: The filter is not supported.
        """
        mode = ua.MonitoringMode(asked.MonitoringMode)
        item = Item(self, self._next_item, watch, asked.RequestedParameters.ClientHandle, mode)
        watch.add(item)
        try:
            interval_ms, size = item.revise(asked.RequestedParameters, self.interval_ms, fastest_ms, companions)
        except ServiceError:
            watch.remove(item)
            raise
        self._next_item += 1
        self.items[item.id] = item
        item.changed()  # the first notification has the present value
        return ua.MonitoredItemCreateResult(ua.StatusCode(), item.id, interval_ms, size)

    def modify(self, asked: ua.MonitoredItemModifyRequest) -> ua.MonitoredItemModifyResult:
        """Change the parameters of an item.

        Args:
            asked: The request.

        Raises:
            ServiceError: The item does not exist, or its filter is not supported.
        """
        item = self._item(asked.MonitoredItemId)
        interval_ms, size = item.revise(asked.RequestedParameters, self.interval_ms, 0.0, 1)
        item.watch.feed.count()
        item.watch.arm(item)
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
        elif mode == ua.MonitoringMode.Reporting and (item.queue or not item.watch.awaits(item)):
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
        self.costs.add(self, -item.cost_s)
        del self.items[number]
        if len(self._samples) > 2 * len(self.items) + 100:  # most are of removed items
            self._samples = sorted(one for one in self._samples if one[2] is self.items.get(one[1]))

    def _item(self, number: int) -> Item:
        item = self.items.get(number)
        if item is None:
            raise ServiceError(Fault.BadMonitoredItemIdInvalid)
        return item


class Costs:
    """The assumed time of a sample of all items with short sampling intervals, of each session and of all."""

    def __init__(self) -> None:
        self._of: dict[Any, float] = {}
        self._all_s = 0.0

    def add(self, subscription: Subscription, cost_s: float) -> None:
        """Add the time of a sample of an item."""
        owner = subscription.owner
        self._of[owner] = self._of.get(owner, 0.0) + cost_s
        self._all_s += cost_s
        if self._of[owner] < ITEM_S / 2:  # the last of them was removed
            del self._of[owner]

    def interval_ms(self, subscription: Subscription, cost_s: float, companions: int) -> float:
        """Return the shortest interval in ms at which samples of all items fit into the shares of the time.

        Args:
            subscription: The subscription with a new item.
            cost_s: The time of a sample of the new item.
            companions: The number of such items in the client's request.
        """
        own_s = max(self._of.get(subscription.owner, 0.0) + cost_s, cost_s * companions)
        all_s = max(self._all_s + cost_s, own_s)
        return max(own_s / CLIENT_SHARE, all_s / ALL_SHARE) * 1e3


class Subscriptions:
    """The subscriptions of all sessions. Use it only in the event loop's thread."""

    def __init__(self) -> None:
        self.subscriptions: dict[int, Subscription] = {}
        self._costs = Costs()
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
        found = Subscription(number, owner, asked, lambda: self.subscriptions.pop(number, None), self._costs)
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
