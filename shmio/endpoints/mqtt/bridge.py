"""The bridge: one thread that turns the feeds, the outbox, the link and the commands."""

from __future__ import annotations

import logging
import os
import selectors
import time
from collections.abc import Callable, Container, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from typing import Final

import msgspec
from paho.mqtt.client import MQTTMessage

from shmio.config import Mqtt
from shmio.endpoints.mqtt.broker.directory import own_socket
from shmio.endpoints.mqtt.channel import Channel, Gone, Message, Presence, status
from shmio.endpoints.mqtt.commands import OUTPUTS, Commands, answers, filters, outputs
from shmio.endpoints.mqtt.connection.command_connection import Intake
from shmio.endpoints.mqtt.connection.connection import Link, is_watched
from shmio.endpoints.mqtt.connection.limits import MOST_IN_FLIGHT
from shmio.endpoints.mqtt.connection.target import Dialling, targets
from shmio.endpoints.mqtt.feed import Feed
from shmio.endpoints.mqtt.outbox import Outbox
from shmio.endpoints.mqtt.rules import Rules
from shmio.endpoints.mqtt.sparkplug.device import Device
from shmio.endpoints.mqtt.sparkplug.session import Session
from shmio.endpoints.mqtt.steps import Steps
from shmio.endpoints.mqtt.topic_guard import MOST_WAITING, Guard
from shmio.layout.topic import shorten
from shmio.segment import ProcessSlot, Quality, Segment
from shmio.segment.relay import TURN_NS, Relay

OFFLINE: Final = b"offline"
STOPPED: Final = "the bridge was stopped"
LEAVE_S: Final = 2.0
"""For the broker to take our leave."""
TURN_S: Final = 0.2
MOST_GONE: Final = 20_000
"""Topics at most that are taken from the broker's memory."""

log = logging.getLogger("shmio.mqtt")


class Bridge:
    """Between a segment and a broker. Use from one thread: :meth:`turn` again and again, then :meth:`close`."""

    def __init__(self, segment: Segment, slot: ProcessSlot, settings: Mqtt) -> None:
        """``slot``: of this process. PathError: a pattern of a rule is none."""
        self.prefix = settings.prefix or f"shmio/{segment.instance}"
        self._segment, self._settings = segment, settings
        self._writer = slot.writer or 0
        self._rules = Rules(settings.topic)
        self._selector = selectors.DefaultSelector()
        self._wakeup = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        self._selector.register(self._wakeup, selectors.EVENT_READ, lambda _: os.eventfd_read(self._wakeup))
        client_id = settings.client_id or f"shmio-{segment.instance}"
        self._presence = Presence(f"{self.prefix}/status")
        self._channels: dict[str, Channel] = {self._presence.topic: self._presence}
        """All that is published now, by topic."""
        self._guard = Guard(self)
        self._feeds: dict[str, Feed] = {}
        self._relays: dict[int, Relay] = {}
        self._gone: dict[str, Gone] = {}
        there = targets(settings, own_socket(segment))
        clean = msgspec.structs.replace(settings, session_expiry_s=0)  # nothing comes that the broker could keep
        self.link = Link(
            Dialling(clean, client_id, there),
            self._selector,
            self.wake,
            lambda: Message(self._presence.topic, OFFLINE, 1, True),
            MOST_IN_FLIGHT,
        )
        self.intake = Intake(
            settings,
            f"{client_id}-commands",
            self._selector,
            self.wake,
            lambda: filters(self.prefix, self._feeds.values()),
            lambda: answers(self.prefix, self._feeds.values()),
        )
        self.outbox = Outbox(self.link, self.intake.link, round(settings.backlog_mb * 1e6))
        self._commands = Commands(self.prefix, self._rules, self._feeds, self.outbox.answer)
        self.intake.link.on_message = self._command
        self.link.on_message = self._hear
        self.link.on_lost = self.outbox.lose
        self.link.admit = lambda: self.intake.settled  # who is told that we are there may send commands at once
        self._recalled: frozenset[str] | None = None
        """Our topics when the broker was asked what it has of one before us; None: it was not."""
        self._more: set[Feed] = set()
        self._rest_s = 0.0
        """So long there is nothing to do but what comes."""
        self._missed = 0
        """Frames of sources that have gone."""
        self._generation = -1
        self._reader = ThreadPoolExecutor(1, "reader")
        self._sparkplug: Session | None = None
        if settings.sparkplug is not None:
            self._sparkplug = Session(settings, settings.sparkplug, segment, self._selector, self.wake)
        self._reading: Future[list[tuple[Feed, Device | None]]] | None = None
        self._adopt(self._read(()))
        self.steps = Steps(segment.clock, slot.index, f"{self.prefix}/simlog/step", self.link, self.outbox)
        self._bell = Relay(segment.clock.slot_bell(slot.index), "bell-steps", TURN_NS)
        self._selector.register(self._bell.descriptor, selectors.EVENT_READ, lambda _: self._bell.heard())

    @property
    def counters(self) -> tuple[int, ...]:
        """As the process table names them."""
        commands, outbox = self._commands, self.outbox
        refused = commands.refused + self.link.complaints.refused + self.intake.link.complaints.refused
        own = (
            outbox.sent, commands.received, refused, outbox.waiting, outbox.backlog, outbox.dropped, self.link.connects,
            self._missed + sum(feed.missed for feed in self._feeds.values()),
        )  # fmt: skip
        return own if self._sparkplug is None else tuple(map(sum, zip(own, self._sparkplug.counters, strict=True)))

    @property
    def problem(self) -> str:
        """What is wrong at present; empty: nothing."""
        problem = self.link.problem
        if problem and self.outbox.backlog:
            lost = f", {self.outbox.dropped} dropped" if self.outbox.dropped else ""
            return f"{problem}; {self.outbox.backlog} changes are kept{lost}"
        return problem or self.intake.problem or ("" if self._sparkplug is None else self._sparkplug.problem)

    def wake(self) -> None:
        """Have :meth:`turn` return soon; any thread may."""
        os.eventfd_write(self._wakeup, 1)

    # ---- a turn ------------------------------------------------------------------------------------------------------

    def turn(self) -> None:
        """Wait until there is something to do, at most about ``TURN_S``, and do it."""
        for key, events in self._selector.select(self._rest_s):
            key.data(events)
        self._link_turn()
        self._follow()
        held = [feed for feed in self._feeds.values() if feed.held]
        self.steps.look(self._feeds.values())
        self._more.update(feed for feed in held if not feed.held)  # what came since the last step was not looked at
        for feed in list(self._more):
            self._look(feed)
        due_s = [TURN_S, *self._settle()]
        self.outbox.flush()
        due_s.append(self._link_turn())
        due_s.append(self._guard.turn())
        if self._sparkplug is not None:
            due_s.append(self._sparkplug.turn())
        self._rest_s = 0.0 if self._more or self.outbox.able else min(due_s)

    def _settle(self) -> Iterator[float]:
        """Have told what may be told again by now; in how many seconds there is more of each source."""
        for feed in self._feeds.values():
            due_ns = None if feed.held else feed.settle()
            if due_ns is not None:
                yield max(0.0, (due_ns - feed.block.now_ns()) / 1e9)

    def _link_turn(self) -> float:
        """In how many seconds it has to be turned again."""
        link = self.link
        rest_s = min(self.intake.turn(link.at), link.turn())
        if link.problem and not link.up:
            self.outbox.keeping = True
        if link.came_up:
            link.came_up = False
            self.outbox.keeping = True
            self._greet()
        return rest_s

    def _greet(self) -> None:
        """A connection was made: tell that we are there, what was kept, and how everything is now."""
        self.link.send(self._presence.message())
        if self._recalled is None:
            self._recalled = frozenset(self._channels)
            self.link.recall(outputs(self.prefix, self._feeds.values()))
        self._guard.begin()
        for feed in self._feeds.values():
            feed.show()
        self.outbox.show(self._gone.values())

    # ---- what others publish on our topics ---------------------------------------------------------------------------

    def watch(self) -> None:
        """Hear it."""
        self.link.watch(self._own)
        self.intake.watch()

    def unwatch(self) -> None:
        """Hear it no more."""
        self.link.unwatch(self._own)
        self.intake.unwatch()

    @property
    def _own(self) -> list[str]:
        feeds = self._feeds.values()
        states = [self._presence.topic, f"{self.prefix}/simlog/step", *(feed.status.topic for feed in feeds)]
        return [*states, *outputs(self.prefix, feeds)]

    def correct(self, topic: str) -> None:
        """Tell what is so on one, or that there is nothing."""
        log.warning(
            "another client publishes on %s, which is ours: it is told again; let no other account publish there, and "
            "no other bridge have this prefix",
            shorten(topic),
        )
        if (channel := self._channels.get(topic)) is not None:
            self.outbox.mark(channel)
        elif self.outbox.waiting < MOST_WAITING:
            self.outbox.mark(Gone(topic))

    def correct_all(self) -> None:
        """Tell everything again."""
        self.outbox.mark(self._presence)
        for feed in self._feeds.values():
            feed.show()

    def _hear(self, message: MQTTMessage) -> None:
        if is_watched(message):
            self._forged(message)
        else:
            self._recall(message)

    def _command(self, message: MQTTMessage) -> None:
        if is_watched(message):
            self._forged(message)
        else:
            self._commands.take(message)

    def _forged(self, message: MQTTMessage) -> None:
        with suppress(UnicodeDecodeError):
            channel = self._channels.get(message.topic)
            if channel is None:
                wrong = bool(message.retain and message.payload)
            else:  # brokers that hand each other's messages back tell us what we have told
                wrong = channel.message().payload != message.payload
            if wrong:
                self._guard.hear(message.topic)

    def _recall(self, message: MQTTMessage) -> None:
        """What a bridge before this one has left, by other rules: nobody would ever tell it is old."""
        if not (message.retain and message.payload and self._recalled is not None) or len(self._gone) >= MOST_GONE:
            return
        with suppress(UnicodeDecodeError):
            topic = message.topic
            if topic.startswith(f"{self.prefix}/") and topic.endswith(OUTPUTS) and topic not in self._recalled:
                self._gone[topic] = Gone(topic)
                self.outbox.mark(self._gone[topic])

    def _look(self, feed: Feed) -> None:
        self._more.discard(feed)
        if feed.look():
            self._more.add(feed)
        feed.inlet.look()

    def _heard(self, feed: Feed, relay: Relay, _events: int) -> None:
        relay.heard()
        self._more.add(feed)

    # ---- sources that come and go ------------------------------------------------------------------------------------

    def _follow(self) -> None:
        """Take up what a reload has changed; for big layouts that takes seconds, in which others go on."""
        if self._reading is not None and self._reading.done():
            reading, self._reading = self._reading, None
            self._adopt(reading.result())
            self.intake.subscribe()
            if self.link.up:
                self._greet()
        for feed in [feed for feed in self._feeds.values() if feed.over]:
            self._leave(feed)
        if self._reading is None and self._segment.generation != self._generation:
            self._reading = self._reader.submit(self._read, self._known)
            self._reading.add_done_callback(lambda _: self.wake())

    @property
    def _known(self) -> set[int]:
        """Sections of the blocks that are followed."""
        return {feed.block.section for feed in self._feeds.values()}

    def _read(self, known: Container[int]) -> list[tuple[Feed, Device | None]]:
        self._generation = self._segment.generation  # before looking: what changes meanwhile is read the next time
        self._segment.refresh()
        feeds = [
            Feed(block, self._rules, self.prefix, self.outbox, self._writer)
            for block in self._segment.blocks.values()
            if block.section not in known
        ]
        return [(feed, None if self._sparkplug is None else self._sparkplug.device(feed)) for feed in feeds]

    def _adopt(self, read: Iterable[tuple[Feed, Device | None]]) -> None:
        for feed, device in read:
            if (before := self._feeds.get(feed.block.source)) is not None:
                self._leave(before, feed)
            self._feeds[feed.block.source] = feed
            for channel in feed.all():
                self._channels[channel.topic] = channel
                self._gone.pop(channel.topic, None)
            if device is not None and self._sparkplug is not None:
                self._sparkplug.adopt(device)
            block = feed.block
            relay = Relay(block.ring, f"bell-{block.source}", min(TURN_NS, block.stale_ns))
            self._relays[block.section] = relay
            self._selector.register(relay.descriptor, selectors.EVENT_READ, partial(self._heard, feed, relay))

    def _leave(self, feed: Feed, successor: Feed | None = None) -> None:
        """What it has published and its successor does not is taken from the broker's memory."""
        feed.inlet.look()
        self._more.discard(feed)
        stay = set() if successor is None else {channel.topic for channel in successor.all()}
        self.outbox.forget(feed.all())
        for channel in feed.all():
            self._channels.pop(channel.topic, None)
        gone = {channel.topic: Gone(channel.topic) for channel in feed.all() if channel.topic not in stay}
        self._gone |= gone  # told again with each connection: the broker may be away
        self.outbox.mark_all(gone.values())
        del self._feeds[feed.block.source]
        self._missed += feed.missed
        if self._sparkplug is not None:
            self._sparkplug.leave(feed.block.source)
        relay = self._relays.pop(feed.block.section)
        self._selector.unregister(relay.descriptor)
        relay.stop()

    # ---- the end -----------------------------------------------------------------------------------------------------

    def close(self) -> None:
        """Send what is there, say that we go, and go."""
        self.steps.close()
        until_s = time.monotonic() + LEAVE_S
        self._drain(until_s, lambda: not self.outbox.busy)
        for feed in self._feeds.values():
            self.link.send(status(feed.status.topic, Quality.BAD, STOPPED, feed.missed))
        self.link.send(Message(self._presence.topic, OFFLINE, 1, True))
        self.link.push()
        self._drain(until_s, lambda: not (self.link.in_flight or self.intake.link.in_flight))
        self.intake.link.close()
        self.link.close()
        if self._sparkplug is not None:
            self._sparkplug.close()
        for relay in (*self._relays.values(), self._bell):
            self._selector.unregister(relay.descriptor)
            relay.stop()
        for relay in (*self._relays.values(), self._bell):
            relay.join()
        self._reader.shutdown()
        self._selector.close()
        os.close(self._wakeup)

    def _drain(self, until_s: float, done: Callable[[], bool]) -> None:
        while self.link.up and not done() and (rest_s := until_s - time.monotonic()) > 0:
            for key, events in self._selector.select(min(rest_s, TURN_S)):
                key.data(events)
            self.outbox.flush()
            self.intake.turn(self.link.at)
            self.link.turn()
