"""The origins of registers' values: the newest messages of topics and of Sparkplug devices."""

from __future__ import annotations

import datetime
import logging
import re
from abc import ABC, abstractmethod
from typing import Any, Final

import msgspec

from shmio.connectors.mqtt import json_path
from shmio.connectors.mqtt.faults import ValueFaultError
from shmio.connectors.mqtt.json_path import AbsentError, Choice, Companion, Document, Steps
from shmio.connectors.mqtt.quality import from_json
from shmio.connectors.mqtt.values import decode_json
from shmio.model.statuses import (
    BAD_OUT_OF_RANGE,
    BAD_USER_ACCESS_DENIED,
    BAD_WAITING_FOR_INITIAL_DATA,
    GOOD,
    UNCERTAIN,
    UNREADABLE_TIME,
)
from shmio.wording import brief

_MAX_NS: Final = (1 << 63) - 1
_UNITS: Final = ((1e11, 10**9), (1e14, 10**6), (1e17, 10**3))
"""Pairs (limit, unit in ns): a time below the limit is in this unit (s, ms or µs). A larger time is in ns."""
_EPOCH: Final = re.compile(r"(?!(?:[0-9]{8}|[0-9]{12})\Z)[0-9]{1,20}(?:\.[0-9]{1,20})?")
"""A time since 1970, unlike dates such as 20240229 and 202402291200."""

log = logging.getLogger("shmio.source.mqtt")


class Message(msgspec.Struct, frozen=True, gc=False):
    """A received message; ``order`` counts the messages since the source started."""

    payload: bytes
    retained: bool
    """True if the broker had stored the message, so that its time of publication is unknown."""
    order: int
    monotonic_ns: int
    utc_ns: int


class Found(msgspec.Struct, frozen=True):
    """What a message contains for a register: a text as bytes, or a JSON value."""

    value: Any
    source_ns: int
    code: int = GOOD
    text: bool = False
    """True if ``value`` is the whole payload, as text."""
    reason: str = ""
    """A detail for the log, which the code cannot express."""


class Origin(ABC):
    """The origin of registers' values: a topic, or a Sparkplug device."""

    message: Message | None = None
    """The newest message; None if there is none."""

    @property
    @abstractmethod
    def fault(self) -> int:
        """The status that makes all registers of this origin bad; GOOD if there is none."""

    @property
    def doubtful(self) -> bool:
        """True if the newest message may be older than one that was seen before."""
        return False

    @property
    def offline(self) -> str:
        """Why a command would not reach the device; "" if there is no known reason."""
        return ""

    @abstractmethod
    def order_of(self, index: int) -> int:
        """Return the ``order`` of the message with the newest value of a register."""

    @abstractmethod
    def find(self, index: int) -> Found:
        """Return what the newest message contains for a register.

        Raises:
            ValueFaultError: The message has no usable value for the register.

        """

    @abstractmethod
    def reset(self) -> None:
        """Forget all messages."""


class Topic(Origin):
    """A topic whose payloads are text or JSON."""

    def __init__(self, name: str, time: Companion | None, quality: Companion | None, max_bytes: int) -> None:
        """Create the topic.

        Args:
            name: The topic's name.
            time: The path of the source time in JSON. If None, the source time is the time of receipt.
            quality: The path of the quality in JSON. If None, values are good.
            max_bytes: The size of the largest payload that is read.

        """
        self.name = name
        self.places: dict[int, Steps | None] = {}
        """For each register, by index, the path of its value in JSON; None if the payload is the value as text."""
        self.refused = False
        """True if the broker refuses the subscription."""
        self.unretained = False
        """True if this source has published a message on the topic that the broker did not retain."""
        self._seen: bytes | None = None
        """The payload of the last message on the connection before; None if there was none."""
        self._time, self._quality, self._max_bytes = time, quality, max_bytes
        self._document: Document | ValueFaultError | None = None
        self._decoded: Message | None = None
        self._choosing: dict[int, Choice] = {}
        """The registers whose path selects an object by a member. Not every message contains this object."""
        self._chosen: dict[int, tuple[Found | ValueFaultError, int]] = {}
        """What the last message with the object of such a register contains for it, and the message's ``order``."""
        self._timeless = False
        """True if the log says that a message has no readable time."""

    def place(self, index: int, steps: Steps | None) -> None:
        """Give a register its place in the messages."""
        self.places[index] = steps
        if (choice := next((step for step in steps or () if isinstance(step, Choice)), None)) is not None:
            self._choosing[index] = choice

    @property
    def fault(self) -> int:
        """The status that makes all registers of the topic bad; GOOD if there is none."""
        return BAD_USER_ACCESS_DENIED if self.refused else GOOD

    @property
    def doubtful(self) -> bool:
        """True if the newest message is retained, and may be older than what this source has published."""
        message = self.message
        return self.unretained and message is not None and message.retained and message.payload != self._seen

    def take(self, message: Message) -> None:
        """Store a message. One that does not contain a selected object leaves the object's registers as they are."""
        self.message = message
        for index in self._choosing:
            try:
                found: Found | ValueFaultError = self._found(index, message)
            except AbsentError:
                continue
            except ValueFaultError as error:
                found = error
            self._chosen[index] = found, message.order

    def order_of(self, index: int) -> int:
        """Return the ``order`` of the newest message with a value for a register."""
        if index in self._chosen:
            return self._chosen[index][1]
        return self.message.order if self.message is not None else 0

    def find(self, index: int) -> Found:
        """Return what the newest message contains for a register."""
        message = self.message
        assert message is not None  # noqa: S101 - Group.state has checked this
        if index not in self._choosing:
            return self._found(index, message)
        found, _ = self._chosen.get(index, (None, 0))
        if found is None:
            raise ValueFaultError(
                BAD_WAITING_FOR_INITIAL_DATA, f"no message has contained an object {self._choosing[index]} yet"
            )
        if isinstance(found, ValueFaultError):
            raise found
        return found

    def _found(self, index: int, message: Message) -> Found:
        if len(message.payload) > self._max_bytes:
            raise ValueFaultError(
                BAD_OUT_OF_RANGE, f"a payload of {len(message.payload)} bytes is larger than max_payload_bytes"
            )
        steps = self.places[index]
        if steps is None:
            return Found(message.payload, message.utc_ns, text=True)
        document = self._json(message)
        found = json_path.extract(document, steps)
        source_ns = None if self._time is None else self._source_ns(document, self._time.of(steps))
        code, reason = (GOOD, "") if self._quality is None else _quality(document, self._quality.of(steps))
        if code == GOOD and source_ns == 0:
            code = UNREADABLE_TIME
        return Found(found, source_ns or message.utc_ns, code, reason=reason)

    def _json(self, message: Message) -> Document:
        if self._decoded is not message:
            try:
                self._document = Document(decode_json(message.payload))
            except ValueFaultError as error:
                self._document = error
            self._decoded = message
        if isinstance(self._document, ValueFaultError):
            raise self._document
        assert self._document is not None  # noqa: S101 - for the type checker
        return self._document

    def _source_ns(self, document: Document, path: Steps) -> int | None:
        """Return the time in a document; 0 if it cannot be read, None if there is none. The log says so once."""
        at_ns = None
        try:
            found = json_path.extract(document, path)
            if at_ns := time_ns(found):
                return at_ns
            reason = f"its time {brief(found)} cannot be read, so its values are uncertain"
        except ValueFaultError as error:
            reason = f"it has no time ({error})"
        if not self._timeless:
            log.warning("%s: %s; shmio uses the time of receipt", self.name, reason)
            self._timeless = True
        return at_ns

    def reset(self) -> None:
        """Forget the newest message, except its payload."""
        if self.message is not None:
            self._seen = self.message.payload
        self.message = self._document = self._decoded = None
        self._chosen.clear()
        self.refused = self._timeless = False

    def inherit(self, other: Topic) -> None:
        """Take over the message of ``other``, the same topic in the layout before a reload."""
        self.message, self.refused = other.message, other.refused
        self.unretained, self._seen = other.unretained, other._seen
        known = {other.places[index]: found for index, found in other._chosen.items()}
        if self.message is not None:
            self.take(self.message)
        self._chosen |= {index: known[self.places[index]] for index in self._choosing if self.places[index] in known}


def _quality(document: Document, path: Steps) -> tuple[int, str]:
    """Return the status that a document states, and what the status does not say."""
    try:
        return from_json(json_path.extract(document, path))
    except ValueFaultError as error:
        return UNCERTAIN, f"it has no quality ({error})"


def time_ns(found: Any) -> int:
    """Return a time in JSON as ns since 1970; 0 if the value is not a time.

    A time is a number of s, ms, µs or ns, also as text, or text in ISO 8601.
    """
    if isinstance(found, str) and _EPOCH.fullmatch(found):
        found = float(found) if "." in found else int(found)
    if isinstance(found, str):
        try:
            at = datetime.datetime.fromisoformat(found[:64])
            at = at if at.tzinfo is not None else at.replace(tzinfo=datetime.UTC)
            since = at - datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)
        except (ValueError, OverflowError):
            return 0
        found_ns = (since.days * 86_400 + since.seconds) * 10**9 + since.microseconds * 1000
    elif isinstance(found, int | float) and not isinstance(found, bool) and 0 < found < _MAX_NS:
        unit_ns = next((unit for most, unit in _UNITS if found < most), 1)
        found_ns = found * unit_ns if isinstance(found, int) else round(found * unit_ns)
    else:
        return 0
    return found_ns if 0 < found_ns <= _MAX_NS else 0
