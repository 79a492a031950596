"""Lists the topics of a broker, with the types and addresses that a tag table needs.

:class:`Listener` listens to all messages for a limited time, and publishes nothing. It therefore
finds the metrics of a Sparkplug node only if the node sends its birth in that time.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Final

from google.protobuf.message import DecodeError

from shmio.connectors.browsing import Browsed, Offer, Wanted
from shmio.connectors.mqtt import address as addresses
from shmio.connectors.mqtt import metric
from shmio.connectors.mqtt.address import NAMESPACE, Metric, Place
from shmio.connectors.mqtt.faults import ValueFaultError
from shmio.connectors.mqtt.json_path import MAX_STEPS, Choice, Steps
from shmio.connectors.mqtt.options import MqttOptions
from shmio.connectors.mqtt.values import decode_json, is_number
from shmio.wire import sparkplug_b_pb2 as wire

MAX_BYTES: Final = 1 << 26
"""Maximum total size of the stored payloads, in bytes."""
MAX_TEXT: Final = 254
_WORDS: Final = frozenset({b"true", b"false", b"on", b"off"})
_KINDS: Final = {
    1: "SINT", 2: "INT", 3: "DINT", 4: "LINT", 5: "USINT", 6: "UINT", 7: "UDINT", 8: "ULINT", 9: "REAL", 10: "LREAL",
    11: "BOOL", 12: "STRING", 13: "ULINT", 14: "STRING", 15: "STRING", 22: "SINT", 23: "INT", 24: "DINT", 25: "LINT",
    26: "USINT", 27: "UINT", 28: "UDINT", 29: "ULINT", 30: "REAL", 31: "LREAL", 32: "BOOL", 33: "STRING", 34: "ULINT",
}  # fmt: skip
_FIRST_ARRAY: Final = 22
_NAMING: Final = ("id", "name")
"""Members that name the objects of an array."""


class Listener:
    """Keeps the newest message of each topic."""

    def __init__(self, options: MqttOptions, wanted: Wanted) -> None:
        self._max_bytes, self._wanted = options.max_payload_bytes, wanted
        self._changed = threading.Condition()
        self._payloads: dict[str, bytes | None] = {}
        """The newest payload of each topic; None if the payload is too large."""
        self._size = 0
        self.incomplete = ""

    def take(self, topic: str, payload: bytes, *, retained: bool) -> None:  # noqa: ARG002  both kinds count
        """Store a message. The thread of the connection calls this."""
        sparkplug = topic.startswith(f"{NAMESPACE}/")
        if not sparkplug and not self._wanted.enters(_levels(topic)):
            return
        kept = payload if len(payload) <= self._max_bytes else None
        with self._changed:
            size = self._size + len(kept or b"") - len(self._payloads.get(topic) or b"")
            if (topic not in self._payloads and len(self._payloads) >= self._wanted.nodes) or size > MAX_BYTES:
                self.incomplete = "there are more topics; select some of them by a PATTERN, or raise --limit"
                self._changed.notify_all()
                return
            self._payloads[topic], self._size = kept, size

    def wait(self, until_s: float) -> None:
        """Listen until ``until_s`` (CLOCK_MONOTONIC, in s), or until the messages exceed a limit."""
        with self._changed:
            self._changed.wait_for(lambda: self.incomplete, max(0.0, until_s - time.monotonic()))

    def found(self) -> Browsed:
        """Return the values in the messages received so far."""
        with self._changed:
            payloads = dict(sorted(self._payloads.items()))
        groups = {topic[:at] for topic in payloads for at in range(len(topic)) if topic[at] == "/"}
        offers: list[Offer] = []
        quiet: set[str] = set()
        for topic, payload in payloads.items():
            if topic.startswith(f"{NAMESPACE}/"):
                offers += _metrics(topic, payload, payloads, quiet)
            else:
                names = (*_levels(topic), *(["value"] if topic in groups else []))
                offers += _values(topic, names, payload, self._wanted.depth)
        incomplete = self.incomplete
        if quiet and not incomplete:
            incomplete = f"no birth has arrived from {', '.join(sorted(quiet)[:5])}; list again when the node sends one"
        return Browsed([one for one in offers if self._wanted.takes(one.names)], incomplete)


def _levels(topic: str) -> tuple[str, ...]:
    """Return the levels of a topic as names; an empty level becomes ``_``."""
    return tuple(level or "_" for level in topic.split("/"))


def _values(topic: str, names: tuple[str, ...], payload: bytes | None, depth: int) -> Iterator[Offer]:
    """Yield the values in the payload of a topic."""
    if payload is None:
        yield Offer(names, refused="its payload is larger than max_payload_bytes")
        return
    try:
        document = decode_json(payload)
    except ValueFaultError:
        document = None
    if isinstance(document, dict | list):
        yield from _members(topic, names, document, (), depth)
        return
    text = payload.strip()
    if not text:
        yield Offer(names, refused="its payload is empty")
    elif text.lower() in _WORDS:
        yield _offer(names, "BOOL", Place(topic, None))
    elif is_number(text):
        yield _offer(names, "LREAL", Place(topic, None))
    else:
        try:
            kind = _text(payload.decode())
        except UnicodeDecodeError:
            kind = ""
        yield (
            _offer(names, kind, Place(topic, None))
            if kind
            else Offer(names, refused="its payload is binary, or text that is too long")
        )


def _members(topic: str, names: tuple[str, ...], found: Any, steps: Steps, depth: int) -> Iterator[Offer]:
    """Yield the values in a part of a JSON document; ``steps`` is the path of this part."""
    kind = _kind(found)
    if kind:
        yield _offer(names, kind, Place(topic, steps))
    elif found is None:
        yield Offer(names, refused="it is null, so its type is unknown")
    elif isinstance(found, str) or not found:
        yield Offer(names, refused="it is empty" if not found else "its text is too long")
    elif len(steps) >= min(depth, MAX_STEPS):
        yield Offer(names, refused=f"it is nested deeper than {len(steps)} levels")
    else:
        inside: Iterable[tuple[str | int | Choice, Any]] = (
            found.items() if isinstance(found, dict) else _elements(found)
        )
        for step, one in inside:
            name = step.text if isinstance(step, Choice) else str(step)
            yield from _members(topic, (*names, name or "_"), one, (*steps, step), depth)


def _elements(found: list[Any]) -> Iterable[tuple[int | Choice, Any]]:
    """Return the elements of an array, by a member that names each of them; else by their indices.

    An index may be another object in the next message, because some devices send only objects that have changed.
    """
    for key in _NAMING:
        texts = [one[key] for one in found if isinstance(one, dict) and isinstance(one.get(key), str)]
        if len({*texts}) == len(found):
            return [(Choice(key, text), one) for text, one in zip(texts, found, strict=True)]
    return enumerate(found)


def _kind(found: Any) -> str:
    """Return the type of a register for a JSON value; "" if a register cannot hold it."""
    if isinstance(found, bool):
        return "BOOL"
    if isinstance(found, int | float):
        return "LREAL"  # the next value may not be a whole number
    if isinstance(found, str):
        return _text(found)
    if isinstance(found, list) and found and not isinstance(found[0], list):
        kinds = {_kind(one) for one in found}
        if len(kinds) == 1 and (kind := kinds.pop()) in ("BOOL", "LREAL", "STRING"):
            return f"ARRAY[0..{len(found) - 1}] OF {kind}"
    return ""


def _text(found: str) -> str:
    return "STRING" if found and len(found) <= MAX_TEXT else ""


def _metrics(topic: str, payload: bytes | None, all_topics: Mapping[str, object], quiet: set[str]) -> Iterator[Offer]:
    """Yield the metrics in a Sparkplug message, if it is a birth.

    If it has data, and no birth of its node or device has arrived, add this node or device to
    ``quiet``.
    """
    levels = topic.split("/")
    if not 4 <= len(levels) <= 5 or levels[2] not in ("NBIRTH", "DBIRTH", "NDATA", "DDATA"):
        return
    owner = (levels[1], *levels[3:])
    if levels[2].endswith("DATA"):
        birth = "/".join([levels[0], levels[1], f"{levels[2][0]}BIRTH", *levels[3:]])
        if birth not in all_topics:
            quiet.add("/".join(owner))
        return
    try:
        metrics: Sequence[wire.Metric] = wire.Payload.FromString(payload or b"\xff").metrics
    except DecodeError:
        yield Offer(owner, refused="its birth is not a Sparkplug payload, or is too large")
        return
    for one in metrics:
        # Protobuf gives a name that is not UTF-8 as bytes.
        if not isinstance(one.name, str) or one.name in {"", "bdSeq"}:
            continue
        names = (*owner, *_levels(one.name))
        kind = _KINDS.get(one.datatype, "")
        if kind and one.datatype >= _FIRST_ARRAY:
            kind = _array(one, kind)
        address = Metric(levels[1], levels[3], levels[4] if len(levels) == 5 else "", one.name)
        yield (
            _offer(names, kind, address)
            if kind
            else Offer(names, refused=f"a register cannot hold data type {one.datatype}")
        )


def _array(one: wire.Metric, kind: str) -> str:
    try:
        size = len(metric.decode(one, one.datatype))
    except ValueFaultError:
        size = 0
    return f"ARRAY[0..{size - 1}] OF {kind}" if size else ""


def _offer(names: tuple[str, ...], kind: str, source: Place | Metric) -> Offer:
    """Return the offer of a value with its address. The offer is refused if no address can name the value."""
    text = _address(source)
    try:
        readable = addresses.parse(text).source == source
    except ValueError:
        readable = False
    return (
        Offer(names, kind, {"address": text})
        if readable
        else Offer(names, refused="an address cannot express its name")
    )


def _address(source: Place | Metric) -> str:
    if isinstance(source, Metric):
        return f"sparkplug {source.owner} metric {source.name}"
    if source.steps is None:
        return source.topic
    return f"{source.topic} ${''.join(map(_step, source.steps))}"


def _step(step: str | int | Choice) -> str:
    if isinstance(step, Choice):
        return f"[{step.key}='{step.text}']"
    if isinstance(step, int):
        return f"[{step}]"
    if not set(step) & set(".[]'\" "):
        return f".{step}"
    return f'["{step}"]' if "'" in step else f"['{step}']"
