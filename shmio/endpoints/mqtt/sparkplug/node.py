"""A Sparkplug B edge node: makes its messages in order, and decodes its commands. No I/O.

Sources are its devices. A device is born when its source is good for the first time, dies when that
turns bad, and is born again. (Eclipse Sparkplug Specification 3.0.0, 5 and 6.4.)
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from itertools import count
from typing import Any, Final, NamedTuple

from google.protobuf.message import DecodeError

from shmio.endpoints.mqtt.channel import Message
from shmio.endpoints.mqtt.sparkplug.metrics import BOOLEAN, INT64, Metric, put_quality
from shmio.errors import PathError, ValueRangeError
from shmio.layout.model import Register
from shmio.segment import Quality
from shmio.wire import sparkplug_b_pb2 as wire

NAMESPACE: Final = "spBv1.0"
REBIRTH: Final = "Node Control/Rebirth"
MAX_METRICS: Final = 4096
MAX_BYTES: Final = 1 << 20
"""Maximum size of one command."""
_SEQUENCE: Final = 256


class Sample(NamedTuple):
    """A value of one metric.

    ``at_ms``: when the source had it, in ms since 1970.
    """

    metric: Metric
    value: Any
    at_ms: int
    quality: Quality = Quality.GOOD
    reason: str = ""


class Command(NamedTuple):
    """A host application's command.

    ``rebirth``: the node is to be born again; else ``values`` has values by path of ``device``.
    """

    rebirth: bool = False
    device: str = ""
    values: Mapping[str, Any] = {}


class EdgeNode:
    """One node, through all its sessions. Use it from one thread."""

    def __init__(
        self,
        group: str,
        node: str,
        now_ms: Callable[[], int] = lambda: time.time_ns() // 1_000_000,
        *,
        datatypes: bool = True,
    ) -> None:
        """Begin; ``datatypes`` adds data types to data messages, for hosts that do not store births."""
        self._group, self._node, self._datatypes = group, node, datatypes
        self._now_ms = now_ms
        self._sequence = 0
        # Not from 0 after each restart: a late will of the process before must not be taken for this one's. In
        # tenths of a second, which no series of attempts to connect overtakes.
        self._session = now_ms() // 100 % _SEQUENCE
        self.alive = False
        """Whether the node was born in this session and has not died."""
        self._born: set[str] = set()
        self.metrics: dict[str, dict[str, Metric]] = {}
        """Each device's metrics by name, in the order in which they were given."""
        self._by_alias: dict[int, Metric] = {}

    def define(self, devices: Mapping[str, Iterable[Register]]) -> None:
        """Define the devices and their registers; everything has to be born again."""
        aliases = count(1)
        self.metrics = {
            device: {register.path: Metric(register, next(aliases)) for register in registers}
            for device, registers in devices.items()
        }
        self._by_alias = {metric.alias: metric for found in self.metrics.values() for metric in found.values()}
        self._born.clear()

    @property
    def commands(self) -> list[str]:
        """The topics to subscribe to, with QoS 1, before anything is published."""
        return [self._topic("NCMD"), self._topic("DCMD", "+")]

    def will(self) -> Message:
        """Begin a new session, and make the will of its connection."""
        self._session = (self._session + 1) % _SEQUENCE
        self._born.clear()
        return self.death()

    def death(self) -> Message:
        """Make the message to publish before the node disconnects by itself."""
        self.alive = False
        payload = wire.Payload(timestamp=self._now_ms())
        self._put_session(payload)
        return Message(self._topic("NDEATH"), payload.SerializeToString(), 1, retain=False)

    def birth(self) -> Message:
        """Make the node's birth: the first message of a session, or after a request.

        The devices' births follow it.
        """
        self.alive = True
        self._born.clear()
        self._sequence = 0
        payload = wire.Payload(timestamp=self._now_ms(), seq=self._next())
        self._put_session(payload)
        payload.metrics.add(name=REBIRTH, timestamp=self._now_ms(), datatype=BOOLEAN, boolean_value=False)
        return self._message(payload, "NBIRTH")

    def device_birth(self, device: str, samples: Iterable[Sample]) -> Message:
        """Make a device's birth with all its metrics; those without a sample are null."""
        self._born.add(device)
        payload = wire.Payload(timestamp=self._now_ms(), seq=self._next())
        given = {sample.metric.name: sample for sample in samples}
        for name, metric in self.metrics[device].items():
            sample = given.get(name) or Sample(metric, None, payload.timestamp, Quality.BAD, "there is no value")
            found = payload.metrics.add(name=name, alias=metric.alias, datatype=metric.datatype)
            self._fill(found, sample)
        return self._message(payload, "DBIRTH", device)

    def data(self, device: str, samples: Iterable[Sample], *, historical: bool = False) -> Message:
        """Make a message with changed values.

        ``historical``: the values are late and not the current ones.
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
        """Make a device's death: its values are no longer valid."""
        self._born.discard(device)
        payload = wire.Payload(timestamp=self._now_ms(), seq=self._next())
        return self._message(payload, "DDEATH", device)

    def is_born(self, device: str) -> bool:
        """Return whether a device was born in this session and has not died."""
        return device in self._born

    def command(self, topic: str, data: bytes, check: Callable[[str, Register], object] = lambda *_: None) -> Command:
        """Decode a message on one of the topics of :attr:`commands`.

        ``check``: called with the register of a wrong value; it may raise a more important error.

        Raises:
            ValueRangeError: It is not a payload of Sparkplug B, or a value does not fit its metric.
            PathError: There is no such device or metric.

        """
        if len(data) > MAX_BYTES:  # before decoding, which makes an object for each metric
            raise ValueRangeError(f"{topic}: the payload is longer than {MAX_BYTES} bytes")
        try:
            payload = wire.Payload.FromString(data)
        except DecodeError:
            raise ValueRangeError(f"{topic}: this is not a Sparkplug B payload") from None
        if len(payload.metrics) > MAX_METRICS:
            raise ValueRangeError(f"{topic}: {len(payload.metrics)} metrics, at most {MAX_METRICS} are allowed")
        if topic == self._topic("NCMD"):
            asked = any(metric.name == REBIRTH and metric.boolean_value for metric in payload.metrics)
            if not asked:
                raise PathError(f"{topic}: the node takes {REBIRTH} = true, and nothing else")
            return Command(rebirth=True)
        device = topic.rpartition("/")[2]
        if device not in self.metrics or topic != self._topic("DCMD", device):
            raise PathError(f"{topic}: there is no such device; there are: {', '.join(self.metrics)}")
        values: dict[str, Any] = {}
        for found in payload.metrics:
            metric = self._metric(device, found)
            if metric.name in values:
                raise ValueRangeError(f"{metric.name}: given twice")
            try:
                values[metric.name] = metric.take(found)
            except ValueRangeError:
                check(device, metric.register)
                raise
        if not values:
            raise ValueRangeError(f"{topic}: there is no metric in it")
        return Command(device=device, values=values)

    def _metric(self, device: str, found: wire.Metric) -> Metric:
        """Return a metric by its name or its alias.

        Raises:
            PathError: There is no such metric.

        """
        metrics = self.metrics[device]
        metric = metrics.get(found.name) if found.name else self._by_alias.get(found.alias)  # some send an empty name
        if metric is None or metrics.get(metric.name) is not metric:
            what = repr(found.name[:100]) if found.name else f"alias {found.alias}"
            raise PathError(f"{device}: there is no metric {what}")
        return metric

    def _fill(self, found: wire.Metric, sample: Sample) -> None:
        found.timestamp = sample.at_ms
        sample.metric.put(found, sample.value)
        put_quality(found, sample.quality, sample.reason)

    def _put_session(self, payload: wire.Payload) -> None:
        payload.metrics.add(name="bdSeq", timestamp=self._now_ms(), datatype=INT64, long_value=self._session)

    def _message(self, payload: wire.Payload, kind: str, device: str = "") -> Message:
        return Message(self._topic(kind, device), payload.SerializeToString(), 0, retain=False)

    def _next(self) -> int:
        number, self._sequence = self._sequence, (self._sequence + 1) % _SEQUENCE
        return number

    def _topic(self, kind: str, device: str = "") -> str:
        return "/".join((NAMESPACE, self._group, kind, self._node, *((device,) if device else ())))
