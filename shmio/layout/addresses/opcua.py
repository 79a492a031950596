"""Addresses of nodes in tag tables: node ids and browse paths.

A node id is ``ns=3;s=Speed`` or ``nsu=http://maker/device;i=1001``, as in OPC 10000-6, section
5.3.1.10; in a URI, ``%3B`` stands for a semicolon, and ``%25`` for ``%``. The identifier types are
``i`` (number), ``s`` (text), ``g`` (GUID) and ``b`` (base64). A browse path begins at the root:
``/Objects/2:Device/2:Speed``. Each step is a browse name, with the number of its namespace unless that
is 0; in a name, ``&`` escapes each of the characters ``/ . < > : # ! &`` (OPC 10000-4, annex A.2).

The address of a structure's member is the address of the structure's node, a ``#``, and the steps to
the member: ``ns=3;s=Pump#Motor.Speed``, ``/Objects/2:Line#[0].Forces``. After the ``#``, ``&`` escapes
each of the characters ``. [ ] # &`` in a name. In a text identifier, ``##`` stands for ``#``.
"""

from __future__ import annotations

import base64
import binascii
import re
import uuid
from dataclasses import dataclass
from typing import Final

MAX_STEPS: Final = 64
"""Maximum number of steps of a browse path, and maximum number of steps to a member."""
_MAX_NAME: Final = 4096  # characters of a text identifier (OPC 10000-3, section 8.2.4)
_EXAMPLE: Final = "write a node id such as ns=3;s=Speed or nsu=http://maker/device;i=1001, or a browse path such as "
_NODE: Final = re.compile(
    r"(?:ns=(?P<index>[0-9]{1,5});|nsu=(?P<uri>[^;]+);)?(?P<kind>[isgb])=(?P<identifier>.+)", re.DOTALL
)
_IDENTIFIER: Final = re.compile(r"((?:[^#]|##)*)(?:#([^#].*))?", re.DOTALL)
_PATH: Final = re.compile(r"((?:[^#&]|&.)*)(?:#(.+))?", re.DOTALL)
_MEMBER: Final = re.compile(
    r"\[([0-9]{1,7}(?:,[0-9]{1,7})*)\]|(?:(?<=[\s\S])\.|(?<![\s\S]))((?:[^.\[\]#&]|&[.\[\]#&])+)"
)
_STEP: Final = re.compile(r"(?:([0-9]{1,5}):)?((?:[^/.<>:#!&]|&[/.<>:#!&])+)")


@dataclass(frozen=True, slots=True)
class NodeAddress:
    """A node id; ``namespace`` is the number or the URI of its namespace."""

    namespace: int | str
    identifier: int | str | uuid.UUID | bytes


@dataclass(frozen=True, slots=True)
class BrowsePath:
    """The browse names from the root to a node, each as a pair (namespace, name)."""

    steps: tuple[tuple[int, str], ...]


Address = NodeAddress | BrowsePath
Member = tuple[str | tuple[int, ...], ...]
"""The steps from a structure to a member; each is a member's name, or the indices of an element."""


def parse(text: str) -> Address:
    """Parse the address of a node.

    Raises:
        ValueError: The text is neither a node id nor a browse path.

    """
    address, member = parse_member(text)
    if member:
        raise ValueError(f"{text!r} is a member of a structure, which only the connector opcua reads")
    return address


def parse_member(text: str) -> tuple[Address, Member]:
    """Parse the address of a node, or of a member of its structure.

    Returns:
        The address of the node, and the steps to the member, which are empty for the node's whole
        value.

    Raises:
        ValueError: The text is neither a node id nor a browse path, or the steps are malformed.

    """
    text = text.strip()
    if not text:
        raise ValueError(f"the key `address` is missing; {_EXAMPLE}/Objects/2:Device/2:Speed")
    if text.startswith("/"):
        parts = _PATH.fullmatch(text)
        if parts is None:
            return _browse_path(text), ()
        return _browse_path(parts[1]), _member(text, parts[2])
    found = _NODE.fullmatch(text)
    if found is None:
        raise ValueError(f"{text!r} is not an address of OPC UA; {_EXAMPLE}/Objects/2:Device/2:Speed")
    namespace: int | str = unescaped_uri(found["uri"] or "") or int(found["index"] or 0)
    if isinstance(namespace, int) and namespace > 0xFFFF:
        raise ValueError(f"{text!r}: namespaces have numbers up to 65535")
    parts = _IDENTIFIER.fullmatch(found["identifier"])
    if parts is None or not parts[1]:
        raise ValueError(f"{text!r}: a # precedes the member of a structure; write ## for a # of the identifier")
    identifier = _identifier(text, found["kind"], parts[1].replace("##", "#"))
    return NodeAddress(namespace, identifier), _member(text, parts[2])


def node_text(text: str) -> str:
    """Return a node id in the spelling of an address, which has ``##`` for ``#``."""
    return text.replace("#", "##")


def member_text(member: Member) -> str:
    """Return the part of an address that begins with ``#`` and names a member; empty if ``member`` is empty."""
    steps = [
        "." + re.sub(r"([.\[\]#&])", r"&\1", one) if isinstance(one, str) else f"[{','.join(map(str, one))}]"
        for one in member
    ]
    return f"#{''.join(steps).removeprefix('.')}" if steps else ""


def _member(text: str, way: str | None) -> Member:
    """Parse the steps to a member, ``way``; raise ValueError if they are malformed."""
    steps: list[str | tuple[int, ...]] = []
    at = 0
    while way and at < len(way):
        found = _MEMBER.match(way, at)
        if found is None:
            raise ValueError(
                f"{text!r}: the path of the member is wrong at {way[at : at + 20]!r}; write it as #Motor.Forces or "
                "#[0].Speed, and & before one of . [ ] # & in a name"
            )
        steps.append(re.sub(r"&(.)", r"\1", found[2]) if found[2] else tuple(map(int, found[1].split(","))))
        at = found.end()
    if len(steps) > MAX_STEPS:
        raise ValueError(f"{text[:40]!r}…: the path of a member has at most {MAX_STEPS} steps")
    return tuple(steps)


def escaped_uri(uri: str) -> str:
    """Return a namespace's URI in the spelling of an address, which has ``%25`` for ``%`` and ``%3B`` for ``;``."""
    return uri.replace("%", "%25").replace(";", "%3B")


def unescaped_uri(text: str) -> str:
    """Return the URI of a namespace from its spelling in an address, as :func:`escaped_uri` returns it."""
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
        raise ValueError(f"{text!r}: the identifier is not {'a GUID' if kind == 'g' else 'base64'}") from None
    if not re.fullmatch(r"[0-9]{1,10}", identifier) or int(identifier) > 0xFFFF_FFFF:
        raise ValueError(f"{text!r}: expected a number up to 4294967295 after i=")
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
