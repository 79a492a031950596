"""Passes notices to the actions of their alerts, and collects the problems of the actions."""

from __future__ import annotations

import selectors
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Final

from shmio.config import Alert, Mqtt
from shmio.endpoints.alerts.command import MAX_AT_ONCE, Command
from shmio.endpoints.alerts.notice import Notice
from shmio.endpoints.alerts.publisher import Publisher, queued
from shmio.endpoints.alerts.sender import Sender
from shmio.endpoints.alerts.state_file import Waiting
from shmio.endpoints.alerts.webhook import Webhook
from shmio.segment import Segment

LEAVE_S: Final = 2.0
"""Maximum time in s for which actions may continue when the process stops."""


class Dispatcher:
    """Runs the actions of all alerts. Use it from one thread."""

    def __init__(
        self,
        alerts: Sequence[Alert],
        mqtt: Mqtt | None,
        segment: Segment,
        selector: selectors.BaseSelector,
        wake: Callable[[], object],
        waiting: Waiting,
    ) -> None:
        """Create the actions.

        Args:
            alerts: The alerts.
            mqtt: The section ``[mqtt]``; None if no alert publishes.
            segment: The instance's segment.
            selector: The connection to the MQTT broker registers its socket here.
            wake: Called, from any thread, when :meth:`run_once` must run or :attr:`waiting` has changed.
            waiting: Notices that an earlier process could not deliver.

        """
        turns = threading.BoundedSemaphore(MAX_AT_ONCE)
        self._commands: dict[str, Sender] = {}
        self._webhooks: dict[str, Sender] = {}
        for alert in alerts:
            name = alert.title
            if alert.command is not None:
                command = Command(alert.command, alert.command_timeout_s)
                self._commands[name] = Sender(name, command, wake, _of(name, waiting.command), turns=turns)
            if alert.webhook is not None:
                self._webhooks[name] = Sender(name, Webhook(alert), wake, _of(name, waiting.webhook))
        self._publisher: Publisher | None = None
        if mqtt is not None:
            self._publisher = Publisher(mqtt, segment, selector, wake)
            queued(self._publisher, alerts, waiting.mqtt)

    def put(self, alert: Alert, notice: Notice) -> None:
        """Start to deliver a notice through each action of its alert."""
        for senders in (self._commands, self._webhooks):
            if sender := senders.get(alert.title):
                sender.put(notice)
        if self._publisher is not None and alert.mqtt_topic is not None:
            self._publisher.put(alert, notice)

    def run_once(self) -> float:
        """Do the work that is due. Return the time in s after which to call this method again."""
        return 1.0 if self._publisher is None else self._publisher.run_once()

    @property
    def waiting(self) -> Waiting:
        """The notices that have not been delivered yet."""
        return Waiting(
            [notice for sender in self._commands.values() for notice in sender.waiting],
            [] if self._publisher is None else self._publisher.waiting,
            [notice for sender in self._webhooks.values() for notice in sender.waiting],
        )

    @property
    def waiting_count(self) -> int:
        """Number of notices in :attr:`waiting`."""
        count = sum(sender.waiting_count for sender in self._senders())
        return count if self._publisher is None else count + self._publisher.waiting_count

    @property
    def failed(self) -> int:
        """Number of notices that were lost."""
        return sum(sender.failed for sender in self._senders()) + (self._publisher.failed if self._publisher else 0)

    @property
    def problem(self) -> str:
        """The present problems of all actions, as text; empty if there are none."""
        problems = [sender.problem for sender in self._senders()]
        return "; ".join(filter(None, [*problems, self._publisher.problem if self._publisher else ""]))

    def close(self) -> None:
        """End all actions within ``LEAVE_S``. Undelivered notices stay in :attr:`waiting`."""
        for sender in self._senders():
            sender.stop()
        until_s = time.monotonic() + LEAVE_S
        for sender in self._senders():
            sender.join(max(0.0, until_s - time.monotonic()))
        if self._publisher is not None:
            self._publisher.close()

    def _senders(self) -> Iterator[Sender]:
        yield from self._commands.values()
        yield from self._webhooks.values()


def _of(alert: str, notices: Sequence[Notice]) -> list[Notice]:
    return [notice for notice in notices if notice.alert == alert]
