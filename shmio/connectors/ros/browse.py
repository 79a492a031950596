"""Lists the fields of topics, with the types and addresses that a tag table needs.

A type says which fields a message has, and only a message says how long its sequences are. So
``browse`` waits for a message of each topic whose type has sequences. It leaves out headers, whose
time stamp is the source time of all registers, and the layouts of arrays.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

from shmio.connectors.browsing import Browsed, Offer, Wanted
from shmio.connectors.ros.addresses import MAX_STEPS, FieldError, folded, parse
from shmio.connectors.ros.messages import DEFINITIONS, PRIMITIVES, plain

MAX_TEXT: Final = 254
MAX_ELEMENTS: Final = 10_000
"""Largest number of elements of a sequence that are offered."""
_LEFT_OUT: Final = frozenset({"std_msgs/Header", "std_msgs/MultiArrayLayout"})
_TYPES: Final = {
    "bool": "BOOL", "string": "STRING", "float32": "REAL", "float64": "LREAL",
    "int8": "SINT", "int16": "INT", "int32": "DINT", "int64": "LINT",
    "uint8": "USINT", "uint16": "UINT", "uint32": "UDINT", "uint64": "ULINT",
}  # fmt: skip


@dataclass
class Seen:
    """A topic, as the domain or the server describes it.

    Attributes:
        type: The type of the topic's messages.
        published: Whether a node publishes on it.
        stored: Whether a publisher stores its last messages for late subscribers.
        message: A message; None if none has arrived.

    """

    type: str
    published: bool = False
    stored: bool = False
    message: Any = None

    @property
    def known(self) -> bool:
        """Whether shmio knows the type."""
        return plain(self.type) in DEFINITIONS

    @property
    def awaited(self) -> bool:
        """Whether to wait for a message of this topic, because only a message shows the lengths of sequences."""
        return self.published and self.known and _has_sequence(plain(self.type))


def _has_sequence(kind: str) -> bool:
    if kind in _LEFT_OUT or kind in PRIMITIVES:
        return False
    return kind.endswith("[]") or any(map(_has_sequence, DEFINITIONS[kind].values()))


def levels(topic: str) -> tuple[str, ...]:
    """Return the levels of a topic's name."""
    return tuple(topic.strip("/").split("/"))


def browsed(topics: Mapping[str, Seen], wanted: Wanted, incomplete: str) -> Browsed:
    """Return those fields of topics that the user wants. ``incomplete`` says why there may be more."""
    offers = (offer for name in sorted(topics) for offer in _offers(name, topics))
    return Browsed([offer for offer in offers if wanted.takes(offer.names)], incomplete)


def _offers(name: str, topics: Mapping[str, Seen]) -> Iterator[Offer]:
    """Yield the fields of a topic."""
    topic, names = topics[name], levels(name)
    kind = plain(topic.type)
    if not topic.known:
        yield Offer(names, refused=f"shmio does not know the type {topic.type}")
        return
    columns: dict[str, object] = {}
    if topic.published and topic.stored:
        columns["comment"] = "its publisher stores its messages; name the topic in latched"
    elif not topic.published:
        columns = {"comment": "nobody publishes it yet", "writable": True}
    fields = [one for one, inner in DEFINITIONS[kind].items() if inner not in _LEFT_OUT]
    if fields == ["data"] and not any(other.startswith(f"{name}/") for other in topics):
        yield from _field(f"{name} {topic.type} ", names, DEFINITIONS[kind]["data"], "data", [topic.message], columns)
    else:
        yield from _fields(f"{name} {topic.type} ", names, kind, "", [topic.message], columns)


def _fields(
    prefix: str, names: tuple[str, ...], kind: str, path: str, scopes: list[Any], columns: Mapping[str, object]
) -> Iterator[Offer]:
    """Yield the fields of a message, the last of ``scopes``; the others are the messages that contain it."""
    for field, inner in DEFINITIONS[kind].items():
        if inner not in _LEFT_OUT:
            yield from _field(prefix, (*names, field), inner, f"{path}.{field}".lstrip("."), scopes, columns)


def _field(
    prefix: str, names: tuple[str, ...], kind: str, path: str, scopes: list[Any], columns: Mapping[str, object]
) -> Iterator[Offer]:
    """Yield a field, or what it consists of; ``path`` is its path in the address."""
    if path.count(".") >= MAX_STEPS:
        yield Offer(names, refused=f"it is nested deeper than {MAX_STEPS} levels")
        return
    message = scopes[-1]
    value = message.get(path.rpartition(".")[2]) if isinstance(message, dict) else None
    if not kind.endswith("[]"):
        yield from _value(prefix, names, kind, path, [*scopes, value], columns)
        return
    if not isinstance(value, list) or len(value) > MAX_ELEMENTS:
        why = "no message has arrived, so its length is unknown"
        yield Offer(names, refused=why if value is None else f"it is not a sequence of at most {MAX_ELEMENTS} elements")
        return
    if not value:
        yield Offer(names, refused="it is empty")
        return
    inner = kind.removesuffix("[]")
    keys = _keys(scopes, path.rpartition(".")[2], len(value))
    if keys is None and inner in PRIMITIVES:
        try:
            bounds = ", ".join(f"0..{size - 1}" for size in _shape(folded(value, message, path)))
        except FieldError as error:
            yield Offer(names, refused=str(error))
            return
        yield _offer(names, f"ARRAY[{bounds}] OF {_TYPES[inner]}", f"{prefix}{path}", columns)
        return
    for at, one in enumerate(value):
        step, name = (str(at), str(at)) if keys is None else (f"{keys[0]}={keys[1][at]}", keys[1][at])
        yield from _value(prefix, (*names, name), inner, f"{path}[{step}]", [*scopes, one], columns)


def _shape(found: Any) -> Iterator[int]:
    """Yield the sizes of nested lists."""
    while isinstance(found, list) and found:
        yield len(found)
        found = found[0]


def _value(
    prefix: str, names: tuple[str, ...], kind: str, path: str, scopes: list[Any], columns: Mapping[str, object]
) -> Iterator[Offer]:
    """Yield a value that is not a sequence; it is the last of ``scopes``."""
    if kind in PRIMITIVES:
        value = scopes[-1]
        if kind == "string" and isinstance(value, str) and len(value) > MAX_TEXT:
            yield Offer(names, refused="its text is too long")
        else:
            yield _offer(names, _TYPES[kind], f"{prefix}{path}", columns)
    else:
        yield from _fields(prefix, names, kind, path, scopes, columns)


def _keys(scopes: list[Any], field: str, size: int) -> tuple[str, list[str]] | None:
    """Return the sequence of names that name the elements of a sequence, and these names; None if there is none."""
    for scope in reversed(scopes):
        for name in ("name", "joint_names"):
            names = scope.get(name) if isinstance(scope, dict) else None
            if name != field and isinstance(names, list) and len(names) == size == len(set(map(str, names))):
                return name, [str(one) for one in names]
    return None


def _offer(names: tuple[str, ...], kind: str, address: str, columns: Mapping[str, object]) -> Offer:
    try:
        parse(address)
    except ValueError:
        return Offer(names, refused="an address cannot express its name")
    return Offer(names, kind, {"address": address, **columns})
