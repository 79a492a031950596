"""Tells whether a device is online, from the topic of its last will."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from shmio.connectors.mqtt import json_path
from shmio.connectors.mqtt.address import place
from shmio.connectors.mqtt.faults import ValueFaultError
from shmio.connectors.mqtt.options import Will
from shmio.connectors.mqtt.topic import Message
from shmio.connectors.mqtt.values import decode_json
from shmio.errors import ConfigError, PathError
from shmio.layout.glob import Glob
from shmio.model.statuses import BAD_NO_COMMUNICATION, BAD_WAITING_FOR_INITIAL_DATA, GOOD
from shmio.wording import printable

MAX_TEXT: Final = 4096


class Watch:
    """Follows the topic that says whether a device is online."""

    def __init__(self, will: Will) -> None:
        """Create the watch for a will of the configuration.

        Raises:
            ConfigError: The topic or a pattern of the will is wrong.

        """
        try:
            self.place = place(will.topic)
            self._globs = [Glob(pattern) for pattern in will.patterns]
        except (ValueError, PathError) as error:
            raise ConfigError(f"will: {error}") from None
        self._good = frozenset(text.strip().casefold() for text in will.good)
        self.reset()

    def reset(self) -> None:
        """Forget what the messages have said."""
        self.there: bool | None = None
        """True if the device is online; None before the first message about it."""
        self._gone_order = 0
        self._said = ""

    def inherit(self, watches: Iterable[Watch]) -> bool:
        """Take over what the messages have said to the same watch in the layout before a reload.

        Return False if ``watches``, which are those of the earlier layout, do not contain it.
        """
        for other in watches:
            if (other.place, other._good) == (self.place, self._good):
                self.there, self._gone_order, self._said = other.there, other._gone_order, other._said
                return True
        return False

    @property
    def problem(self) -> str:
        """Why the device may be offline; "" if it is online."""
        if self.there:
            return ""
        said = "has no message yet" if self.there is None else f"says {printable(self._said)[:40]!r}"
        return f"the device is offline: {self.place.topic} {said}"

    def covers(self, path: str) -> bool:
        """Return whether the register with this path belongs to the device."""
        return any(glob.matches(path) for glob in self._globs)

    def take(self, message: Message) -> None:
        """Process a message of the topic."""
        try:
            self._said = self._text(message.payload)
            self.there = self._said.strip().casefold() in self._good
        except ValueFaultError as error:
            self._said, self.there = str(error), False
        if not self.there:
            self._gone_order = message.order

    def refuse(self) -> None:
        """Treat the device as offline, because the broker refuses the subscription."""
        self._said, self.there = "unknown, because the broker refused the subscription", False

    def _text(self, payload: bytes) -> str:
        if self.place.steps is None or len(payload) > MAX_TEXT:
            return payload[:MAX_TEXT].decode(errors="replace")
        found = json_path.extract(json_path.Document(decode_json(payload)), self.place.steps)
        return str(found).lower() if isinstance(found, bool) else str(found)

    def fault(self, message: Message | None) -> int:
        """Return the status to show instead of the values in a message from the device; GOOD if the values count."""
        if self.there is None:
            return BAD_WAITING_FOR_INITIAL_DATA
        if not self.there:
            return BAD_NO_COMMUNICATION
        if self._gone_order and message is not None and (message.retained or message.order < self._gone_order):
            return BAD_WAITING_FOR_INITIAL_DATA  # the message is from before the device went offline
        return GOOD
