"""Addresses of fields in messages: ``TOPIC TYPE FIELD``.

An example is ``/joint_states sensor_msgs/JointState position[name=j1]``. FIELD consists of names
joined by dots. After the name of a sequence, ``[2]`` selects its third element. ``[name=j1]``
selects the element with the index that ``j1`` has in the sequence ``name``. The sequence ``name`` is
in the same message as the selected sequence, or in a message that contains this message. A sequence
without brackets at the end of FIELD is a whole array.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from operator import itemgetter
from typing import Any, Final, NamedTuple

from shmio.connectors.ros.messages import DEFINITIONS, PRIMITIVES, TYPE, from_json, plain
from shmio.layout.values.codec import nest
from shmio.model.statuses import BAD_INDEX_RANGE_NO_DATA, BAD_NOT_FOUND, BAD_TYPE_MISMATCH

MAX_STEPS: Final = 8
EXAMPLE: Final = "expected TOPIC TYPE FIELD, such as /joint_states sensor_msgs/JointState position[name=joint_1]"
_TOPIC: Final = re.compile(r"(?:/[A-Za-z_][A-Za-z0-9_]*)+")
_STEP: Final = re.compile(
    r"(?P<name>[A-Za-z][A-Za-z0-9_]*)"
    r"(?:\[(?:(?P<index>[0-9]{1,5})|(?P<key>[A-Za-z][A-Za-z0-9_]*)=(?P<value>[^\[\]]{1,256}))\])?(?:\.(?=.)|$)"
)


class FieldError(Exception):
    """A message does not contain a field, or its value does not fit the register.

    ``code`` is the status of the register.
    """

    def __init__(self, code: int, reason: str) -> None:
        super().__init__(reason)
        self.code = code


class Step(NamedTuple):
    """The name of a field and, if the field is a sequence, the element that is selected.

    ``place`` is the element's index. ``key`` is a pair: the name of a sequence of names, and the
    name whose index in that sequence selects the element. At least one of the two is None.
    """

    name: str
    place: int | None = None
    key: tuple[str, str] | None = None

    @property
    def whole(self) -> bool:
        """True if the step selects no element."""
        return self.place is None and self.key is None


class Address(NamedTuple):
    """A field of a topic's messages.

    Attributes:
        topic: The topic's full name.
        type: The messages' type as written in the address.
        steps: The path of the field.
        text: The path as text, for messages to the user.

    """

    topic: str
    type: str
    steps: tuple[Step, ...]
    text: str


def parse(text: str) -> Address:
    """Parse an address.

    Raises:
        ValueError: The text is not an address; the message shows an example.

    """
    parts = text.split(None, 2)
    if len(parts) != 3:
        raise ValueError(
            f"{text!r} is not an address; {EXAMPLE}" if parts else f"the key `address` is missing; {EXAMPLE}"
        )
    topic, kind, field = parts[0], parts[1], parts[2].strip()
    if not _TOPIC.fullmatch(topic) or len(topic) > 256:
        raise ValueError(f"{topic!r} is not a topic; write its full name, such as /joint_states")
    if not TYPE.fullmatch(kind):
        raise ValueError(f"{kind!r} is not a message type; write, for example, sensor_msgs/JointState")
    return Address(topic, kind, _steps(field), field)


def _steps(field: str) -> tuple[Step, ...]:
    steps: list[Step] = []
    at = 0
    while at < len(field):
        found = _STEP.match(field, at)
        if found is None:
            raise ValueError(
                f"{field!r}: this field is wrong from character {at + 1} on; write, for example, pose.position.x, "
                "position[0] or position[name=joint_1]"
            )
        index = None if found["index"] is None else int(found["index"])
        steps.append(Step(found["name"], index, (found["key"], found["value"]) if found["key"] else None))
        at = found.end()
    if not 1 <= len(steps) <= MAX_STEPS:
        what = f"has at most {MAX_STEPS} names, not {len(steps)}" if steps else "has at least one name"
        raise ValueError(f"{field[:40]!r}{'…' * (len(field) > 40)}: the path of a field {what}")
    return tuple(steps)


def leaf_type(address: Address) -> str:
    """Return the type of the field at an address, with ``[]`` at its end for a whole sequence.

    Raises:
        KeyError: The message type is unknown.
        ValueError: The type has no such field.

    """
    kind = plain(address.type)
    scopes: list[str] = []
    if kind not in DEFINITIONS:
        raise KeyError(kind)
    for step in address.steps:
        if kind in PRIMITIVES or kind.endswith("[]"):
            what = f"a {kind}" if kind in PRIMITIVES else "a sequence; choose an element, such as [0]"
            raise ValueError(f"{address.text}: the value that should contain {step.name!r} is {what}")
        fields = DEFINITIONS[kind]
        if step.name not in fields:
            raise ValueError(f"{address.text}: {kind} has no field {step.name!r}; it has {', '.join(fields)}")
        scopes.append(kind)
        kind = fields[step.name]
        if step.whole:
            continue
        if not kind.endswith("[]"):
            raise ValueError(f"{address.text}: {step.name!r} is a {kind} and not a sequence; leave out the brackets")
        if step.key and not any(DEFINITIONS[scope].get(step.key[0]) == "string[]" for scope in scopes):
            raise ValueError(f"{address.text}: {scopes[-1]} has no sequence of names {step.key[0]!r}")
        kind = kind[:-2]
    if kind.removesuffix("[]") not in PRIMITIVES:
        inside = ", ".join(DEFINITIONS[kind.removesuffix("[]")])
        raise ValueError(f"{address.text} is a {kind}, not a value; name one of its fields: {inside}")
    return kind


def extract(message: Any, address: Address) -> Any:
    """Return the value of an address's field in a message.

    Raises:
        FieldError: The message does not contain the field.

    """
    scopes: list[Any] = []
    found = message
    for step in address.steps:
        name, place, key = step
        if not isinstance(found, dict) or name not in found:
            raise FieldError(BAD_NOT_FOUND, f"{address.text}: the message has no field {name!r}")
        scopes.append(found)
        found = found[name]
        if place is None and key is None:
            continue
        found = from_json(found, "uint8[]")  # a type that shmio does not know
        if not isinstance(found, list):
            raise FieldError(BAD_TYPE_MISMATCH, f"{address.text}: {name!r} is not a sequence")
        index = place if place is not None else place_of(scopes, step, address)
        if index >= len(found):
            raise FieldError(
                BAD_INDEX_RANGE_NO_DATA, f"{address.text}: the array {name!r} has only {len(found)} elements"
            )
        found = found[index]
    return folded(found, scopes[-1], address.text) if step.whole else found


def folded(found: Any, scope: Any, text: str) -> Any:
    """Return a sequence as nested lists if the message that contains it states their sizes, as a MultiArray does.

    ``text`` is the path of the sequence, for messages.

    Raises:
        FieldError: The sequence does not have the sizes.

    """
    layout = scope.get("layout") if isinstance(scope, dict) else None
    dims = layout.get("dim") if isinstance(layout, dict) else None
    if not isinstance(layout, dict) or not isinstance(dims, list):
        return found
    found = from_json(found, "uint8[]")
    if not isinstance(found, list):
        return found
    offset = layout.get("data_offset", 0)
    pairs: list[tuple[Any, Any]] = [
        (one.get("size"), one.get("stride")) if isinstance(one, dict) else (None, None) for one in dims
    ]
    wrong = FieldError(BAD_INDEX_RANGE_NO_DATA, f"{text}: its layout does not fit its {len(found)} elements")
    if any(type(one) is not int or one < 0 for one in (offset, *(one for pair in pairs for one in pair))):
        raise wrong
    sizes = tuple(size for size, _ in pairs)
    counts = [math.prod(sizes[at:]) for at in range(len(sizes))]
    if len(sizes) > MAX_STEPS or offset > len(found) or (counts and counts[0] > len(found)):
        raise wrong
    if not sizes or not counts[0]:
        return found[offset:] if not sizes else []
    # The stride of a dimension is the distance between two indices of the dimension before; many publishers leave it 0.
    steps = [*(stride or count for (_, stride), count in zip(pairs[1:], counts[1:], strict=True)), 1]
    places = [offset]
    for size, step in zip(sizes, steps, strict=True):
        places = [place + at * step for place in places for at in range(size)]
    if places[-1] >= len(found) or (steps[:-1] == counts[1:] and places[-1] != len(found) - 1):
        raise wrong
    return nest([found[place] for place in places], sizes)


def getter(address: Address) -> Callable[[Any], Any]:
    """Return a function that extracts an address's field from a message, in most cases faster than :func:`extract`."""
    *outer, last = address.steps
    name, place, key = last
    if any(not step.whole for step in outer):
        return lambda message: extract(message, address)
    names = tuple(step.name for step in outer)

    def get(message: Any) -> Any:
        scope = message
        try:
            for one in names:
                scope = scope[one]
            found = scope[name]
            if place is None and key is None:
                return folded(found, scope, address.text) if "layout" in scope else found
            if type(found) is list and place is not None:
                return found[place]
            if type(found) is list and key is not None and type(scope[key[0]]) is list:
                return found[scope[key[0]].index(key[1])]
        except (TypeError, LookupError, ValueError):  # the message lacks something, or the names are further out
            pass
        return extract(message, address)

    return get


def scope_of(address: Address) -> tuple[object, ...] | None:
    """Return a key that is equal for addresses which a :func:`row_getter` can find together; None if it can find none.

    These are fields of one message, or elements of one sequence that are selected in the same way.
    """
    *outer, (name, place, key) = address.steps
    if any(not step.whole for step in outer):
        return None
    names = tuple(step.name for step in outer)
    if place is None and key is None:
        return names, None, None
    return names, name, key and key[0]


def row_getter(addresses: Sequence[Address]) -> Callable[[Any], Sequence[Any]]:
    """Return a function that extracts the values of at least two addresses with an equal :func:`scope_of`.

    It raises TypeError, LookupError or ValueError if the message does not contain all of them.
    """
    names = tuple(step.name for step in addresses[0].steps[:-1])
    last = [address.steps[-1] for address in addresses]
    sequence, place, key = last[0]
    if place is None and key is None:
        fields = itemgetter(*[step.name for step in last])
        return lambda message: fields(_inner(message, names))
    if key is None:
        places = itemgetter(*[step.place for step in last])
        return lambda message: places(_checked(_inner(message, names)[sequence]))
    order_name, wanted = key[0], [step.key[1] for step in last if step.key]
    known: list[Any] | None = None
    elements: Callable[[list[Any]], Sequence[Any]] = itemgetter(0)

    def get(message: Any) -> Sequence[Any]:
        nonlocal known, elements
        scope = _inner(message, names)
        order = _checked(scope[order_name])
        if order != known:  # else the elements have the same indices as in the last message
            elements, known = itemgetter(*map(order.index, wanted)), [*order]
        return elements(_checked(scope[sequence]))

    return get


def _inner(message: Any, names: tuple[str, ...]) -> Any:
    for name in names:
        message = message[name]
    return message


def _checked(found: Any) -> list[Any]:
    if type(found) is not list:
        raise TypeError("not a sequence")
    return found


def place_of(scopes: Sequence[Any], step: Step, address: Address) -> int:
    """Return the index that a step with a ``key`` selects.

    ``scopes`` are the messages that contain the field, the outermost first.

    Raises:
        FieldError: No sequence of names contains the name.

    """
    assert step.key is not None  # noqa: S101 - for the type checker
    sequence, name = step.key
    for scope in reversed(scopes):
        names = scope.get(sequence)
        if isinstance(names, list):
            try:
                return names.index(name)
            except ValueError:
                raise FieldError(
                    BAD_NOT_FOUND, f"{address.text}: the sequence {sequence!r} does not contain {name!r}"
                ) from None
    raise FieldError(BAD_NOT_FOUND, f"{address.text}: the message has no sequence {sequence!r}")
