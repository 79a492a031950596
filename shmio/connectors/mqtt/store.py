"""The newest messages of all topics of a layout, and the image made of them."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final

from shmio.connectors.mqtt import json_path
from shmio.connectors.mqtt.address import NAMESPACE, Address, Metric, Place, parse
from shmio.connectors.mqtt.faults import ValueFaultError
from shmio.connectors.mqtt.json_path import Companion
from shmio.connectors.mqtt.options import MqttOptions
from shmio.connectors.mqtt.sparkplug import Device, Host
from shmio.connectors.mqtt.topic import Found, Message, Origin, Topic
from shmio.connectors.mqtt.values import ValueConverter, decode_json
from shmio.connectors.mqtt.watch import Watch
from shmio.connectors.register_image import RegisterImage, no_status_area
from shmio.errors import ConfigError, PathError, ValueRangeError
from shmio.layout.glob import Glob
from shmio.layout.model import Layout
from shmio.layout.values.codec import Value
from shmio.model.statuses import (
    BAD_OUT_OF_RANGE,
    BAD_TIMEOUT,
    BAD_WAITING_FOR_INITIAL_DATA,
    GOOD,
    UNCERTAIN_LAST_USABLE_VALUE,
    quality_of,
)
from shmio.model.values import Quality
from shmio.wording import counted

log = logging.getLogger("shmio.source.mqtt")

_SPARKPLUG: Final = f"{NAMESPACE}/"
_NEVER_NS: Final = 1 << 63
_NONE: Final = -1
"""Value of :attr:`Group.shown` before the image shows any status."""


class Group:
    """Registers with the same origin, the same maximum age and the same wills."""

    def __init__(self, origin: Origin, max_age_ns: int, watches: tuple[Watch, ...]) -> None:
        self.origin, self.max_age_ns, self.watches = origin, max_age_ns, watches
        self.registers: list[int] = []
        self.shown = _NONE
        """The status that the image shows for all registers; GOOD if each register has its own."""
        self.seen: Message | None = None
        """The message whose values the image shows; None if there is none."""

    def state(self, now_ns: int) -> int:
        """Return the status of all registers at ``now_ns``, a time of CLOCK_MONOTONIC.

        GOOD means that each register has its own status.
        """
        message = self.origin.message
        for watch in self.watches:
            if fault := watch.fault(message):
                return fault
        if fault := self.origin.fault:
            return fault
        if message is None:
            return BAD_WAITING_FOR_INITIAL_DATA
        if self.max_age_ns:
            if now_ns - message.monotonic_ns > self.max_age_ns:
                return BAD_TIMEOUT
            if message.retained:  # its age is unknown
                return UNCERTAIN_LAST_USABLE_VALUE
        return UNCERTAIN_LAST_USABLE_VALUE if self.origin.doubtful else GOOD


class Store:
    """The newest messages of a layout's topics.

    One thread delivers messages, and another one makes images.
    """

    def __init__(self, layout: Layout, options: MqttOptions) -> None:
        """Parse the addresses of a layout.

        Raises:
            ConfigError: An address is wrong, or does not fit its register.

        """
        self.layout, self._options = layout, options
        self._changed = threading.Condition()
        """Guards all attributes below; waiting threads are notified at each message."""
        self._waiting = 0
        """Number of threads that wait. While it is 0, nobody is notified, which saves a tenth of storing a message."""
        self.addresses: list[Address] = []
        self.converters: list[ValueConverter] = []
        self.host = Host(max_bytes=options.max_payload_bytes)
        """The Sparkplug nodes."""
        self._topics: dict[str, Topic] = {}
        self._watches = [Watch(will) for will in options.wills]
        self._watched: dict[str, list[Watch]] = {}
        for watch in self._watches:
            self._watched.setdefault(watch.place.topic, []).append(watch)
        self._groups: dict[tuple[object, ...], Group] = {}
        self._of_origin: dict[int, list[Group]] = {}
        """The groups of each origin, by its ``id``."""
        self._changed_groups: dict[Group, None] = {}
        """The groups whose state or values may have changed since the last image."""
        self._all_changed = True
        self._written: dict[int, tuple[Value, int]] = {}
        """The last written value of each array, with the order of the newest message at that time."""
        self._expiry_ns = 0
        """No message becomes too old before this time of CLOCK_MONOTONIC, in ns."""
        self._group_of: list[Group] = []
        self._ages = _Ages(options)
        self._time, self._quality = _companion("time", options.time), _companion("quality", options.quality)
        self._image = RegisterImage(layout) if layout.status_offset is not None else None
        self._codes = [GOOD] * len(layout.registers)
        self._order = 0  # continues from one connection to the next
        self._expected: dict[str, bytes] = {}
        """Payloads that were published on topics that are also read, and have not come back yet."""
        for index in range(len(layout.registers)):
            self._add(index)
        for watch in self._watches:
            if not any(watch in group.watches for group in self._groups.values()):
                raise ConfigError(f"will: no register matches the patterns of {watch.place.topic}")
        _check_templates(options, self.addresses)

    def _add(self, index: int) -> None:
        register = self.layout.registers[index]
        try:
            address = parse(register.address)
            self.converters.append(ValueConverter(register, self._options.texts))
            for place in (address.source, address.target):
                if register.dims and isinstance(place, Place) and place.steps is None:
                    raise ValueError(f"an array is read from JSON; write {place.topic} $, or a path such as $.values")
            source = address.source
            if register.writable and isinstance(source, Place) and source.steps is not None and not address.target:
                raise ValueError(
                    "append the topic on which to publish writes, such as -> plant/robot/set $.pos, because shmio does "
                    "not know which other members this JSON must have"
                )
        except ValueError as error:
            raise ConfigError(f"layout: {register.path}: {error}") from None
        self.addresses.append(address)
        origin = self._origin(address, index)
        watches = tuple(watch for watch in self._watches if watch.covers(register.path))
        age_ns = self._ages.of(register.path, needed=not watches and isinstance(address.source, Place))
        key = id(origin), age_ns, watches
        if key not in self._groups:
            self._groups[key] = Group(origin, age_ns, watches)
            self._of_origin.setdefault(id(origin), []).append(self._groups[key])
        group = self._groups[key]
        group.registers.append(index)
        self._group_of.append(group)

    def _origin(self, address: Address, index: int) -> Origin:
        source = address.source
        if isinstance(source, Metric):
            return self.host.origin(source, index)
        new = Topic(source.topic, self._time, self._quality, self._options.max_payload_bytes)
        topic = self._topics.setdefault(source.topic, new)
        topic.place(index, source.steps)
        return topic

    def describe(self) -> str:
        """Return, for the log, how many topics and Sparkplug nodes are read."""
        found = [counted(len(self._topics), "topic")] if self._topics else []
        return ", ".join([*found, *([counted(len(self.host), "Sparkplug node")] if self.host else [])])

    @property
    def filters(self) -> list[str]:
        """The topic filters to subscribe to."""
        return list(dict.fromkeys((*self._topics, *self._watched, *self.host.filters)))

    # -- the thread that receives --------------------------------------------------------------------------------------

    def take(self, topic: str, payload: bytes, *, retained: bool) -> None:
        """Store a message, and wake the threads that wait for it."""
        with self._changed:
            self._order += 1
            message = Message(payload, retained, self._order, time.monotonic_ns(), time.time_ns())
            if topic in self._watched:
                for watch in self._watched[topic]:
                    watch.take(message)
                self._all_changed = True
            if (found := self._topics.get(topic)) is not None:
                found.take(message)
                for group in self._of_origin[id(found)]:
                    self._changed_groups[group] = None
            elif topic.startswith(_SPARKPLUG):
                self.host.take(message, topic)
                self._all_changed = True  # a node's message may concern all of its devices
            if self._expected and self._expected.get(topic) == payload:
                del self._expected[topic]
            if self._waiting:
                self._changed.notify_all()

    # -- the poll thread -----------------------------------------------------------------------------------------------

    def reset(self) -> None:
        """Forget all messages, so that all registers wait for their first value."""
        with self._changed:
            for topic in self._topics.values():
                topic.reset()
            for watch in self._watches:
                watch.reset()
            self.host.reset()
            self._expected.clear()
            self._all_changed = True

    def inherit(self, other: Store) -> list[str]:
        """Take over the messages of ``other``, the store of the layout before a reload.

        Returns:
            The filters to subscribe to for what ``other`` does not know, even if a subscription
            exists already.

        """
        with self._changed, other._changed:
            self._order, self._all_changed = other._order, True
            fresh = self._topics.keys() - other._topics.keys()
            for name in self._topics.keys() & other._topics.keys():
                self._topics[name].inherit(other._topics[name])
            fresh |= {watch.place.topic for watch in self._watches if not watch.inherit(other._watches)}
            self.host.inherit(other.host)
            fresh |= {*self.host.filters} - {*other.host.filters}
        return [one for one in self.filters if one in fresh]

    def refuse(self, topic: str) -> None:
        """Remember that the broker refuses the subscription to a topic."""
        log.warning("the broker refuses the subscription to %s", topic)
        with self._changed:
            self._all_changed = True
            if topic in self._topics:
                self._topics[topic].refused = True
            for watch in self._watched.get(topic, ()):
                watch.refuse()

    def image(self, now_ns: int) -> bytes:
        """Return the image of the newest messages at ``now_ns``, a time of CLOCK_MONOTONIC."""
        image = self._image
        if image is None:
            raise no_status_area()
        with self._changed:
            groups: Iterable[Group] = self._changed_groups
            if self._all_changed or now_ns >= self._expiry_ns:
                groups, self._expiry_ns = self._groups.values(), _NEVER_NS
            for group in groups:
                state, message = group.state(now_ns), group.origin.message
                if group.max_age_ns and message is not None and state != BAD_TIMEOUT:
                    self._expiry_ns = min(self._expiry_ns, message.monotonic_ns + group.max_age_ns)
                if state != group.shown or message is not group.seen:
                    self._show(image, group, state)
                    group.shown, group.seen = state, message
            self._changed_groups.clear()
            self._all_changed = False
            return bytes(image)

    def _show(self, image: RegisterImage, group: Group, state: int) -> None:
        origin = group.origin
        if state != GOOD and quality_of(state) is Quality.BAD:
            source_ns = origin.message.utc_ns if origin.message is not None else 0
            for index in group.registers:
                image.fail(index, state, source_ns)
                self._codes[index] = GOOD
            return
        since = group.seen.order if group.seen is not None and group.shown == state else 0
        for index in group.registers:
            if origin.order_of(index) <= since:
                continue
            try:
                value, found = self._find(index, origin)
            except ValueFaultError as error:
                image.fail(index, error.code, error.source_ns)
                self._note(index, error.code, str(error))
            else:
                fault = image.put(index, value, found.source_ns, found.code or state)
                if fault or found.reason or self._codes[index] != GOOD:
                    self._note(index, BAD_OUT_OF_RANGE if fault else found.code, fault or found.reason)

    def _find(self, index: int, origin: Origin) -> tuple[Value, Found]:
        """Return the value of a register, and where it was found.

        Raises:
            ValueFaultError: The register has no usable value.

        """
        found = origin.find(index)
        converter = self.converters[index]
        try:
            value = converter.from_text(found.value) if found.text else converter.from_json(found.value)
        except ValueFaultError as error:
            error.source_ns = found.source_ns
            raise
        return value, found

    def _note(self, index: int, code: int, reason: str) -> None:
        """Log a fault of a register's value when the fault begins."""
        if code != self._codes[index] and reason:
            log.warning("%s: %s", self.layout.registers[index].path, reason)
        self._codes[index] = code

    # -- for writes ----------------------------------------------------------------------------------------------------

    def offline(self, index: int) -> str:
        """Return why a command to a register would not reach its device; "" if there is no known reason."""
        with self._changed:
            group = self._group_of[index]
            return next((watch.problem for watch in group.watches if watch.problem), group.origin.offline)

    def wrote(self, values: Mapping[int, Value]) -> None:
        """Remember values that were published, until the device sends newer ones."""
        with self._changed:
            for index, value in values.items():
                if self.layout.registers[index].dims:  # only elements of arrays are written with others
                    self._written[index] = value, self._group_of[index].origin.order_of(index)

    def present(self, index: int) -> Value:
        """Return the present value of a register: the last one that the device has sent, or that was written since.

        Raises:
            ValueRangeError: The register has no good value.

        """
        with self._changed:
            group = self._group_of[index]
            if group.state(time.monotonic_ns()) == GOOD:
                try:
                    found = self._find(index, group.origin)[0]
                except ValueFaultError:
                    pass
                else:
                    written, order = self._written.get(index, (found, -1))
                    return written if order == group.origin.order_of(index) else found
        raise ValueRangeError("the present value is not known")

    def command(self, values: Mapping[int, Any]) -> tuple[str, bytes]:
        """Return topic and payload of a Sparkplug command; all its registers must belong to one device.

        Raises:
            ValueError: The device is offline, or a value does not fit its metric.

        """
        with self._changed:
            named: dict[str, Any] = {}
            for index, value in values.items():
                source = self.addresses[index].source
                assert isinstance(source, Metric)  # noqa: S101 - for the type checker
                named[source.name] = value
                device = self._group_of[index].origin
            assert isinstance(device, Device)  # noqa: S101 - for the type checker
            return device.command(named, time.time_ns() // 1_000_000)

    def requests(self, now_ns: int) -> list[tuple[str, bytes]]:
        """Return topic and payload of each rebirth request that is due."""
        if not self.host:
            return []
        with self._changed:
            return list(self.host.requests(now_ns))

    def expect(self, topic: str, payload: bytes, *, retain: bool) -> None:
        """Remember that a payload is about to be published and will come back; do nothing if its topic is not read."""
        with self._changed:
            if topic in self._topics and not self._topics[topic].refused:
                self._expected[topic] = payload
                self._topics[topic].unretained |= not retain

    def await_expected(self, until_s: float) -> bool:
        """Wait until all expected payloads have come back.

        Return False if some have not come back by ``until_s``, a time of CLOCK_MONOTONIC.
        """
        return self.wait(lambda: not self._expected, until_s)

    def outdated(self) -> set[str]:
        """Return the topics whose newest message is another one than the expected one."""
        with self._changed:
            messages = {topic: self._topics[topic].message for topic in self._expected}
            return {
                topic for topic, message in messages.items() if message and message.payload != self._expected[topic]
            }

    def expect_only(self, topics: Iterable[str]) -> None:
        """Forget the expected payloads of all other topics, because the broker has refused them."""
        wanted = set(topics)
        with self._changed:
            self._expected = {topic: payload for topic, payload in self._expected.items() if topic in wanted}

    def expect_nothing(self) -> set[str]:
        """Forget the expected payloads that have not come back; return their topics."""
        with self._changed:
            topics = {*self._expected}
            self._expected.clear()
            return topics

    @property
    def complete(self) -> bool:
        """True if each topic, will and Sparkplug device has a first message, or the broker has refused it."""
        return (
            all(one.message is not None or one.refused for one in self._topics.values())
            and all(watch.there is not None for watch in self._watches)
            and self.host.complete
        )

    def wait(self, condition: Callable[[], bool], until_s: float) -> bool:
        """Wait until ``condition`` returns true.

        Return False if it does not by ``until_s``, a time of CLOCK_MONOTONIC. The condition is
        checked after each message.
        """
        with self._changed:
            self._waiting += 1
            try:
                return self._changed.wait_for(condition, max(0.0, until_s - time.monotonic()))
            finally:
                self._waiting -= 1

    def wake(self) -> None:
        """Wake a thread in :meth:`wait`, so that it checks its condition again."""
        with self._changed:
            self._changed.notify_all()


class _Ages:
    """The maximum age of messages, by pattern of registers."""

    def __init__(self, options: MqttOptions) -> None:
        given = options.max_age_ms
        rules = given if isinstance(given, dict) else {} if given is None else {"**": given}
        try:
            self._rules = [(Glob(pattern), age_ms * 1_000_000) for pattern, age_ms in rules.items()]
        except PathError as error:
            raise ConfigError(f"max_age_ms: {error}") from None

    def of(self, path: str, *, needed: bool) -> int:
        """Return the maximum age for a register in ns; 0 if there is no limit.

        Raises:
            ConfigError: No pattern matches the register, although it is ``needed``.

        """
        for glob, age_ns in self._rules:
            if glob.matches(path):
                return age_ns
        if needed:
            raise ConfigError(
                f"max_age_ms: {path} would stay good forever after its device died; give the age in ms at which its "
                "last message is too old (0: never), or set will to the topic of the device's last will"
            )
        return 0


def _companion(key: str, text: str | None) -> Companion | None:
    try:
        return None if text is None else json_path.parse_companion(text)
    except ValueError as error:
        raise ConfigError(f"{key}: {error}") from None


def _check_templates(options: MqttOptions, addresses: Sequence[Address]) -> None:
    """Check that each template is JSON and is used.

    Raises:
        ConfigError: A template is not JSON, or no register is written to its topic.

    """
    written = {one.target.topic for one in addresses if one.target is not None and one.target.steps}
    for topic, template in options.templates.items():
        if topic not in written:
            raise ConfigError(f"templates: no register is written to {topic!r} as JSON with a path")
        try:
            decode_json(template.encode())
        except ValueFaultError as error:
            raise ConfigError(f"templates: {topic}: {error}") from None
