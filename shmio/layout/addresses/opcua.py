"""Addresses of nodes in tag tables: node ids and browse paths.

A node id is ``ns=3;s=Speed`` or ``nsu=http://maker/device;i=1001``, as in OPC 10000-6, section
5.3.1.10; in a URI, ``%3B`` stands for a semicolon, and ``%25`` for ``%``. The identifier types are
``i`` (number), ``s`` (text), ``g`` (GUID) and ``b`` (base64). A browse path begins at the root:
``/Objects/2:Device/2:Speed``. Each step is a browse name, with the number of its namespace unless
that is 0; ``&`` precedes one of the characters ``/ . < > : # ! &`` in a name (OPC 10000-4, annex
A.2).
"""

from __future__ import annotations

import base64
import binascii
import re
import uuid
from dataclasses import dataclass
from typing import Final

MAX_STEPS: Final = 64
_MAX_NAME: Final = 4096  # characters of a text identifier (OPC 10000-3, section 8.2.4)
_EXAMPLE: Final = "write a node id such as ns=3;s=Speed or nsu=http://maker/device;i=1001, or a browse path such as "
_NODE: Final = re.compile(
    r"(?:ns=(?P<index>[0-9]{1,5});|nsu=(?P<uri>[^;]+);)?(?P<kind>[isgb])=(?P<identifier>.+)", re.DOTALL
)
_STEP: Final = re.compile(r"(?:([0-9]{1,5}):)?((?:[^/.<>:#!&]|&[/.<>:#!&])+)")


@dataclass(frozen=True, slots=True)
class NodeAddress:
    """A node id; ``namespace`` is the number of its namespace, or its URI."""

    namespace: int | str
    identifier: int | str | uuid.UUID | bytes


@dataclass(frozen=True, slots=True)
class BrowsePath:
    """The browse names, each as (namespace, name), from the root to a node."""

    steps: tuple[tuple[int, str], ...]


Address = NodeAddress | BrowsePath


def parse(text: str) -> Address:
    """Return the address of a node.

    Raises:
        ValueError: The text is neither a node id nor a browse path.

    """
    text = text.strip()
    if not text:
        raise ValueError(f"its `address` is missing; {_EXAMPLE}/Objects/2:Device/2:Speed")
    if text.startswith("/"):
        return _browse_path(text)
    found = _NODE.fullmatch(text)
    if found is None:
        raise ValueError(f"{text!r} is no address of OPC UA; {_EXAMPLE}/Objects/2:Device/2:Speed")
    namespace: int | str = unescaped_uri(found["uri"] or "") or int(found["index"] or 0)
    if isinstance(namespace, int) and namespace > 0xFFFF:
        raise ValueError(f"{text!r}: namespaces have numbers up to 65535")
    return NodeAddress(namespace, _identifier(text, found["kind"], found["identifier"]))


def escaped_uri(uri: str) -> str:
    """Return the URI of a namespace as an address has it."""
    return uri.replace("%", "%25").replace(";", "%3B")


def unescaped_uri(text: str) -> str:
    """Return the URI that an address has; see :func:`escaped_uri`."""
    return text.replace("%3B", ";").replace("%3b", ";").replace("%25", "%")


def _identifier(text: str, kind: str, identifier: str) -> int | str | uuid.UUID | bytes:
    if kind == "s":
        if len(identifier) > _MAX_NAME:
            raise ValueError(f"{text[:40]!r}…: an identifier has at most {_MAX_NAME} characters")
        return identifier
    try:
        if kind == "g":
            return uuid.UUID(identifier)
        if kind == "b":
            return base64.b64decode(identifier, validate=True)
    except (ValueError, binascii.Error):
        raise ValueError(f"{text!r}: this is no {'GUID' if kind == 'g' else 'base64'}") from None
    if not re.fullmatch(r"[0-9]{1,10}", identifier) or int(identifier) > 0xFFFF_FFFF:
        raise ValueError(f"{text!r}: expected a number up to 4294967295 behind i=")
    return int(identifier)


def _browse_path(text: str) -> BrowsePath:
    steps: list[tuple[int, str]] = []
    at = 0
    while at < len(text):
        found = _STEP.match(text, at + 1) if text[at] == "/" else None
        if found is None or int(found[1] or 0) > 0xFFFF:
            raise ValueError(
                f"{text!r}: this browse path is wrong from character {at + 1} on; steps are such as /2:Speed, and & "
                "precedes one of / . < > : # ! & in a name"
            )
        steps.append((int(found[1] or 0), re.sub(r"&(.)", r"\1", found[2])))
        at = found.end()
    if len(steps) > MAX_STEPS:
        raise ValueError(f"{text[:40]!r}…: a browse path has at most {MAX_STEPS} steps")
    return BrowsePath(tuple(steps))
