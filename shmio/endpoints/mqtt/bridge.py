"""The bridge: runs the feeds, the outbox, the connections and the commands in one thread."""

from __future__ import annotations

import logging
import os
import selectors
import time
from collections.abc import Callable, Container, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Final

import msgspec
from paho.mqtt.client import MQTTMessage

from shmio.config import Mqtt
from shmio.endpoints.mqtt.broker.directory import own_socket
from shmio.endpoints.mqtt.commands import (
    OUTPUTS,
    CommandClient,
    CommandReceiver,
    command_filters,
    output_filters,
    result_filters,
)
from shmio.endpoints.mqtt.connection.connection import MOST_IN_FLIGHT, BrokerConnection, CommandConnection, is_watched
from shmio.endpoints.mqtt.connection.reconnect import ReconnectPolicy, targets
from shmio.endpoints.mqtt.feed import Feed
from shmio.endpoints.mqtt.outbox import Outbox
from shmio.endpoints.mqtt.steps import StepDelivery
from shmio.endpoints.mqtt.topic_guard import MOST_WAITING, TopicGuard
from shmio.endpoints.mqtt.topics import BridgeStatusChannel, Channel, ClearedTopic, Message, TopicRules, status
from shmio.layout.topic import shorten
from shmio.segment import Block, ProcessSlot, Quality, Segment
from shmio.segment.doorbell import TURN_NS, Relay

if TYPE_CHECKING:
    from shmio.endpoints.mqtt.sparkplug.device import Device
    from shmio.endpoints.mqtt.sparkplug.session import Session

OFFLINE: Final = b"offline"
STOPPED: Final = "the bridge was stopped"
LEAVE_S: Final = 2.0
"""Time in s that the broker has to accept the last messages when the bridge closes."""
TURN_S: Final = 0.2
MAX_CLEARED: Final = 20_000
"""Maximum number of topics whose old retained messages the bridge deletes at the broker."""

log = logging.getLogger("shmio.mqtt")


class Bridge:
    """Connects an instance to a broker.

    Use it from one thread: call :meth:`run_once` repeatedly, then :meth:`close`.
    """

    def __init__(self, segment: Segment, slot: ProcessSlot, settings: Mqtt) -> None:
        """Create the feeds and the connections.

        Args:
            segment: The instance's shared memory.
            slot: This process's entry in the process table.
            settings: The configuration's ``[mqtt]`` section.

        Raises:
            PathError: The pattern of a rule is not valid.

        """
        self.prefix = settings.prefix or f"shmio/{segment.instance}"
        self._segment = segment
        self._writer = slot.writer or 0
        self._rules = TopicRules(settings.topic)
        self._selector = selectors.DefaultSelector()
        self._wakeup = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        self._selector.register(self._wakeup, selectors.EVENT_READ, lambda _: os.eventfd_read(self._wakeup))
        client_id = settings.client_id or f"shmio-{segment.instance}"
        self._status = BridgeStatusChannel(f"{self.prefix}/status")
        self._channels: dict[str, Channel] = {self._status.topic: self._status}
        """The channels of all topics that are published now, by topic."""
        self._guard = TopicGuard(self)
        self._feeds: dict[str, Feed] = {}
        self._clients: dict[str, CommandClient] = {}
        self._relays: dict[int, Relay] = {}
        self._cleared: dict[str, ClearedTopic] = {}
        there = targets(settings, own_socket(segment))
        # The broker has no messages to keep for this connection, so it needs no session.
        clean = msgspec.structs.replace(settings, session_expiry_s=0)
        self.connection = BrokerConnection(
            ReconnectPolicy(clean, client_id, there),
            self._selector,
            self.wake,
            lambda: Message(self._status.topic, OFFLINE, 1, True),
            MOST_IN_FLIGHT,
        )
        self.command_connection = CommandConnection(
            settings,
            f"{client_id}-commands",
            self._selector,
            self.wake,
            lambda: command_filters(self.prefix, self._clients.values()),
            lambda: result_filters(self.prefix, self._clients.values()),
        )
        self.outbox = Outbox(self.connection, self.command_connection.connection, round(settings.backlog_mb * 1e6))
        self._commands = CommandReceiver(
            self.prefix,
            self._rules,
            self._clients,
            self.outbox.queue_result,
            lambda: str(self.command_connection.connection.at),
        )
        self.command_connection.connection.on_message = self._on_command
        self.connection.on_message = self._on_message
        self.connection.on_lost = self.outbox.lose
        # When clients see that we are online, they may send commands at once.
        self.connection.is_ready = lambda: self.command_connection.ready
        self._recalled: frozenset[str] | None = None
        """The topics in use when the bridge asked for the broker's retained messages; None: it has not asked yet."""
        self._behind: set[Feed] = set()
        self._rest_s = 0.0
        """Maximum time for which :meth:`run_once` may wait for events, in s."""
        self._missed = 0
        """Number of frames that feeds had missed before they were removed."""
        self._generation = -1
        self._reader = ThreadPoolExecutor(1, "reader")
        self._sparkplug: Session | None = None
        if settings.sparkplug is not None:
            from shmio.endpoints.mqtt.sparkplug.session import Session  # noqa: PLC0415  loads numpy and protobuf

            self._sparkplug = Session(settings, settings.sparkplug, segment, self._selector, self.wake)
        self._reading: Future[list[tuple[Feed, Device | None]]] | None = None
        self._add_feeds(self._read(()))
        self.steps = StepDelivery(segment.clock, slot.index, f"{self.prefix}/simlog/step", self.connection, self.outbox)
        self._step_relay = Relay(segment.clock.slot_bell(slot.index), "bell-steps", TURN_NS)
        self._selector.register(
            self._step_relay.descriptor, selectors.EVENT_READ, lambda _: self._step_relay.acknowledge()
        )

    @property
    def counters(self) -> tuple[int, ...]:
        """The counters, in the order in which the process table names them."""
        commands, outbox = self._commands, self.outbox
        refused = (
            commands.refused + self.connection.problems.refused + self.command_connection.connection.problems.refused
        )
        own = (
            outbox.sent, commands.received, refused, outbox.waiting, outbox.backlog, outbox.dropped,
            self.connection.connects, self._missed + sum(feed.missed for feed in self._feeds.values()),
            self.connection.sent_bytes + self.command_connection.connection.sent_bytes,
        )  # fmt: skip
        return own if self._sparkplug is None else tuple(map(sum, zip(own, self._sparkplug.counters, strict=True)))

    @property
    def readers(self) -> Iterator[tuple[Block, int]]:
        """The blocks whose frames the bridge reads now, each with the number of the last frame read."""
        for feed in self._feeds.values():
            if not feed.step_driven:
                yield feed.block, feed.follower.last
        if self._sparkplug is not None:
            yield from self._sparkplug.readers

    @property
    def problem(self) -> str:
        """The current problem; empty if there is none."""
        problem = self.connection.problem
        if problem and self.outbox.backlog:
            lost = f", {self.outbox.dropped} dropped" if self.outbox.dropped else ""
            return f"{problem}; {self.outbox.backlog} changes are kept{lost}"
        return (
            problem or self.command_connection.problem or ("" if self._sparkplug is None else self._sparkplug.problem)
        )

    def wake(self) -> None:
        """Wake :meth:`run_once`. You may call this from any thread."""
        os.eventfd_write(self._wakeup, 1)

    # ---- the loop ----------------------------------------------------------------------------------------------------

    def run_once(self) -> None:
        """Wait up to ``TURN_S`` for events, and handle them."""
        for key, events in self._selector.select(self._rest_s):
            key.data(events)
        self._turn_connections()
        self._follow_reloads()
        self._behind.update(self.steps.poll(self._feeds.values()))
        for feed in list(self._behind):
            self._poll(feed)
        due_s = [TURN_S, *self._mark_due()]
        self.outbox.flush()
        due_s.append(self._turn_connections())
        due_s.append(self._guard.run_once())
        if self._sparkplug is not None:
            due_s.append(self._sparkplug.run_once())
        self._rest_s = 0.0 if self._behind or self.outbox.can_send else min(due_s)

    def _mark_due(self) -> Iterator[float]:
        """Mark the changes that a rate limit no longer delays.

        Yields, for each source, the time in s until the next rate limit ends.
        """
        for feed in self._feeds.values():
            due_ns = None if feed.step_driven else feed.mark_due()
            if due_ns is not None:
                yield max(0.0, (due_ns - feed.block.now_ns()) / 1e9)

    def _turn_connections(self) -> float:
        """Run both connections. Return the time in s after which to run them again."""
        connection = self.connection
        rest_s = min(self.command_connection.run_once(connection.at), connection.run_once())
        if connection.problem and not connection.up:
            self.outbox.keeping = True
        if connection.came_up:
            connection.came_up = False
            self.outbox.keeping = True
            self._publish_all()
        return rest_s

    def _publish_all(self) -> None:
        """Publish that the bridge is online, and the current state of every topic.

        Before this state, the outbox sends the changes that it kept during an outage.
        """
        self.connection.send(self._status.message())
        if self._recalled is None:
            self._recalled = frozenset(self._channels)
            self.connection.recall(output_filters(self.prefix, self._clients.values()))
        self._guard.begin()
        for feed in self._feeds.values():
            feed.resend()
        self.outbox.resend(self._cleared.values())

    # ---- other clients that publish on our topics --------------------------------------------------------------------

    def watch(self) -> None:
        """Subscribe to the bridge's own topics, to notice what other clients publish on them."""
        self.connection.watch(self._own)
        self.command_connection.watch()

    def unwatch(self) -> None:
        """Unsubscribe from the bridge's own topics."""
        self.connection.unwatch(self._own)
        self.command_connection.unwatch()

    @property
    def _own(self) -> list[str]:
        statuses = (feed.status.topic for feed in self._feeds.values())
        states = [self._status.topic, f"{self.prefix}/simlog/step", *statuses]
        return [*states, *output_filters(self.prefix, self._clients.values())]

    def correct(self, topic: str) -> None:
        """Publish the bridge's value on a topic again, or delete the message that another client left there."""
        remedy = "let no other account publish there, and no other bridge use this prefix"
        if (channel := self._channels.get(topic)) is not None:
            log.warning(
                "another client published on %s, so the bridge publishes its own value again; %s",
                shorten(topic),
                remedy,
            )
            self.outbox.mark(channel)
        elif self.outbox.waiting < MOST_WAITING:
            log.warning(
                "another client left a message on %s, so the bridge deletes that message; %s", shorten(topic), remedy
            )
            self.outbox.mark(ClearedTopic(topic))

    def correct_all(self) -> None:
        """Publish the present state of all topics again."""
        self.outbox.mark(self._status)
        for feed in self._feeds.values():
            feed.resend()

    def _on_message(self, message: MQTTMessage) -> None:
        if is_watched(message):
            self._check_forged(message)
        else:
            self._clear_old(message)

    def _on_command(self, message: MQTTMessage) -> None:
        if is_watched(message):
            self._check_forged(message)
        else:
            self._commands.take(message)

    def _check_forged(self, message: MQTTMessage) -> None:
        with suppress(UnicodeDecodeError):
            channel = self._channels.get(message.topic)
            if channel is None:
                wrong = bool(message.retain and message.payload)
            else:  # bridged brokers may return our own messages
                wrong = channel.message().payload != message.payload
            if wrong:
                self._guard.report(message.topic)

    def _clear_old(self, message: MQTTMessage) -> None:
        """Delete a retained value of an earlier bridge on a topic that this bridge does not use."""
        if not (message.retain and message.payload and self._recalled is not None) or len(self._cleared) >= MAX_CLEARED:
            return
        with suppress(UnicodeDecodeError):
            topic = message.topic
            if topic.startswith(f"{self.prefix}/") and topic.endswith(OUTPUTS) and topic not in self._recalled:
                self._cleared[topic] = ClearedTopic(topic)
                self.outbox.mark(self._cleared[topic])

    def _poll(self, feed: Feed) -> None:
        self._behind.discard(feed)
        if feed.poll():
            self._behind.add(feed)
        feed.command_client.poll()

    def _wake_feed(self, feed: Feed, relay: Relay, _events: int) -> None:
        relay.acknowledge()
        self._behind.add(feed)

    # ---- sources that come and go ------------------------------------------------------------------------------------

    def _follow_reloads(self) -> None:
        """Add and remove sources after a reload.

        A thread reads their layouts, because that may take seconds.
        """
        if self._reading is not None and self._reading.done():
            reading, self._reading = self._reading, None
            self._add_feeds(reading.result())
            self.command_connection.subscribe()
            if self.connection.up:
                self._publish_all()
        for feed in [feed for feed in self._feeds.values() if feed.ended]:
            self._remove_feed(feed)
        if self._reading is None and self._segment.generation != self._generation:
            self._reading = self._reader.submit(self._read, self._known)
            self._reading.add_done_callback(lambda _: self.wake())

    @property
    def _known(self) -> set[int]:
        """The sections of the blocks that have a feed."""
        return {feed.block.section for feed in self._feeds.values()}

    def _read(self, known: Container[int]) -> list[tuple[Feed, Device | None]]:
        self._generation = self._segment.generation  # first, so that the next turn notices a change during the read
        self._segment.refresh()
        feeds = [
            Feed(block, self._rules, self.prefix, self.outbox, self._writer)
            for block in self._segment.blocks.values()
            if block.section not in known
        ]
        return [(feed, None if self._sparkplug is None else self._sparkplug.new_device(feed)) for feed in feeds]

    def _add_feeds(self, read: Iterable[tuple[Feed, Device | None]]) -> None:
        for feed, device in read:
            if (before := self._feeds.get(feed.block.source)) is not None:
                self._remove_feed(before, feed)
            self._feeds[feed.block.source] = feed
            self._clients[feed.block.source] = feed.command_client
            for channel in feed.all():
                self._channels[channel.topic] = channel
                self._cleared.pop(channel.topic, None)
            if device is not None and self._sparkplug is not None:
                self._sparkplug.add_device(device)
            block = feed.block
            relay = Relay(block.ring, f"bell-{block.source}", min(TURN_NS, block.stale_ns))
            self._relays[block.section] = relay
            self._selector.register(relay.descriptor, selectors.EVENT_READ, partial(self._wake_feed, feed, relay))

    def _remove_feed(self, feed: Feed, successor: Feed | None = None) -> None:
        """Remove a feed. Delete its retained messages on topics that its successor does not use."""
        feed.command_client.poll()
        self._behind.discard(feed)
        stay = set() if successor is None else {channel.topic for channel in successor.all()}
        self.outbox.forget(feed.all())
        for channel in feed.all():
            self._channels.pop(channel.topic, None)
        cleared = {channel.topic: ClearedTopic(channel.topic) for channel in feed.all() if channel.topic not in stay}
        self._cleared |= cleared  # deleted again after each connect, because the broker may be away now
        self.outbox.mark_all(cleared.values())
        del self._feeds[feed.block.source], self._clients[feed.block.source]
        self._missed += feed.missed
        if self._sparkplug is not None:
            self._sparkplug.remove_device(feed.block.source)
        relay = self._relays.pop(feed.block.section)
        self._selector.unregister(relay.descriptor)
        relay.stop()

    # ---- the end -----------------------------------------------------------------------------------------------------

    def close(self) -> None:
        """Send the waiting messages, publish that the bridge is offline, and disconnect."""
        self.steps.close()
        until_s = time.monotonic() + LEAVE_S
        self._drain(until_s, lambda: not self.outbox.busy)
        last = [status(feed.status.topic, Quality.BAD, STOPPED, feed.missed) for feed in self._feeds.values()]
        for message in [*last, Message(self._status.topic, OFFLINE, 1, True)]:
            self._drain(until_s, lambda: self.connection.room > 0)  # a broker may end the connection at too many
            self.connection.send(message)
        self.connection.push()
        self._drain(until_s, lambda: not (self.connection.in_flight or self.command_connection.connection.in_flight))
        self.command_connection.connection.close()
        self.connection.close()
        if self._sparkplug is not None:
            self._sparkplug.close()
        for relay in (*self._relays.values(), self._step_relay):
            self._selector.unregister(relay.descriptor)
            relay.stop()
        for relay in (*self._relays.values(), self._step_relay):
            relay.join()
        self._reader.shutdown()
        self._selector.close()
        os.close(self._wakeup)

    def _drain(self, until_s: float, done: Callable[[], bool]) -> None:
        while self.connection.up and not done() and (rest_s := until_s - time.monotonic()) > 0:
            for key, events in self._selector.select(min(rest_s, TURN_S)):
                key.data(events)
            self.outbox.flush()
            self.command_connection.run_once(self.connection.at)
            self.connection.run_once()
