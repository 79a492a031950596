"""The connection for commands and their results, beside the one for values, to the same broker.

On one connection, the broker's acknowledgements of values would queue behind all commands. A flood
of commands with QoS 0, which no limit holds back (MQTT 5.0, section 4.9), would delay values.
"""

from __future__ import annotations

import selectors
import time
from collections.abc import Callable, Sequence

from shmio.config import Mqtt
from shmio.endpoints.mqtt.connection.attempt import CONNECT_S
from shmio.endpoints.mqtt.connection.connection import BrokerConnection
from shmio.endpoints.mqtt.connection.limits import FEW_IN_FLIGHT
from shmio.endpoints.mqtt.connection.target import ReconnectPolicy, Target


class CommandConnection:
    """The connection for commands and results. Use it from the bridge's thread."""

    def __init__(
        self,
        settings: Mqtt,
        client_id: str,
        selector: selectors.BaseSelector,
        wake: Callable[[], object],
        filters: Callable[[], Sequence[str]],
        answers: Callable[[], Sequence[str]],
    ) -> None:
        """``selector``, ``wake``: see :class:`BrokerConnection`.

        ``filters``: returns the topics of commands; ``answers``: the topics of results.
        """
        self._policy = ReconnectPolicy(settings, client_id, ())
        self.connection = BrokerConnection(self._policy, selector, wake, lambda: None, FEW_IN_FLIGHT)
        self.connection.close()
        self._filters, self._answers = filters, answers
        self._at: Target | None = None
        self._deadline_s = 0.0
        """Deadline for the broker's SUBACK."""

    @property
    def ready(self) -> bool:
        """Whether commands can arrive, or it is known why not."""
        return self.connection.subscribed or bool(self.connection.problem)

    @property
    def problem(self) -> str:
        """Why no commands arrive or no results are sent; empty: no problem."""
        return f"commands: {self.connection.problem}" if self.connection.problem else ""

    def turn(self, at: Target | None) -> float:
        """Connect to the broker that has the values, and return in how many seconds to call again."""
        if at is not self._at:
            self._at = at
            self.connection.close()
            if at is not None:
                self._policy.use_only(at)
                self.connection.open()
        rest_s = self.connection.turn()
        if self.connection.came_up:
            self.connection.came_up = False
            self.subscribe()
        if not self.connection.up or self.connection.subscribed:
            return rest_s
        left_s = self._deadline_s - time.monotonic()
        if left_s <= 0:  # the connection for values waits for this one
            self.connection.drop("it does not answer to SUBSCRIBE")
        return max(0.0, min(rest_s, left_s))

    def subscribe(self) -> None:
        """Subscribe to the commands of all current sources."""
        if self.connection.up:
            self.connection.subscribe(self._filters())
            self.watch()
            self.connection.push()
            self._deadline_s = time.monotonic() + CONNECT_S

    def watch(self) -> None:
        """Subscribe to what others publish on the topics of results."""
        self.connection.watch(self._answers())

    def unwatch(self) -> None:
        """Unsubscribe from the topics of results."""
        self.connection.unwatch(self._answers())
