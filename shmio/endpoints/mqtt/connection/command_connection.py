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
from shmio.endpoints.mqtt.connection.connection import Link
from shmio.endpoints.mqtt.connection.limits import FEW_IN_FLIGHT
from shmio.endpoints.mqtt.connection.target import Dialling, Target


class Intake:
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
        """``selector``, ``wake``: as of :class:`Link`; ``filters``: what is to be subscribed to at present.

        ``answers``: where results go.
        """
        self._dialling = Dialling(settings, client_id, ())
        self.link = Link(self._dialling, selector, wake, lambda: None, FEW_IN_FLIGHT)
        self.link.close()
        self._filters, self._answers = filters, answers
        self._at: Target | None = None
        self._until_s = 0.0
        """When the broker must have answered to what was subscribed to."""

    @property
    def settled(self) -> bool:
        """Whether commands come in, or it is known why they do not."""
        return self.link.subscribed or bool(self.link.problem)

    @property
    def problem(self) -> str:
        """Why they do not, or no results go out; empty: all is well."""
        return f"commands: {self.link.problem}" if self.link.problem else ""

    def turn(self, at: Target | None) -> float:
        """Be where the values go, or nowhere; in how many seconds there is more to do."""
        if at is not self._at:
            self._at = at
            self.link.close()
            if at is not None:
                self._dialling.turn_to(at)
                self.link.open()
        rest_s = self.link.turn()
        if self.link.came_up:
            self.link.came_up = False
            self.subscribe()
        if not self.link.up or self.link.subscribed:
            return rest_s
        left_s = self._until_s - time.monotonic()
        if left_s <= 0:  # values wait to hear of it
            self.link.drop("it does not answer to SUBSCRIBE")
        return max(0.0, min(rest_s, left_s))

    def subscribe(self) -> None:
        """Have commands sent for all that there is now."""
        if self.link.up:
            self.link.subscribe(self._filters())
            self.watch()
            self.link.push()
            self._until_s = time.monotonic() + CONNECT_S

    def watch(self) -> None:
        """Hear what others publish where results go."""
        self.link.watch(self._answers())

    def unwatch(self) -> None:
        """Hear it no more."""
        self.link.unwatch(self._answers())
