"""Convert values, declared injections and events to messages of ``shmio.v1``, and back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from shmio.errors import ValueRangeError
from shmio.model.event import Event, EventKind
from shmio.model.values import Quality
from shmio.wire import shmio_v1_pb2 as wire
from shmio.wording import unknown

_OPERATIONS: Final[Mapping[str, Mapping[str, str]]] = {
    "set": {"value": ""},
    "offset": {"value": ""},
    "scale": {"value": ""},
    "clamp": {"min": "min", "max": "max"},
    "noise": {"amplitude": "amplitude", "distribution": "distribution"},
    "random": {"values": "values", "min": "min", "max": "max"},
    "freeze": {},
    "delay": {"delay_ms": "ms", "delay_cycles": "cycles"},
    "drop": {},
    "flip": {"bits": "bits"},
}
"""For each operation of a declaration, its keys and the corresponding fields of its message.

An operation whose only key is ``value`` has no message of its own: the field is the value itself.
"""
_COMMON: Final = ("probability", "start_s", "end_s", "when", "for_s", "times", "seed", "priority")
_DISTRIBUTIONS: Final = {"uniform": wire.Noise.DISTRIBUTION_UNIFORM, "gaussian": wire.Noise.DISTRIBUTION_GAUSSIAN}


def value_to_wire(value: object, path: str) -> wire.Value:
    """Convert a Python or numpy value to a message.

    Args:
        value: The value.
        path: Path of the register, for error messages.

    Raises:
        ValueRangeError: Values of this kind cannot be sent.

    """
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, bool):
        return wire.Value(boolean=value)
    if isinstance(value, int):
        if -(1 << 63) <= value < 1 << 63:
            return wire.Value(integer=value)
        if 0 <= value < 1 << 64:
            return wire.Value(unsigned=value)
        raise ValueRangeError(f"{path}: {value} has more than 64 bits")
    if isinstance(value, float):
        return wire.Value(number=value)
    if isinstance(value, str):
        return wire.Value(text=value)
    if isinstance(value, (list, tuple)):
        return wire.Value(list=wire.List(values=[value_to_wire(item, path) for item in value]))
    raise ValueRangeError(f"{path}: a Python {type(value).__name__} cannot be the value of a register")


def value_from_wire(value: wire.Value, path: str) -> object:
    """Convert a message to a Python value.

    ``path`` is the path of the register, for error messages.

    Raises:
        ValueRangeError: The message has no value.
    """
    kind = value.WhichOneof("kind")
    if kind is None:
        raise ValueRangeError(f"{path}: no value is given")
    if kind == "list":
        return [value_from_wire(item, path) for item in value.list.values]
    found: object = getattr(value, kind)
    return found


def declaration_to_wire(table: Mapping[str, Any], key: str) -> wire.Declaration:
    """Convert an ``[[injection]]`` table to a message.

    Args:
        table: The table.
        key: The key of the table, for error messages.

    Raises:
        ValueRangeError: A key is unknown, or a value cannot be sent.

    """
    left = dict(table)
    operation = left.pop("operation", None)
    own = _OPERATIONS.get(operation) if isinstance(operation, str) else None
    if own is None:
        raise ValueRangeError(f"{key}.operation: {unknown('operation', operation, _OPERATIONS)}")
    target = left.pop("target", [])
    try:
        found = wire.Declaration(name=left.pop("name", ""), targets=[target] if isinstance(target, str) else target)
        for name in _COMMON:
            if (value := left.pop(name, None)) is not None:
                setattr(found, name, value)
        given = {name: value for name in own if (value := left.pop(name, None)) is not None}
        if own.get("value") is None:
            part = getattr(found, str(operation))
            part.SetInParent()
            for name, value in given.items():
                _set(part, own[name], value, f"{key}.{name}")
        elif "value" in given:
            getattr(found, str(operation)).CopyFrom(value_to_wire(given["value"], f"{key}.value"))
        else:
            raise ValueRangeError(f"{key}.value: this key is needed for operation {operation!r}")
    except ValueRangeError:
        raise
    except (TypeError, ValueError) as error:
        raise ValueRangeError(f"{key}: {error}") from None
    if left:
        raise ValueRangeError(f"{key}.{next(iter(left))}: operation {operation!r} has no such key")
    return found


def _set(part: Any, field: str, value: Any, key: str) -> None:
    if field == "values":
        part.values.extend(value_to_wire(item, key) for item in value)
    elif field == "bits":
        part.bits.extend(value)
    elif field == "distribution":
        if value not in _DISTRIBUTIONS:
            raise ValueRangeError(f"{key}: {unknown('distribution', value, _DISTRIBUTIONS)}")
        part.distribution = _DISTRIBUTIONS[value]
    else:
        setattr(part, field, value)


def declaration_from_wire(found: wire.Declaration, key: str) -> dict[str, Any]:
    """Convert a message to an ``[[injection]]`` table, without checking it.

    Args:
        found: The message.
        key: The key of the table, for error messages.

    Raises:
        ValueRangeError: A value is missing.

    """
    targets = list(found.targets)
    table: dict[str, Any] = {"name": found.name, "target": targets[0] if len(targets) == 1 else targets}
    operation = found.WhichOneof("operation")
    if operation is not None:
        table["operation"] = operation
        table |= _own(getattr(found, operation), operation, key)
    for name in _COMMON:
        if name == "priority":
            table |= {name: found.priority} if found.priority else {}
        elif found.HasField(name):
            table[name] = getattr(found, name)
    return table


def _own(part: Any, operation: str, key: str) -> dict[str, Any]:
    if "value" in _OPERATIONS[operation]:
        return {"value": value_from_wire(part, f"{key}.value")}
    if operation == "noise":
        words = {number: word for word, number in _DISTRIBUTIONS.items()}
        noise = {"amplitude": part.amplitude}
        return noise | ({"distribution": words.get(part.distribution, "?")} if part.distribution else {})
    own: dict[str, Any] = {}
    for name, field in _OPERATIONS[operation].items():
        if field == "values":
            own |= {name: [value_from_wire(item, f"{key}.values") for item in part.values]} if part.values else {}
        elif field == "bits":
            own |= {name: list(part.bits)} if part.bits else {}
        elif part.HasField(field):
            own[name] = getattr(part, field)
    return own


_KINDS: Final = {
    number: EventKind(name.removeprefix("KIND_").lower()) for name, number in wire.Event.Kind.items() if number
}
_DIRECTIONS: Final = {"out": wire.DIRECTION_OUT, "in": wire.DIRECTION_IN}


def event_to_wire(event: Event) -> wire.Event:
    """Convert an event to a message."""
    found = wire.Event(
        source=event.source,
        kind="KIND_UNSPECIFIED" if event.kind is EventKind.OTHER else f"KIND_{event.kind.name}",
        number=event.number,
        frame=event.frame,
        cycle=event.cycle,
        incarnation=event.incarnation,
        clock_ns=event.clock_ns,
        utc_ns=event.utc_ns,
        quality=f"QUALITY_{event.quality.name}",
        text=event.text,
        injection=event.injection,
        command=event.command,
        by=event.by,
        direction=_DIRECTIONS.get(event.direction),
        missed=event.missed,
    )
    for path in event.paths:
        register = found.registers.add(path=path)
        if path in event.values:
            register.value.CopyFrom(_found_to_wire(event.values[path], path))
    return found


def event_from_wire(found: wire.Event) -> Event:
    """Convert a message to an event."""
    return Event(
        found.source, _KINDS.get(found.kind, EventKind.OTHER), found.number, found.frame, found.cycle,
        found.incarnation, found.clock_ns, found.utc_ns,
        Quality(found.quality) if found.quality in wire.Quality.values() else Quality.BAD,
        found.text, found.injection, found.command, found.by,
        ("in" if found.direction == wire.DIRECTION_IN else "out") if found.HasField("direction") else "",
        tuple(one.path for one in found.registers),
        {one.path: _found_from_wire(one.value, one.path) for one in found.registers if one.HasField("value")},
        found.missed,
    )  # fmt: skip


def _found_to_wire(value: object, path: str) -> wire.Value:
    """Convert an event's value. None, which stands for invalid bytes, becomes a message without a value."""
    if value is None:
        return wire.Value()
    if isinstance(value, list):
        return wire.Value(list=wire.List(values=[_found_to_wire(item, path) for item in value]))
    return value_to_wire(value, path)


def _found_from_wire(value: wire.Value, path: str) -> object:
    kind = value.WhichOneof("kind")
    if kind == "list":
        return [_found_from_wire(item, path) for item in value.list.values]
    return None if kind is None else value_from_wire(value, path)
