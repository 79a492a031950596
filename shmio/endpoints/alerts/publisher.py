"""Publishes notices through the instance's MQTT broker."""

from __future__ import annotations

import selectors
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from typing import Final, NamedTuple

import msgspec

from shmio.config import Alert, Mqtt
from shmio.endpoints.alerts.notice import Notice
from shmio.endpoints.alerts.sender import MAX_WAITING
from shmio.endpoints.mqtt.broker.directory import own_socket
from shmio.endpoints.mqtt.connection.connection import BrokerConnection
from shmio.endpoints.mqtt.connection.reconnect import ReconnectPolicy, targets
from shmio.endpoints.mqtt.topics import Message
from shmio.segment import Segment

MOST_IN_FLIGHT: Final = 10


class _Entry(NamedTuple):
    notice: Notice
    message: Message


class Publisher:
    """Publishes the notices of all alerts in order, over its own connection to the broker.

    Use it from one thread. A notice waits until the broker has acknowledged it.
    """

    def __init__(
        self, settings: Mqtt, segment: Segment, selector: selectors.BaseSelector, wake: Callable[[], object]
    ) -> None:
        """Prepare the connection; :meth:`run_once` connects.

        Args:
            settings: The section ``[mqtt]``, without the passwords of the instance's own broker.
            segment: The instance's segment.
            selector: The connection registers its socket here.
            wake: Called, from any thread, when :meth:`run_once` must run.

        """
        clean = msgspec.structs.replace(settings, session_expiry_s=0)
        client_id = f"{settings.client_id or f'shmio-{segment.instance}'}-alerts"
        policy = ReconnectPolicy(clean, client_id, targets(settings, own_socket(segment)))
        self._connection = BrokerConnection(policy, selector, wake, lambda: None, MOST_IN_FLIGHT)
        self._connection.on_lost = lambda _: self._return()
        self._queue: deque[_Entry] = deque()
        self._sent: deque[_Entry] = deque()
        self._dropped = 0

    @property
    def problem(self) -> str:
        """Why notices cannot be published; empty if they can."""
        return self._connection.problem

    @property
    def failed(self) -> int:
        """Number of notices that were dropped, or that the broker refused."""
        return self._dropped + self._connection.problems.refused

    @property
    def waiting(self) -> list[Notice]:
        """The notices that the broker has not acknowledged yet, the oldest first."""
        return [entry.notice for entry in (*self._sent, *self._queue)]

    @property
    def waiting_count(self) -> int:
        """Number of notices in :attr:`waiting`."""
        return len(self._sent) + len(self._queue)

    def put(self, alert: Alert, notice: Notice) -> None:
        """Queue a notice for the topic of its alert. If too many are queued, drop the oldest."""
        if len(self._queue) == MAX_WAITING:
            self._queue.popleft()
            self._dropped += 1
        message = Message(alert.mqtt_topic or "", notice.json(), 1, alert.mqtt_retain)
        self._queue.append(_Entry(notice, message))

    def run_once(self) -> float:
        """Do the work that is due. Return the time in s after which to call this method again."""
        connection = self._connection
        rest_s = connection.run_once()
        while self._sent and not connection.is_unacknowledged(self._sent[0].message):
            self._sent.popleft()
        while self._queue and connection.room > 0:
            self._sent.append(self._queue.popleft())
            connection.send(self._sent[-1].message)
        connection.push()
        return rest_s

    def _return(self) -> None:
        """Queue the unacknowledged notices again, so that they are sent over the next connection."""
        self._queue.extendleft(reversed(self._sent))
        self._sent.clear()

    def close(self) -> None:
        """Disconnect from the broker."""
        self._connection.close()


def queued(publisher: Publisher, alerts: Iterable[Alert], notices: Sequence[Notice]) -> None:
    """Queue the notices that an earlier process could not publish.

    Drop those whose alert no longer exists, or no longer has an MQTT topic.
    """
    by_name = {alert.title: alert for alert in alerts if alert.mqtt_topic is not None}
    for notice in notices:
        if notice.alert in by_name:
            publisher.put(by_name[notice.alert], notice)
