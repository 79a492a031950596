"""Paths into JSON documents: ``$``, ``$.axes[0].pos``, ``$['name with spaces']``."""

from __future__ import annotations

import re
from typing import Any, Final

from shmio.connectors.mqtt.faults import ValueFaultError
from shmio.model.statuses import BAD_INDEX_RANGE_NO_DATA, BAD_NOT_FOUND, BAD_TYPE_MISMATCH

Steps = tuple[str | int, ...]
"""Names of members and indices of elements, from the whole document to the value."""

MAX_STEPS: Final = 16
_STEP: Final = re.compile(
    r"""\.(?P<name>[^.\[\]'"]+)|\[(?P<index>[0-9]{1,6})\]|\['(?P<single>[^']+)'\]|\["(?P<double>[^"]+)"\]"""
)


def parse(text: str) -> Steps:
    """Parse a path. The caller has checked that it begins with ``$``.

    Raises:
        ValueError: The path is wrong or has too many steps; the message says what is wrong.

    """
    steps: list[str | int] = []
    at = 1
    while at < len(text):
        found = _STEP.match(text, at)
        if found is None:
            raise ValueError(
                f"{text!r}: this path is wrong from character {at + 1} on; write, for example, $.axes[0].pos, "
                "$['name with.dots'], or $ for the whole document"
            )
        index = found["index"]
        steps.append(int(index) if index is not None else found["name"] or found["single"] or found["double"])
        at = found.end()
    if len(steps) > MAX_STEPS:
        raise ValueError(f"{text[:40]!r}…: a path has at most {MAX_STEPS} steps")
    return tuple(steps)


def extract(document: Any, steps: Steps) -> Any:
    """Return the value at a path of a document.

    Raises:
        ValueFaultError: The document has no such value.

    """
    for step in steps:
        if isinstance(step, int):
            if not isinstance(document, list):
                raise ValueFaultError(BAD_TYPE_MISMATCH, f"the value that should contain [{step}] is not an array")
            if step >= len(document):
                raise ValueFaultError(BAD_INDEX_RANGE_NO_DATA, f"the array has no element [{step}]")
        elif not isinstance(document, dict):
            raise ValueFaultError(BAD_TYPE_MISMATCH, f"the value that should contain {step!r} is not an object")
        elif step not in document:
            raise ValueFaultError(BAD_NOT_FOUND, f"the JSON has no member {step!r}")
        document = document[step]
    return document


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
