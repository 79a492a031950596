"""The topics of a layout with their last messages, and the image made of them."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Final, NamedTuple

from shmio.connectors.register_image import Batch, RegisterImage, no_status_area
from shmio.connectors.ros.addresses import Address, FieldError, getter, leaf_type, parse, row_getter, scope_of
from shmio.connectors.ros.messages import plain
from shmio.connectors.ros.options import TopicOptions
from shmio.connectors.ros.qos import TopicQos
from shmio.connectors.ros.values import ValueConverter
from shmio.errors import ConfigError, ValueRangeError
from shmio.layout.model import Layout
from shmio.model.statuses import (
    BAD_DECODING_ERROR,
    BAD_OUT_OF_RANGE,
    BAD_TIMEOUT,
    BAD_WAITING_FOR_INITIAL_DATA,
    GOOD,
    UNREADABLE_TIME,
)

MAX_REPORTED: Final = 20
"""Maximum number of faults that the log names, with their registers, in each connection."""
MAX_SEC: Final = 1 << 33

log = logging.getLogger("shmio.source")


class Row(NamedTuple):
    """Registers whose values are found and stored together."""

    indices: list[int]
    get: Callable[[Any], Sequence[Any]]
    batch: Batch


class Topic:
    """A topic, with the indices of the registers whose values are its fields, and its last message."""

    def __init__(self, name: str, kind: str) -> None:
        self.name, self.type = name, kind
        self.registers: list[int] = []
        self.rows: list[Row] = []
        self.single: list[int] = []
        """Those of ``registers`` that are in no row."""
        self.writable = False
        self.latched = False
        self.qos = TopicQos()
        """The QoS of the topic; always the default with ``rosbridge``."""
        self.message: Any = None
        """The last message; None if no message has arrived, or if the last one cannot be read."""
        self.received_ns = 0
        """When the last message was received, ns of CLOCK_MONOTONIC; 0 if there was none."""
        self.utc_ns = 0
        self.fault = GOOD
        """The status that makes all of the topic's registers bad; GOOD if there is none."""
        self.changed = False
        self.shown = GOOD
        """The fault that the image shows at present."""

    def reset(self) -> None:
        """Forget the last message."""
        self.message, self.received_ns, self.utc_ns, self.fault = None, 0, 0, GOOD
        self.changed, self.shown = False, GOOD

    def inherit(self, other: Topic) -> None:
        """Take over the last message of ``other``, the same topic in the layout before a reload."""
        self.message, self.received_ns, self.utc_ns = other.message, other.received_ns, other.utc_ns
        self.changed = bool(other.received_ns)


class Topics:
    """All topics of a layout."""

    def __init__(self, layout: Layout, options: TopicOptions, *, known_types: bool) -> None:
        """Parse the addresses of a layout.

        Args:
            layout: The layout of the source's block.
            options: The source's keys.
            known_types: Whether all message types must be among those of ``messages.py``.

        Raises:
            ConfigError: An address is wrong, or does not fit its register.

        """
        self.layout = layout
        self.by_name: dict[str, Topic] = {}
        self.addresses: list[Address] = []
        self.converters: list[ValueConverter] = []
        self._getters: list[Callable[[Any], Any]] = []
        """For each register, the function that finds its value in a message."""
        self._max_age_ns = options.max_age * 1_000_000
        self._stamps = options.time == "stamp"
        self._image = RegisterImage(layout) if layout.status_offset is not None else None
        self._reported: set[tuple[int, str]] = set()
        for index in range(len(layout.registers)):
            self._add(index, known_types)
        for name in options.latched:
            if name not in self.by_name:
                raise ConfigError(f"latched: no register has the topic {name!r}")
            self.by_name[name].latched = True
        for topic in self.by_name.values():
            self._form_rows(topic)

    def _add(self, index: int, known_types: bool) -> None:
        register = self.layout.registers[index]
        try:
            address = parse(register.address)
            try:
                kind = leaf_type(address)
            except KeyError as error:
                if known_types or register.writable:
                    what = "be read" if known_types else "be written; remove writable = true to read them"
                    raise ValueError(
                        f"shmio does not know the type {error.args[0]}: its messages cannot {what}"
                    ) from None
                kind = None
            topic = self.by_name.setdefault(address.topic, Topic(address.topic, address.type))
            if plain(topic.type) != plain(address.type):
                raise ValueError(
                    f"another register gives {topic.name} the message type {topic.type}, not {address.type}"
                )
            self.converters.append(ValueConverter(register, kind))
        except ValueError as error:
            raise ConfigError(f"layout: {register.path}: {error}") from None
        self.addresses.append(address)
        self._getters.append(getter(address))
        topic.registers.append(index)
        topic.writable = topic.writable or register.writable

    def _form_rows(self, topic: Topic) -> None:
        """Divide the registers of a topic into rows and single registers."""
        together: dict[object, list[int]] = defaultdict(list)
        for index in topic.registers:
            scope, native = scope_of(self.addresses[index]), self.converters[index].native
            together[index if scope is None or native is None else (scope, native)].append(index)
        for indices in together.values():
            batch = self._image.batch(indices) if self._image is not None and len(indices) > 1 else None
            if batch is None:
                topic.single += indices
            else:
                topic.rows.append(Row(indices, row_getter([self.addresses[index] for index in indices]), batch))

    def reset(self) -> None:
        """Forget all messages, so that all registers wait for a value."""
        self._reported.clear()
        for topic in self.by_name.values():
            topic.reset()
            self._fail(topic, BAD_WAITING_FOR_INITIAL_DATA)

    def inherit(self, other: Topics) -> None:
        """Take over the last messages of the topics that the layout before a reload had, too.

        All other topics wait for a value.
        """
        self.reset()
        for name, topic in self.by_name.items():
            if (before := other.by_name.get(name)) is not None and plain(before.type) == plain(topic.type):
                topic.inherit(before)

    def take(self, name: str, message: Any, received_ns: int, utc_ns: int) -> None:
        """Store the newest message of a topic; None stands for a message that cannot be read."""
        topic = self.by_name.get(name)
        if topic is None:
            return
        topic.message, topic.received_ns, topic.utc_ns = message, received_ns, utc_ns
        topic.changed = True

    def image(self, now_ns: int) -> bytes:
        """Return the image of the last messages.

        Args:
            now_ns: The present time of CLOCK_MONOTONIC in ns.

        """
        if self._image is None:
            raise no_status_area()
        for topic in self.by_name.values():
            fault = topic.fault or self._fault(topic, now_ns)
            if fault != GOOD:
                if topic.shown != fault:
                    self._fail(topic, fault)
            elif topic.changed or topic.shown != GOOD:
                self._put(self._image, topic)
            topic.changed = False
        return bytes(self._image)

    def _fault(self, topic: Topic, now_ns: int) -> int:
        if not topic.received_ns:
            return BAD_WAITING_FOR_INITIAL_DATA
        if topic.message is None:
            return BAD_DECODING_ERROR
        age_ns = now_ns - topic.received_ns
        if (deadline_ms := topic.qos.deadline_ms) and age_ns > deadline_ms * 1_000_000:
            self.report(topic.registers[0], f"{topic.name} has missed its deadline of {deadline_ms} ms")
            return BAD_TIMEOUT
        if self._max_age_ns and not topic.latched and not topic.writable:
            return BAD_TIMEOUT if age_ns > self._max_age_ns else GOOD
        return GOOD

    def _fail(self, topic: Topic, code: int) -> None:
        topic.shown = code
        if self._image is not None:
            for index in topic.registers:
                self._image.fail(index, code, self._source_ns(topic))

    def _put(self, image: RegisterImage, topic: Topic) -> None:
        topic.shown = GOOD
        source_ns = self._source_ns(topic)
        message = topic.message
        code = GOOD
        if self._stamps and stamp_ns(message) is None:
            code = UNREADABLE_TIME
            self.report(
                topic.registers[0], f"the stamp in a message of {topic.name} is no time; its values are uncertain"
            )
        for row in topic.rows:
            try:
                if code == GOOD and image.put_batch(row.batch, row.get(message), source_ns):
                    continue
            except (TypeError, LookupError, ValueError):  # the message lacks something
                pass
            self._put_each(image, row.indices, message, source_ns, code)
        self._put_each(image, topic.single, message, source_ns, code)

    def _put_each(self, image: RegisterImage, indices: Iterable[int], message: Any, source_ns: int, code: int) -> None:
        for index in indices:
            fault = ""
            try:
                fault = image.put(index, self.converters[index].value(self._getters[index](message)), source_ns, code)
            except FieldError as error:
                image.fail(index, error.code, source_ns)
                fault = str(error)
            except (ValueRangeError, OverflowError) as error:
                image.fail(index, BAD_OUT_OF_RANGE, source_ns)
                fault = str(error)
            if fault:
                self.report(index, fault)

    def _source_ns(self, topic: Topic) -> int:
        return (stamp_ns(topic.message) if self._stamps else 0) or topic.utc_ns

    def report(self, index: int, what: str) -> None:
        """Log the fault of a register, but only once per connection, and at most ``MAX_REPORTED`` faults."""
        if len(self._reported) > MAX_REPORTED or (index, what) in self._reported:
            return
        self._reported.add((index, what))
        if len(self._reported) <= MAX_REPORTED:
            log.warning("%s: %s", self.layout.registers[index].path, what)
        else:
            log.warning("more registers are bad; use shmio get to see all of them")

    def waiting(self) -> Iterable[str]:
        """Yield the names of the topics on which no message has arrived."""
        return (topic.name for topic in self.by_name.values() if not topic.received_ns)


def stamp_ns(message: Any) -> int | None:
    """Return the time stamp in a message's header, ns since 1970; 0 if it has none, None if it is no time."""
    header = message.get("header") if isinstance(message, dict) else None
    stamp = header.get("stamp") if isinstance(header, dict) else None
    if not isinstance(stamp, dict):
        return 0
    sec, nanosec = stamp.get("sec", stamp.get("secs")), stamp.get("nanosec", stamp.get("nsecs"))
    if type(sec) is not int or type(nanosec) is not int or not (0 <= sec < MAX_SEC and 0 <= nanosec < 10**9):
        return None
    return sec * 10**9 + nanosec
