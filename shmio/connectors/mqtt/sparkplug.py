"""Sparkplug B as a host application sees it: births, data and deaths of edge nodes. No I/O.

The messages of a node may name metrics by aliases, which its birth defines. shmio therefore uses a
node's data only after its birth, and only while its sequence numbers have no gap: in a gap, another
birth may have been lost. After a gap, all registers of the node are bad, and shmio asks the node for
a new birth (Eclipse Sparkplug Specification 3.0.0, 5 and 6).
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any, Final, NamedTuple

import msgspec
from google.protobuf.message import DecodeError

from shmio.backoff import Backoff
from shmio.connectors.mqtt import metric
from shmio.connectors.mqtt.address import NAMESPACE, Metric
from shmio.connectors.mqtt.faults import ValueFaultError
from shmio.connectors.mqtt.quality import from_number
from shmio.connectors.mqtt.topic import Found, Message, Origin
from shmio.model.statuses import (
    BAD_CONFIGURATION_ERROR,
    BAD_NO_COMMUNICATION,
    BAD_NOT_FOUND,
    BAD_WAITING_FOR_INITIAL_DATA,
    GOOD,
    UNREADABLE_TIME,
)
from shmio.wire import sparkplug_b_pb2 as wire

REBIRTH: Final = "Node Control/Rebirth"
MAX_METRICS: Final = 100_000
"""Maximum number of metrics in a message."""
MAX_ALIASES: Final = 1_000_000
"""Maximum number of aliases of a node with all its devices."""
ASK: Final = Backoff(1.0, 60.0)
"""The waiting times before shmio asks a node again for its birth."""
CALM_NS: Final = 120_000_000_000
"""The waiting times start again with the shortest if shmio has not asked the node for this time in ns."""
KINDS: Final = ("NBIRTH", "NDATA", "NDEATH", "DBIRTH", "DDATA", "DDEATH")
_SEQUENCE: Final = 256
_MAX_MS: Final = ((1 << 63) - 1) // 1_000_000

log = logging.getLogger("shmio.source.mqtt")


class _Known(NamedTuple):
    """The definition of a metric in a birth."""

    name: str
    alias: int | None
    datatype: int
    field: str | None
    """The field of the protobuf message that has the value; None if the value was null."""


class Device(Origin):
    """A device of a node, or the node itself."""

    def __init__(self, node: Node, name: str) -> None:
        self.node, self.name = node, name
        self.wanted: dict[str, list[int]] = {}
        """For each metric, by name, the indices of the registers that have the metric's value."""
        self.metrics: dict[str, _Known] = {}
        """The birth's definitions of the metrics that registers have, by name."""
        self.born = False
        self.died = False
        self.missed = False
        """True if a register was added after the last birth, whose definition of the register's metric was not kept."""
        self._birth_order = 0
        self._found: dict[int, tuple[Found | ValueFaultError, int]] = {}

    def __str__(self) -> str:
        return f"{self.node}/{self.name}" if self.name else str(self.node)

    @property
    def fault(self) -> int:
        """The status that makes all of the device's registers bad; GOOD if there is none."""
        if self.born:
            return GOOD
        return BAD_NO_COMMUNICATION if self.died else BAD_WAITING_FOR_INITIAL_DATA

    @property
    def offline(self) -> str:
        """Why a command would not reach the device; empty if the device is online."""
        if self.born:
            return ""
        return f"{self} is not online: it {'has died' if self.died else 'has sent no birth'}"

    def order_of(self, index: int) -> int:
        """Return the ``order`` of the message with the newest value of a register."""
        found = self._found.get(index)
        return self._birth_order if found is None else found[1]

    def find(self, index: int) -> Found:
        """Return the newest value of a register.

        Raises:
            ValueFaultError: The birth has no such metric, or the metric has no usable value.

        """
        found = self._found.get(index)
        if found is None and self.missed:
            raise ValueFaultError(
                BAD_WAITING_FOR_INITIAL_DATA, f"{self} has sent no birth since the register was added"
            )
        if found is None:
            raise ValueFaultError(BAD_NOT_FOUND, f"the birth of {self} does not contain the metric of this register")
        if isinstance(found[0], ValueFaultError):
            raise found[0]
        return found[0]

    def reset(self) -> None:
        """Forget all messages."""
        self.message = None
        self.end(died=False)

    def end(self, *, died: bool) -> None:
        """Discard the device's values and metrics until its next birth. ``died`` is true if the device has died."""
        self.born, self.died, self.missed = False, died, False
        self.metrics.clear()
        self._found.clear()

    def inherit(self, other: Device) -> None:
        """Take over the values of ``other``, the same device in the layout before a reload."""
        self.born, self.died, self.message = other.born, other.died, other.message
        self._birth_order = other._birth_order
        self.metrics = {name: known for name, known in other.metrics.items() if name in self.wanted}
        for name, places in self.wanted.items():
            before = other.wanted.get(name)
            if before is not None and (found := other._found.get(before[0])) is not None:
                self._found |= dict.fromkeys(places, found)
        self.missed = other.missed or (other.born and not self.wanted.keys() <= other.wanted.keys())

    def begin(self, order: int) -> None:
        """Discard all earlier values and metrics, because a birth of the device follows."""
        self.end(died=False)
        self.born, self._birth_order = True, order

    def take(self, known: _Known, one: wire.Metric, message: Message, sent_ms: int | None) -> None:
        """Store the value of a metric, which a message has reported, for the metric's registers."""
        at_ms = one.timestamp if one.HasField("timestamp") else sent_ms
        source_ns, doubt = message.utc_ns, ""
        if at_ms is not None and 0 < at_ms <= _MAX_MS:
            source_ns = at_ms * 1_000_000
        elif at_ms is not None:
            doubt = f"its time {at_ms} cannot be read"
        found: Found | ValueFaultError
        try:
            code, reason = _quality(one)
            if doubt and code == GOOD:
                code, reason = UNREADABLE_TIME, doubt
            found = Found(metric.decode(one, known.datatype), source_ns, code, reason=reason)
        except ValueFaultError as error:
            error.source_ns = source_ns
            found = error
        for index in self.wanted[known.name]:
            self._found[index] = found, message.order

    def refuse(self, known: _Known, reason: str, message: Message) -> None:
        """Make the registers of a metric bad until a message has the metric's value by its name."""
        for index in self.wanted[known.name]:
            self._found[index] = ValueFaultError(BAD_CONFIGURATION_ERROR, reason), message.order

    def command(self, values: Mapping[str, Any], now_ms: int) -> tuple[str, bytes]:
        """Return topic and payload of a command that sets metrics to values. ``values`` are by metric name.

        Raises:
            ValueError: The device is offline, or a value does not fit its metric.

        """
        payload = wire.Payload(timestamp=now_ms)
        for name, value in values.items():
            known = self.metrics.get(name)
            if known is None:
                raise ValueError(self.offline or f"the birth of {self} has no metric {name!r}")
            one = payload.metrics.add(timestamp=now_ms)
            if known.alias is None:
                one.name = name
            else:
                one.alias = known.alias
            metric.encode(one, known.datatype, value, known.field)
        return self.node.topic("DCMD" if self.name else "NCMD", self.name), payload.SerializeToString()


class Node:
    """A Sparkplug edge node, with its devices."""

    def __init__(self, group: str, name: str) -> None:
        self._group, self._name = group, name
        self.devices: dict[str, Device] = {}
        self._aliases: dict[str, dict[int, _Known | None]] = {}
        """The metrics of each device by their aliases; None for a metric that no register has."""
        self._alias_owners: dict[int, str] = {}
        """The device that announced an alias last."""
        self._shares_aliases = False
        """True if the log says that two devices have announced the same alias."""
        self._asks = 0
        self._asked_ns = -CALM_NS
        self.reset()

    def __str__(self) -> str:
        return f"{self._group}/{self._name}"

    def topic(self, kind: str, device: str = "") -> str:
        """Return the topic on which the node, or one of its devices, sends messages of a kind such as ``DDATA``."""
        return "/".join((NAMESPACE, self._group, kind, self._name, *((device,) if device else ())))

    @property
    def filters(self) -> list[str]:
        """The topic filters for all messages of the node.

        Messages of all kinds are numbered together. If the client did not subscribe to one kind,
        messages would seem to be lost.
        """
        return [self.topic(kind, "+" if kind.startswith("D") else "") for kind in KINDS]

    @property
    def born(self) -> bool:
        """True if the node has sent a birth, and no message since then is missing."""
        return self._born

    def device(self, name: str) -> Device:
        """Return the device with this name; an empty name is the node itself."""
        return self.devices.setdefault(name, Device(self, name))

    def reset(self) -> None:
        """Forget all messages, and remember to ask the node for its birth."""
        self._born, self._ask = False, True
        self._session: int | None = None
        self._next: int | None = None
        self._forget_aliases()
        for device in self.devices.values():
            device.reset()

    def inherit(self, other: Node) -> None:
        """Take over the values of ``other``, the same node in the layout before a reload.

        ``other`` has not kept the definitions of metrics that no register had. So if the new layout
        has further metrics, shmio must ask for a birth.
        """
        self._born, self._ask, self._session, self._next = other._born, other._ask, other._session, other._next
        self._asks, self._asked_ns = other._asks, other._asked_ns
        for name, device in self.devices.items():
            if (before := other.devices.get(name)) is not None:
                device.inherit(before)
            else:
                device.missed = self._born
        self._alias_owners, self._shares_aliases = {**other._alias_owners}, other._shares_aliases
        for name, aliases in other._aliases.items():
            wanted = self.devices[name].wanted if name in self.devices else {}
            self._aliases[name] = {
                alias: known if known is not None and known.name in wanted else None for alias, known in aliases.items()
            }
        self._ask = self._ask or any(device.missed for device in self.devices.values())

    # -- messages ------------------------------------------------------------------------------------------------------

    def take(self, kind: str, device: str, message: Message) -> None:
        """Process a message of the node or of one of its devices."""
        payload = self._payload(message)
        if payload is None:
            self._lose("it sent a message that is not a Sparkplug payload")
        elif kind == "NDEATH":
            self._death(payload)
        elif kind == "NBIRTH":
            self._birth(payload, message)
        elif not self._born:
            self._ask = True
        elif self._in_sequence(payload):
            for one in self.devices.values():
                one.message = message
            self._device_message(kind, device, payload, message)

    def _forget_aliases(self) -> None:
        self._aliases.clear()
        self._alias_owners.clear()

    def _payload(self, message: Message) -> wire.Payload | None:
        try:
            payload = wire.Payload.FromString(message.payload)
        except DecodeError:
            return None
        return payload if len(payload.metrics) <= MAX_METRICS else None

    def _birth(self, payload: wire.Payload, message: Message) -> None:
        self._forget_aliases()
        for one in self.devices.values():
            one.end(died=False)
            one.message = message
        self._session = _session(payload)
        self._next = (payload.seq + 1) % _SEQUENCE if payload.HasField("seq") else None
        self._born, self._ask = True, False
        self.device("")
        self._begin("", payload, message)

    def _death(self, payload: wire.Payload) -> None:
        session = _session(payload)
        if self._born and session is not None and self._session is not None and session != self._session:
            log.info("%s: the last will of an earlier session is ignored", self)
            return
        self._born, self._ask = False, False  # the node sends its birth when it is back
        for one in self.devices.values():
            one.end(died=True)

    def _in_sequence(self, payload: wire.Payload) -> bool:
        if not payload.HasField("seq"):
            return True
        if self._next is not None and payload.seq != self._next:
            self._lose(f"a message is missing: its number is {payload.seq}, not {self._next}")
            return False
        self._next = (payload.seq + 1) % _SEQUENCE
        return True

    def _device_message(self, kind: str, name: str, payload: wire.Payload, message: Message) -> None:
        device = self.devices.get(name)
        if kind == "DBIRTH":
            self._begin(name, payload, message)
        elif kind == "DDEATH":
            if device is not None:
                device.end(died=True)
        elif device is not None and device.missed and not device.born:
            return  # shmio has asked for its birth
        elif device is not None and not device.born:
            self._lose(f"{device} sends data without a birth")
        else:
            self._data(name, payload, message)

    def _begin(self, name: str, payload: wire.Payload, message: Message) -> None:
        """Process the metrics of the birth of a device, or of the node itself if ``name`` is empty."""
        device = self.devices.get(name)
        for before in self._aliases.pop(name, ()):
            if self._alias_owners.get(before) == name:
                del self._alias_owners[before]
        aliases: dict[int, _Known | None] = {}
        if device is not None:
            device.begin(message.order)
        counts = Counter(one.alias for one in payload.metrics if one.HasField("alias"))
        for one in payload.metrics:
            alias = one.alias if one.HasField("alias") else None
            shared = alias is not None and counts[alias] > 1
            wanted = device is not None and one.name in device.wanted
            known = _Known(one.name, None if shared else alias, one.datatype, one.WhichOneof("value"))
            if alias is not None:
                aliases[alias] = known if wanted and not shared else None
                self._check_alias(alias, name)
            if wanted and device is not None:
                device.metrics[one.name] = known
                device.take(known, one, message, _sent_ms(payload))
                if shared:
                    device.refuse(known, f"the birth of {device} has the alias {alias} for several metrics", message)
        if aliases:
            self._aliases[name] = aliases
        if sum(map(len, self._aliases.values())) > MAX_ALIASES:
            self._lose(f"it has more than {MAX_ALIASES} metrics")
            self._forget_aliases()

    def _check_alias(self, alias: int, name: str) -> None:
        """Log that another device of the node has announced the same alias, which breaks the standard."""
        other = self._alias_owners.setdefault(alias, name)
        if other != name and not self._shares_aliases:
            log.warning(
                "%s: the births of %s and of %s have the same alias %d, which breaks the standard; shmio takes the "
                "device from the topic", self, _owner(other), _owner(name), alias,
            )  # fmt: skip
            self._shares_aliases = True

    def _data(self, name: str, payload: wire.Payload, message: Message) -> None:
        device, aliases = self.devices.get(name), self._aliases.get(name, {})
        for one in payload.metrics:
            if one.is_historical:
                continue
            if one.name:
                known = device.metrics.get(one.name) if device is not None else None
            elif not one.HasField("alias"):
                self._lose("a metric has neither a name nor an alias")
                return
            elif one.alias not in aliases:
                self._lose(f"no birth of {_owner(name)} has the alias {one.alias}")
                return
            else:
                known = aliases[one.alias]
            if device is not None and known is not None:
                device.take(known, one, message, _sent_ms(payload))

    def _lose(self, why: str) -> None:
        """Discard all values of the node until its next birth, and note that shmio must ask for this birth."""
        log.warning("%s: %s; shmio asks the node for a new birth", self, why)
        self._born, self._ask = False, True
        for one in self.devices.values():
            one.end(died=False)

    def request(self, now_ns: int) -> tuple[str, bytes] | None:
        """Return topic and payload of the command that asks for a birth; None if none is due."""
        if not self._ask or now_ns - self._asked_ns < self._wait_ns:
            return None
        self._asks = self._asks + 1 if now_ns - self._asked_ns < CALM_NS else 0
        self._asked_ns = now_ns
        now_ms = time.time_ns() // 1_000_000
        payload = wire.Payload(timestamp=now_ms)
        payload.metrics.add(name=REBIRTH, timestamp=now_ms, datatype=metric.BOOLEAN, boolean_value=True)
        return self.topic("NCMD"), payload.SerializeToString()

    @property
    def _wait_ns(self) -> int:
        return round(ASK.wait_s(self._asks) * 1e9)


class Host:
    """All Sparkplug nodes of a layout."""

    def __init__(self, *, max_bytes: int) -> None:
        """Start without nodes. A message of more than ``max_bytes`` counts as unreadable."""
        self._max_bytes = max_bytes
        self._nodes: dict[tuple[str, str], Node] = {}

    def origin(self, address: Metric, index: int) -> Device:
        """Return the node or device of a metric, and remember that the register ``index`` has the metric's value."""
        node = self._nodes.setdefault((address.group, address.node), Node(address.group, address.node))
        device = node.device(address.device)
        device.wanted.setdefault(address.name, []).append(index)
        return device

    def __bool__(self) -> bool:
        return bool(self._nodes)

    def __len__(self) -> int:
        return len(self._nodes)

    @property
    def filters(self) -> list[str]:
        """The topic filters to subscribe to."""
        return [one for node in self._nodes.values() for one in node.filters]

    @property
    def complete(self) -> bool:
        """True if all nodes and devices have sent their births."""
        return all(node.born and all(device.born for device in node.devices.values()) for node in self._nodes.values())

    def take(self, message: Message, topic: str) -> None:
        """Process a message, except for a retained one, which may be from an earlier session."""
        levels = topic.split("/")
        if message.retained or not 4 <= len(levels) <= 5 or levels[2] not in KINDS:
            return
        node = self._nodes.get((levels[1], levels[3]))
        if node is None or (len(levels) == 5) != levels[2].startswith("D"):
            return
        if len(message.payload) > self._max_bytes:
            message = msgspec.structs.replace(message, payload=b"\xff")
        node.take(levels[2], levels[4] if len(levels) == 5 else "", message)

    def requests(self, now_ns: int) -> Iterator[tuple[str, bytes]]:
        """Yield topic and payload of each request for a birth that is due."""
        for node in self._nodes.values():
            if (found := node.request(now_ns)) is not None:
                yield found

    def inherit(self, other: Host) -> None:
        """Take over the values of the nodes that the layout before a reload had, too."""
        for key, node in self._nodes.items():
            if (before := other._nodes.get(key)) is not None:
                node.inherit(before)

    def reset(self) -> None:
        """Forget all messages."""
        for node in self._nodes.values():
            node.reset()


def _session(payload: wire.Payload) -> int | None:
    """Return the session number in a birth or a last will; None if it has none.

    A last will belongs to the birth with the same number.
    """
    for one in payload.metrics:
        if one.name == "bdSeq":
            field = one.WhichOneof("value")
            found = getattr(one, field) if field else None
            return found if isinstance(found, int) else None
    return None


def _owner(device: str) -> str:
    return repr(device) if device else "the node"


def _sent_ms(payload: wire.Payload) -> int | None:
    return payload.timestamp if payload.HasField("timestamp") else None


def _quality(one: wire.Metric) -> tuple[int, str]:
    """Return the status that a metric states in its property Quality, and what the status does not say.

    The specification has 0, 192 and 500 (6.4.8.1). Gateways send other numbers of OPC, too.
    """
    for key, value in zip(one.properties.keys, one.properties.values, strict=False):
        if key == "Quality":
            field = value.WhichOneof("value")
            found: Any = None if field is None or value.is_null else getattr(value, field)
            if found is not None and field in ("int_value", "long_value"):
                bits = 32 if field == "int_value" else 64
                found -= (found >> bits - 1) << bits
            return from_number(found)
    return GOOD, ""
