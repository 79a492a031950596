"""Paths into JSON documents: ``$``, ``$.axes[0].pos``, ``$['name with spaces']``, ``$.values[id=Line1.Pos].v``."""

from __future__ import annotations

import re
from typing import Any, Final, NamedTuple

from shmio.connectors.mqtt.faults import ValueFaultError
from shmio.model.statuses import BAD_INDEX_RANGE_NO_DATA, BAD_NOT_FOUND, BAD_TYPE_MISMATCH


class Choice(NamedTuple):
    """Selects the object of an array whose member ``key`` has the value ``text``."""

    key: str
    text: str

    def __str__(self) -> str:
        return f"[{self.key}={self.text}]"


Steps = tuple[str | int | Choice, ...]
"""Names of members, indices of elements and choices of objects, from the whole document to the value."""


class Companion(NamedTuple):
    """The path of something that belongs to a value, such as its time: from the whole document, or beside the value."""

    beside: bool
    steps: Steps

    def of(self, value: Steps) -> Steps:
        """Return the path for a value with the path ``value``."""
        return (*value[:-1], *self.steps) if self.beside else self.steps


MAX_STEPS: Final = 16
_STEP: Final = re.compile(
    r"""\.(?P<name>[^.\[\]'"]+)|\[(?P<index>[0-9]{1,6})\]|\['(?P<single>[^']+)'\]|\["(?P<double>[^"]+)"\]"""
    r"""|\[(?P<key>[^.\[\]'"=]+)=(?:'(?P<quoted>[^']+)'|"(?P<quoted2>[^"]+)"|(?P<bare>[^\[\]'"=][^\[\]'"]*))\]"""
)


class AbsentError(ValueFaultError):
    """An array has no object that a :class:`Choice` selects: the message says nothing about it."""


def parse(text: str) -> Steps:
    """Parse a path. The caller has checked that it begins with ``$``.

    Raises:
        ValueError: The path is wrong or has too many steps; the message says what is wrong.

    """
    steps: list[str | int | Choice] = []
    at = 1
    while at < len(text):
        found = _STEP.match(text, at)
        if found is None:
            raise ValueError(
                f"{text!r}: this path is wrong from character {at + 1} on; write, for example, $.axes[0].pos, "
                "$.values[id=NAME].v, $['name with.dots'], or $ for the whole document"
            )
        if found["key"]:
            steps.append(Choice(found["key"], found["quoted"] or found["quoted2"] or found["bare"]))
        else:
            index = found["index"]
            steps.append(int(index) if index is not None else found["name"] or found["single"] or found["double"])
        at = found.end()
    if len(steps) > MAX_STEPS:
        raise ValueError(f"{text[:40]!r}…: a path has at most {MAX_STEPS} steps")
    if steps and isinstance(steps[-1], Choice):
        raise ValueError(f"{text[:60]!r}: a selected object is no value; append a member, such as .v")
    return tuple(steps)


def parse_companion(text: str) -> Companion:
    """Parse the path of something that belongs to a value: ``$.time``, or ``@.time`` beside the value.

    Raises:
        ValueError: The path is wrong; the message says what is wrong.

    """
    if text[:1] not in ("$", "@"):
        raise ValueError(f"{text!r} is not a path; write, for example, $.timestamp, or @.timestamp beside the value")
    return Companion(text[0] == "@", parse(text))


class Document:
    """A JSON document from which many values are extracted."""

    def __init__(self, value: Any) -> None:
        self.value = value
        self._chosen: dict[tuple[int, str], dict[str | None, Any]] = {}
        """For an array, by its ``id``, and a key: its objects by their values of this key."""

    def choose(self, array: list[Any], choice: Choice) -> Any:
        """Return the object that a choice selects; of several, the last one, which is the newest.

        Raises:
            AbsentError: There is none.

        """
        at = id(array), choice.key
        if at not in self._chosen:  # reading each array only once keeps a large one cheap
            self._chosen[at] = {_text(one, choice.key): one for one in array}
        found = self._chosen[at].get(choice.text)
        if found is None:
            raise AbsentError(BAD_NOT_FOUND, f"the array has no object {choice}")
        return found


def _text(found: Any, key: str) -> str | None:
    """Return a member of an object as text; None if there is none that is text or a number."""
    value = found.get(key) if isinstance(found, dict) else None
    return str(value) if isinstance(value, str | int | float) and not isinstance(value, bool) else None


def extract(document: Document, steps: Steps) -> Any:
    """Return the value at a path of a document.

    Raises:
        ValueFaultError: The document has no such value.

    """
    found = document.value
    for step in steps:
        if isinstance(step, Choice):
            if not isinstance(found, list):
                raise ValueFaultError(BAD_TYPE_MISMATCH, f"the value that should contain {step} is not an array")
            found = document.choose(found, step)
            continue
        if isinstance(step, int):
            if not isinstance(found, list):
                raise ValueFaultError(BAD_TYPE_MISMATCH, f"the value that should contain [{step}] is not an array")
            if step >= len(found):
                raise ValueFaultError(BAD_INDEX_RANGE_NO_DATA, f"the array has no element [{step}]")
        elif not isinstance(found, dict):
            raise ValueFaultError(BAD_TYPE_MISMATCH, f"the value that should contain {step!r} is not an object")
        elif step not in found:
            raise ValueFaultError(BAD_NOT_FOUND, f"the JSON has no member {step!r}")
        found = found[step]
    return found


def assign(document: Any, steps: Steps, value: Any) -> Any:
    """Return the document with ``value`` at a path.

    Objects and arrays that are missing on the way are added.

    Raises:
        ValueError: The path leads through a value of another kind, or array elements before the
            value are missing.

    """
    if not steps:
        return value
    step, rest = steps[0], steps[1:]
    if isinstance(step, Choice):
        objects = [] if document is None else document
        if not isinstance(objects, list):
            raise ValueError(f"the value that should contain {step} is not an array")
        at = next((at for at, one in enumerate(objects) if _text(one, step.key) == step.text), len(objects))
        before = objects[at] if at < len(objects) else {step.key: step.text}
        return [*objects[:at], assign(before, rest, value), *objects[at + 1 :]]
    if isinstance(step, int):
        elements = [] if document is None else document
        if not isinstance(elements, list):
            raise ValueError(f"the value that should contain [{step}] is not an array")
        if step > len(elements):
            raise ValueError(f"the elements before [{step}] have no value; write them in the same command")
        inside = elements[step] if step < len(elements) else None
        return [*elements[:step], assign(inside, rest, value), *elements[step + 1 :]]
    members = {} if document is None else document
    if not isinstance(members, dict):
        raise ValueError(f"the value that should contain {step!r} is not an object")
    return members | {step: assign(members.get(step), rest, value)}
