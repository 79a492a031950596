"""Delivers steps of virtual time. Each step waits until the broker has acknowledged the step's changes."""

from __future__ import annotations

import logging
import time
from collections.abc import Collection
from typing import Final

import msgspec

from shmio.endpoints.mqtt.connection.connection import BrokerConnection
from shmio.endpoints.mqtt.feed import Feed
from shmio.endpoints.mqtt.outbox import Outbox
from shmio.endpoints.mqtt.topics import Message
from shmio.model.clock import Clock
from shmio.segment.clock import ClockPage

PATIENCE_S: Final = 3.0
"""Time in s that a broker has to acknowledge a step. It is less than the time-out of a step."""

log = logging.getLogger("shmio.mqtt")


class StepDelivery:
    """Delivers steps to the broker. Use it only in the bridge's thread."""

    def __init__(self, clock: ClockPage, index: int, topic: str, connection: BrokerConnection, outbox: Outbox) -> None:
        """From now on, make each step wait for this process.

        Args:
            clock: The clock page.
            index: Index of this process's slot.
            topic: Topic of the step markers.
            connection: The connection for values.
            outbox: Queues the messages.

        """
        self._clock, self._index, self._topic, self._connection, self._outbox = clock, index, topic, connection, outbox
        self._delivering: StepMarker | None = None
        self._until_s = 0.0
        self._virtual = False  # whether time was virtual at the last poll
        self.done = clock.read().done
        """Number of the last step that was delivered."""
        clock.deliver(index, self.done)  # from now on each step waits for this process

    def poll(self, feeds: Collection[Feed]) -> Collection[Feed]:
        """Start to deliver a new step, or finish a delivery; update :attr:`Feed.step_driven` of the feeds.

        Returns:
            The feeds that were driven by steps until now. They may have unread frames.

        """
        now = self._clock.read()
        released: Collection[Feed] = ()
        if now.virtual:
            for feed in feeds:
                feed.step_driven = feed.block.attributes.stepped and feed.follower.frame is not None
        elif self._virtual:
            released = [feed for feed in feeds if feed.step_driven]
            for feed in released:
                feed.step_driven = False
        self._virtual = now.virtual
        if self._delivering is None and now.virtual and now.done != self.done:  # a snapshot may set time back
            self._begin(now, feeds)
        if self._delivering is not None and self._over(self._delivering):
            self.done, self._delivering = self._delivering.number, None
            self._clock.deliver(self._index, self.done)
        return released

    def _begin(self, state: Clock, feeds: Collection[Feed]) -> None:
        for feed in feeds:
            feed.command_client.poll()
            feed.step()
        self._delivering = StepMarker(self._topic, state)
        self._until_s = time.monotonic() + PATIENCE_S
        self._outbox.mark(self._delivering)
        self._outbox.flush()

    def _over(self, marker: StepMarker) -> bool:
        """Return whether the delivery has ended.

        It ends when the broker acknowledges the step, after a time-out, or when the connection ends.
        """
        if not self._connection.up:
            return True
        if marker.sent is not None and not self._connection.is_unacknowledged(marker.sent):
            return True  # a broker acknowledges in the order of sending (MQTT 5.0, section 4.6)
        if time.monotonic() >= self._until_s:
            log.warning(
                "the broker does not accept step %d; the bridge ends the connection and connects again", marker.number
            )
            self._connection.drop(f"it did not accept step {marker.number} within {PATIENCE_S:g} s")
            return True
        return False

    def close(self) -> None:
        """End the deliveries: steps no longer wait for this process."""
        self._clock.abstain(self._index)


class StepMarker:
    """The channel of the message that reports the end of a step."""

    def __init__(self, topic: str, state: Clock) -> None:
        self.number = state.done
        self.topic = topic
        self.sent: Message | None = None
        last = state.done == state.step  # the time of an earlier step is unknown
        fields = {"step": state.done, "time_s": state.time_ns / 1e9 if last else None}
        self._message = Message(topic, msgspec.json.encode(fields), 1, retain=False)

    def message(self, *, late: bool = False) -> Message:
        """Return the message. Unless ``late`` is True, it counts as sent."""
        if not late:
            self.sent = self._message
        return self._message
