"""Where commands come in and their results go out: by a connection of its own, to the broker that has the values.

On one connection a broker's acknowledgements of values would come behind all the commands that it has for us, and who
sends them with QoS 0 is held back by nobody (MQTT 5.0, section 4.9): values would wait for a flood of them.
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
    """For the bridge's thread."""

    def __init__(
        self,
        settings: Mqtt,
        client_id: str,
        selector: selectors.BaseSelector,
        wake: Callable[[], object],
        filters: Callable[[], Sequence[str]],
        answers: Callable[[], Sequence[str]],
    ) -> None:
        """``selector``, ``wake``: as of :class:`BrokerConnection`; ``filters``: what is to be subscribed to at present.

        ``answers``: where results go.
        """
        self._policy = ReconnectPolicy(settings, client_id, ())
        self.connection = BrokerConnection(self._policy, selector, wake, lambda: None, FEW_IN_FLIGHT)
        self.connection.close()
        self._filters, self._answers = filters, answers
        self._at: Target | None = None
        self._deadline_s = 0.0
        """When the broker must have answered to what was subscribed to."""

    @property
    def ready(self) -> bool:
        """Whether commands come in, or it is known why they do not."""
        return self.connection.subscribed or bool(self.connection.problem)

    @property
    def problem(self) -> str:
        """Why they do not, or no results go out; empty: all is well."""
        return f"commands: {self.connection.problem}" if self.connection.problem else ""

    def turn(self, at: Target | None) -> float:
        """Be where the values go, or nowhere; in how many seconds there is more to do."""
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
        if left_s <= 0:  # values wait to hear of it
            self.connection.drop("it does not answer to SUBSCRIBE")
        return max(0.0, min(rest_s, left_s))

    def subscribe(self) -> None:
        """Have commands sent for all that there is now."""
        if self.connection.up:
            self.connection.subscribe(self._filters())
            self.watch()
            self.connection.push()
            self._deadline_s = time.monotonic() + CONNECT_S

    def watch(self) -> None:
        """Hear what others publish where results go."""
        self.connection.watch(self._answers())

    def unwatch(self) -> None:
        """Hear it no more."""
        self.connection.unwatch(self._answers())
