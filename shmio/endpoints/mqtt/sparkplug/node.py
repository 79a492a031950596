"""A Sparkplug B edge node: makes its messages in order, and decodes its commands. It does no I/O.

Sources are the devices of the node. A device is born when its source is good for the first time. It
dies when the source turns bad, and is born again when the source recovers (Eclipse Sparkplug
Specification 3.0.0, 5 and 6.4).

Registers are the metrics:

===================================  ==========================================================================
BOOL                                 Boolean
SINT, INT, DINT, TIME, S5TIME        Int32
LINT, LTIME, UDINT, DWORD, TOD       Int64
BYTE, USINT; WORD, UINT              UInt8; UInt16
ULINT, LWORD, LTOD                   UInt64
REAL; LREAL                          Float; Double
texts, dates, POINTER, ANY           String
===================================  ==========================================================================

Int8, Int16 and UInt32 are not used, because implementations disagree on their protobuf field or their
sign. An array of numbers or bits is one metric, with the array type for the width of its elements. In
any other array, each element is a metric.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import count
from typing import Any, Final, NamedTuple

import numpy as np
from google.protobuf.message import DecodeError

from shmio.endpoints.mqtt.topics import Message
from shmio.errors import PathError, ValueRangeError
from shmio.layout.model import Layout, Register
from shmio.layout.values.write import elements
from shmio.local.reading import holds_none
from shmio.segment import Quality
from shmio.wire import sparkplug_b_pb2 as wire
from shmio.wording import unknown

NAMESPACE: Final = "spBv1.0"
REBIRTH: Final = "Node Control/Rebirth"
MAX_METRICS: Final = 4096
MAX_BYTES: Final = 1 << 20
"""Maximum size of one command, in bytes."""

INT32: Final = 3
INT64: Final = 4
BOOLEAN: Final = 11
BOOLEANS: Final = 32
_SEQUENCE: Final = 256
_COUNT: Final = struct.Struct("<I")  # the number of bits, which precedes them
_QUALITY: Final = {Quality.BAD: 0, Quality.UNCERTAIN: 500, Quality.GOOD: 192}  # 6.4.8.1: bad, stale, good


class _Datatype(NamedTuple):
    """Sparkplug's representation of a type: its data type, and the protobuf field of a value.

    For arrays of the type, it also has the data type of the array and the format of its elements.
    """

    datatype: int
    field: str
    array: int = 0
    element: str = ""


_STRING: Final = _Datatype(12, "string_value")
_DATATYPES: Final[Mapping[str, _Datatype]] = {
    "BOOL": _Datatype(BOOLEAN, "boolean_value", BOOLEANS, "?"),
    "SINT": _Datatype(INT32, "int_value", 22, "<i1"),
    "INT": _Datatype(INT32, "int_value", 23, "<i2"),
    "DINT": _Datatype(INT32, "int_value", 24, "<i4"),
    "TIME": _Datatype(INT32, "int_value", 24, "<i4"),
    "S5TIME": _Datatype(INT32, "int_value", 24, "<i4"),
    "LINT": _Datatype(INT64, "long_value", 25, "<i8"),
    "LTIME": _Datatype(INT64, "long_value", 25, "<i8"),
    "BYTE": _Datatype(5, "int_value", 26, "<u1"),
    "USINT": _Datatype(5, "int_value", 26, "<u1"),
    "WORD": _Datatype(6, "int_value", 27, "<u2"),
    "UINT": _Datatype(6, "int_value", 27, "<u2"),
    "UDINT": _Datatype(INT64, "long_value", 28, "<u4"),
    "DWORD": _Datatype(INT64, "long_value", 28, "<u4"),
    "TIME_OF_DAY": _Datatype(INT64, "long_value", 28, "<u4"),
    "ULINT": _Datatype(8, "long_value", 29, "<u8"),
    "LWORD": _Datatype(8, "long_value", 29, "<u8"),
    "LTOD": _Datatype(8, "long_value", 29, "<u8"),
    "REAL": _Datatype(9, "float_value", 30, "<f4"),
    "LREAL": _Datatype(10, "double_value", 31, "<f8"),
}
_BITS: Final = {INT32: 32, INT64: 64}


class Metric:
    """A metric: a register, or an element of an array. ``alias`` is its number, unique in the edge node."""

    def __init__(self, register: Register, alias: int) -> None:
        kind = _DATATYPES.get(register.element.base, _STRING)
        self.register = register
        self.name = register.path
        self.alias = alias
        self.datatype = kind.array if register.dims else kind.datatype
        self._field = "bytes_value" if register.dims else kind.field
        self._element = kind.element
        self._bits = 0 if register.dims else _BITS.get(kind.datatype, 0)

    def put(self, metric: wire.Metric, value: Any) -> None:
        """Write a value to a message. None, or an array that contains None, becomes null."""
        data: Any = self._packed(value) if self.register.dims else value
        if data is None:
            metric.is_null = True
        else:
            setattr(metric, self._field, data & ((1 << self._bits) - 1) if self._bits else data)

    def take(self, metric: wire.Metric) -> Any:
        """Read the register's value from a message.

        Raises:
            ValueRangeError: There is no value, or it has the wrong type.

        """
        field = metric.WhichOneof("value")
        if field is None or metric.is_null:
            raise ValueRangeError(f"{self.name}: there is no value")
        value = getattr(metric, field)
        expected = {self._field}
        if self._field in ("int_value", "long_value"):  # clients differ in which one they use
            expected = {"int_value", "long_value"}
        elif self._field in ("float_value", "double_value"):
            expected = {"float_value", "double_value"}
        if field not in expected:
            raise ValueRangeError(f"{self.name}: the field {field} does not fit the type {self.register.type}")
        if self.register.dims:
            return self._unpacked(value)
        bits = 32 if field == "int_value" else 64
        return value - (1 << bits) if self._bits and value >> (bits - 1) else value

    def _packed(self, value: Any) -> bytes | None:
        if holds_none(value):
            return None
        if self.datatype == BOOLEANS:
            flat = np.array(value, bool).reshape(-1)
            return _COUNT.pack(len(flat)) + np.packbits(flat).tobytes()
        return np.array(value, self._element).tobytes()  # with its type: a float would lose digits of a ULINT

    def _unpacked(self, data: bytes) -> list[Any]:
        count = self.register.count
        if self.datatype == BOOLEANS:
            if len(data) != _COUNT.size + -(-count // 8) or _COUNT.unpack_from(data)[0] != count:
                raise ValueRangeError(f"{self.name}: expected {count} bits, preceded by their number")
            flat = np.unpackbits(np.frombuffer(data, np.uint8, offset=_COUNT.size), count=count).astype(bool)
        else:
            if len(data) != count * np.dtype(self._element).itemsize:
                raise ValueRangeError(f"{self.name}: expected all of the array's {count} elements")
            flat = np.frombuffer(data, self._element)
        shaped: list[Any] = flat.reshape(self.register.shape).tolist()
        return shaped


def parts_of(layout: Layout, registers: Iterable[Register], *, single: bool = False) -> Iterator[Register]:
    """Yield the registers, and elements of arrays, that become metrics.

    An array of numbers or bits is one metric. Other arrays are split into their elements. With
    ``single``, all arrays are split.
    """
    for register in registers:
        if register.dims and (single or register.element.base not in _DATATYPES):
            yield from elements(layout, register)
        else:
            yield register


class Sample(NamedTuple):
    """A value of one metric. ``at_ms`` is its time at the source, in ms since 1970."""

    metric: Metric
    value: Any
    at_ms: int
    quality: Quality = Quality.GOOD
    reason: str = ""


class Command(NamedTuple):
    """A command of a host application.

    If ``rebirth`` is True, the node must publish its births again. Otherwise ``values`` has values
    for ``device``, by path.
    """

    rebirth: bool = False
    device: str = ""
    values: Mapping[str, Any] = {}


class EdgeNode:
    """An edge node. It continues to exist between sessions. Use it from one thread."""

    def __init__(
        self,
        group: str,
        node: str,
        now_ms: Callable[[], int] = lambda: time.time_ns() // 1_000_000,
        *,
        datatypes: bool = True,
    ) -> None:
        """Create the node, without devices.

        Args:
            group: The group id.
            node: The edge node id.
            now_ms: Returns the time, in ms since 1970.
            datatypes: Whether to add data types to data messages, for hosts that do not store
                births.

        """
        self._group, self._node, self._datatypes = group, node, datatypes
        self._now_ms = now_ms
        self._sequence = 0
        # A restart must not begin at 0 again: a late will of the previous process must not look like ours. The time
        # in tenths of a second advances faster than attempts to connect do.
        self._session = now_ms() // 100 % _SEQUENCE
        self.alive = False
        """True if the node has published its birth in this session, and has not died since."""
        self._born: set[str] = set()
        self.metrics: dict[str, dict[str, Metric]] = {}
        """The metrics of each device by name, in the order in which they were defined."""
        self._by_alias: dict[int, Metric] = {}

    def define(self, devices: Mapping[str, Iterable[Register]]) -> None:
        """Define the devices and their registers. Afterwards, the node must publish all births again."""
        aliases = count(1)
        self.metrics = {
            device: {register.path: Metric(register, next(aliases)) for register in registers}
            for device, registers in devices.items()
        }
        self._by_alias = {metric.alias: metric for found in self.metrics.values() for metric in found.values()}
        self._born.clear()

    @property
    def commands(self) -> list[str]:
        """The topics to subscribe to, with QoS 1, before the node publishes anything."""
        return [self._topic("NCMD"), self._topic("DCMD", "+")]

    def will(self) -> Message:
        """Start a new session. Return the will for its connection."""
        self._session = (self._session + 1) % _SEQUENCE
        self._born.clear()
        return self.death()

    def death(self) -> Message:
        """Return the message to publish before the node disconnects of its own accord."""
        self.alive = False
        payload = wire.Payload(timestamp=self._now_ms())
        self._put_session(payload)
        return Message(self._topic("NDEATH"), payload.SerializeToString(), 1, retain=False)

    def birth(self) -> Message:
        """Return the birth of the node: the first message of a session, or the reply to a request.

        Publish the births of the devices after it.
        """
        self.alive = True
        self._born.clear()
        self._sequence = 0
        payload = wire.Payload(timestamp=self._now_ms(), seq=self._next())
        self._put_session(payload)
        payload.metrics.add(name=REBIRTH, timestamp=self._now_ms(), datatype=BOOLEAN, boolean_value=False)
        return self._message(payload, "NBIRTH")

    def device_birth(self, device: str, samples: Iterable[Sample]) -> Message:
        """Return the birth of a device, with all its metrics. A metric without a sample is null."""
        self._born.add(device)
        payload = wire.Payload(timestamp=self._now_ms(), seq=self._next())
        given = {sample.metric.name: sample for sample in samples}
        for name, metric in self.metrics[device].items():
            sample = given.get(name) or Sample(metric, None, payload.timestamp, Quality.BAD, "there is no value")
            found = payload.metrics.add(name=name, alias=metric.alias, datatype=metric.datatype)
            self._fill(found, sample)
        return self._message(payload, "DBIRTH", device)

    def data(self, device: str, samples: Iterable[Sample], *, historical: bool = False) -> Message:
        """Return a message with changed values of a device.

        If ``historical`` is True, the message marks the values as late, not current.
        """
        payload = wire.Payload(timestamp=self._now_ms(), seq=self._next())
        for sample in samples:
            found = payload.metrics.add(alias=sample.metric.alias)
            if historical:
                found.is_historical = True
            if self._datatypes:
                found.datatype = sample.metric.datatype
            self._fill(found, sample)
        return self._message(payload, "DDATA", device)

    def device_death(self, device: str) -> Message:
        """Return the death of a device. It says that the device's values are no longer valid."""
        self._born.discard(device)
        payload = wire.Payload(timestamp=self._now_ms(), seq=self._next())
        return self._message(payload, "DDEATH", device)

    def is_born(self, device: str) -> bool:
        """Return whether a device has published its birth in this session, and has not died since."""
        return device in self._born

    def command(self, topic: str, data: bytes, check: Callable[[str, Register], object] = lambda *_: None) -> Command:
        """Decode a message on one of the topics of :attr:`commands`.

        Args:
            topic: The topic.
            data: The payload.
            check: Called with the device and the register of an invalid value. It may raise another
                error, which then takes precedence.

        Raises:
            ValueRangeError: The payload is not Sparkplug B, or a value does not fit its metric.
            PathError: There is no such device or metric.

        """
        if len(data) > MAX_BYTES:  # checked before decoding, which makes an object for each metric
            raise ValueRangeError(f"{topic}: the payload is longer than {MAX_BYTES} bytes")
        try:
            payload = wire.Payload.FromString(data)
        except DecodeError:
            raise ValueRangeError(f"{topic}: this is not a Sparkplug B payload") from None
        if len(payload.metrics) > MAX_METRICS:
            raise ValueRangeError(
                f"{topic}: the payload has {len(payload.metrics)} metrics, at most {MAX_METRICS} are allowed"
            )
        if topic == self._topic("NCMD"):
            asked = any(metric.name == REBIRTH and metric.boolean_value for metric in payload.metrics)
            if not asked:
                raise PathError(f"{topic}: the node accepts only {REBIRTH} = true")
            return Command(rebirth=True)
        device = topic.rpartition("/")[2]
        if device not in self.metrics or topic != self._topic("DCMD", device):
            raise PathError(f"{topic}: {unknown('device', device, self.metrics)}")
        values: dict[str, Any] = {}
        for found in payload.metrics:
            metric = self._metric(device, found)
            if metric.name in values:
                raise ValueRangeError(f"{metric.name}: this metric is given twice")
            try:
                values[metric.name] = metric.take(found)
            except ValueRangeError:
                check(device, metric.register)
                raise
        if not values:
            raise ValueRangeError(f"{topic}: the payload has no metrics")
        return Command(device=device, values=values)

    def _metric(self, device: str, found: wire.Metric) -> Metric:
        """Return a metric by its name or its alias.

        Raises:
            PathError: There is no such metric.

        """
        metrics = self.metrics[device]
        # Some hosts send an empty name with an alias.
        metric = metrics.get(found.name) if found.name else self._by_alias.get(found.alias)
        if metric is None or metrics.get(metric.name) is not metric:
            raise PathError(f"{device}: {unknown('metric', found.name or f'alias {found.alias}', metrics)}")
        return metric

    def _fill(self, found: wire.Metric, sample: Sample) -> None:
        found.timestamp = sample.at_ms
        sample.metric.put(found, sample.value)
        _put_quality(found, sample.quality, sample.reason)

    def _put_session(self, payload: wire.Payload) -> None:
        payload.metrics.add(name="bdSeq", timestamp=self._now_ms(), datatype=INT64, long_value=self._session)

    def _message(self, payload: wire.Payload, kind: str, device: str = "") -> Message:
        return Message(self._topic(kind, device), payload.SerializeToString(), 0, retain=False)

    def _next(self) -> int:
        number, self._sequence = self._sequence, (self._sequence + 1) % _SEQUENCE
        return number

    def _topic(self, kind: str, device: str = "") -> str:
        return "/".join((NAMESPACE, self._group, kind, self._node, *((device,) if device else ())))


def _put_quality(metric: wire.Metric, quality: Quality, reason: str) -> None:
    """Add quality and reason to a value, unless the quality is good (specification, 6.4.8.1)."""
    if quality is not Quality.GOOD:
        metric.properties.keys.extend(("Quality", "Reason"))
        metric.properties.values.add(type=INT32, int_value=_QUALITY[quality])
        metric.properties.values.add(type=_STRING.datatype, string_value=reason)
