"""Structures for which SimlogAPI version 1 has messages (``proto/simlog_v1.proto``).

A tag table uses their names as types. In a data block, they are recognised by their members, in any
order and case.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Final, Literal, NamedTuple

from shmio.errors import ValueRangeError
from shmio.layout.model import INTEGERS, Register

Elementary = Literal["float", "uint32", "uint64", "string"]

MAX_JOINTS: Final = 64
MAX_POINTS: Final = 512
MAX_REGISTERS: Final = 4096
"""Maximum number of registers in one structure; the longest trajectory of a tag table has fewer."""


class Member(NamedTuple):
    """One member of a structure; ``type`` is elementary or the name of another structure."""

    name: str
    type: str
    many: Literal["", "joints", "points"] = ""
    """"joints" or "points" if the member is an array with an element for each joint or point; else ""."""
    needed: bool = True
    """True if a structure must have this member to be recognised."""


_HEADER: Final = Member("header", "Header", needed=False)

SHAPES: Final[Mapping[str, tuple[Member, ...]]] = {
    "time": (Member("sec", "uint64"), Member("nsec", "uint64")),
    "duration": (Member("msec", "uint64"),),
    "Header": (Member("seq", "uint32"), Member("stamp", "time"), Member("frame_id", "string")),
    "Point": (Member("x", "float"), Member("y", "float"), Member("z", "float")),
    "Quaternion": (Member("x", "float"), Member("y", "float"), Member("z", "float"), Member("w", "float")),
    "PointStamped": (_HEADER, Member("point", "Point")),
    "SafetyZone": (
        _HEADER,
        Member("zone", "string"),
        Member("level", "float"),
        Member("object1", "string"),
        Member("object2", "string"),
    ),
    "SafetyZoneCmd": (Member("zone", "string"), Member("cmd", "string")),
    "JointTrajectoryPoint": (
        Member("positions", "float", "joints"),
        Member("velocities", "float", "joints", needed=False),
        Member("accelerations", "float", "joints", needed=False),
        Member("effort", "float", "joints", needed=False),
        Member("time_from_start", "duration", needed=False),
    ),
    "JointTrajectory": (
        _HEADER,
        Member("joint_names", "string", "joints"),
        Member("points", "JointTrajectoryPoint", "points"),
    ),
}
CONTENTS: Final[Mapping[str, str]] = {
    "JointTrajectory": "joint_trajectory",
    "Point": "point",
    "PointStamped": "point_stamped",
    "Quaternion": "quaternion",
    "JointTrajectoryPoint": "joint_trajectory_point",
    "Header": "timeStamp",
    "SafetyZone": "safety_zone",
    "SafetyZoneCmd": "safety_zone_cmd",
}
"""The structures that a message can contain, each with the name of the message's field for it."""

_S7: Final[Mapping[str, str]] = {"float": "REAL", "uint32": "UDINT", "uint64": "ULINT", "string": "STRING[80]"}
_FITS: Final[Mapping[str, frozenset[str]]] = {
    "float": frozenset({"REAL", "LREAL"}),
    "uint32": INTEGERS,
    "uint64": INTEGERS,
    "string": frozenset({"STRING", "WSTRING"}),
}
_LENGTHS: Final = {"JointTrajectoryPoint": ("joints",), "JointTrajectory": ("joints", "points")}
_TYPE = re.compile(r"(\w+)\s*(?:\[([^\]]*)\])?", re.ASCII)
_INDEX = re.compile(r"-?[0-9]{1,10}")


def members(text: str) -> dict[str, str] | None:
    """Return the types of a structure's members, by path; None if ``text`` is not the type of a structure.

    Some names are followed by numbers: ``JointTrajectoryPoint[6]`` has 6 joints, and
    ``JointTrajectory[6, 20]`` has 6 joints and 20 points.

    Raises:
        ValueRangeError: Numbers are missing, too many, or too large.

    """
    match = _TYPE.fullmatch(text.strip())
    if match is None or match[1] not in CONTENTS:
        return None
    wanted = _LENGTHS.get(match[1], ())
    given = [part.strip() for part in match[2].split(",")] if match[2] is not None else []
    lengths = [int(part) for part in given if part.isascii() and part.isdigit() and len(part) < 6]
    most = {"joints": MAX_JOINTS, "points": MAX_POINTS}
    fits = len(lengths) == len(given) == len(wanted)
    if not fits or not all(1 <= length <= most[what] for length, what in zip(lengths, wanted, strict=True)):
        form = f"{match[1]}[{', '.join(wanted)}]" if wanted else match[1]
        limits = f" with at most {' and '.join(f'{most[what]} {what}' for what in wanted)}" if wanted else ""
        raise ValueRangeError(f"expected {form}{limits}, found {text}")
    return dict(_expanded(match[1], dict(zip(wanted, lengths, strict=True)), ""))


def _expanded(shape: str, lengths: Mapping[str, int], prefix: str) -> Iterator[tuple[str, str]]:
    for member in SHAPES[shape]:
        path = prefix + member.name
        if member.type in _S7:
            array = f"ARRAY[0..{lengths[member.many] - 1}] OF " if member.many else ""
            yield path, array + _S7[member.type]
        elif member.many:
            for index in range(lengths[member.many]):
                yield from _expanded(member.type, lengths, f"{path}/{index}/")
        else:
            yield from _expanded(member.type, lengths, f"{path}/")


Found = Mapping[str, "Register | Found | Sequence[Found]"]
"""Members by name: each is a register, a structure, or an ordered list of structures."""


def recognise(path: str, registers: Sequence[Register]) -> tuple[str, Found] | None:
    """Return the name of the structure in ``CONTENTS`` that registers form, and its members; None if there is none.

    The registers must be all needed members of the structure, with matching types, and no others.
    ``path`` is the path of the structure.
    """
    if not 0 < len(registers) <= MAX_REGISTERS:
        return None
    start = len(path) + 1
    parts = [(register.path[start:].lower().split("/"), register) for register in registers]
    for shape in CONTENTS:
        if found := _match(shape, parts):
            return shape, found
    return None


_Parts = Sequence[tuple[Sequence[str], Register]]


def _match(shape: str, parts: _Parts) -> Found | None:
    """Return the members of the structure ``shape``, or None if the registers do not fit it.

    ``parts`` has, for each register, the names of its path in lower case, and the register.
    """
    groups = _by_name(parts)
    if groups.keys() - {member.name for member in SHAPES[shape]}:
        return None
    found: dict[str, Register | Found | Sequence[Found]] = {}
    for member in SHAPES[shape]:
        group = groups.get(member.name)
        if group is None:
            if member.needed:
                return None
            continue
        value = _member(member, group)
        if value is None:
            return None
        found[member.name] = value
    return found


def _member(member: Member, group: _Parts) -> Register | Found | Sequence[Found] | None:
    if member.type in _FITS:
        names, register = group[0]
        fits = register.element.base in _FITS[member.type] and len(register.dims) == bool(member.many)
        return register if len(group) == 1 and not names and fits else None
    if not member.many:
        return _match(member.type, group)
    elements = _by_name(group)
    if not all(_INDEX.fullmatch(index) for index in elements):
        return None
    found = [_match(member.type, elements[index]) for index in sorted(elements, key=int)]
    return None if None in found else [value for value in found if value is not None]


def _by_name(parts: _Parts) -> dict[str, list[tuple[Sequence[str], Register]]]:
    groups: dict[str, list[tuple[Sequence[str], Register]]] = {}
    for names, register in parts:
        groups.setdefault(names[0] if names else "", []).append((names[1:], register))
    return groups
