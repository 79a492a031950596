"""Topic paths: how a register is named from outside.

``<source>/<member>/…[/<index>…]`` and then, if given, ``/in`` or ``/out``. Before these, a path may end in a part of
a register: a slice in place of the last index (``Inputs/2..5``), or a bit or another part of an integer
(``Inputs/8.%X0``), as ``parts.py`` has them. A leading slash is accepted, and so
is ``<SCHEME>://``, whose scheme is a source's name in any case. In a member's name ``/ % + #`` are
percent-encoded, and so is the first letter of a member named exactly ``in`` or ``out``.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from typing import Literal, TypeVar, cast

from shmio.config import RESERVED_SOURCES
from shmio.errors import PathError
from shmio.layout.model import MAX_DEPTH, MAX_DIMENSIONS, Layout, Register
from shmio.layout.parts import PART, RANGE, part_of, slice_of

Direction = Literal["in", "out"]

_Found = TypeVar("_Found")

MAX_TOPIC = 16_384
MAX_SEGMENTS = MAX_DEPTH * (1 + MAX_DIMENSIONS)  # names, each with its indices
_NEAR_CANDIDATES = 500
_NEAR_CHARACTERS = 200
_SOURCES_SHOWN = 4

_SCHEME = re.compile(r"([^/:]+)://")
_INDEX = re.compile(r"0|-?[1-9][0-9]{0,9}")
_ESCAPE = re.compile(r"%([0-9A-Fa-f]{2})?")
_RESERVED = re.compile(r"[/%+#]")
_CONTROL = re.compile(r"[\x00-\x1f\x7f]")


@dataclass(frozen=True, slots=True)
class Topic:
    """A register's path within a source, and a direction if one was named.

    ``path`` is in canonical encoding and empty when the text named only the source. ``named``: whether the text named
    the source, which else is the default one.
    """

    source: str
    path: str
    direction: Direction | None = None
    named: bool = field(default=True, compare=False)

    def __str__(self) -> str:
        return "/".join(part for part in (self.source, self.path, self.direction) if part)


def encode_segment(name: str) -> str:
    """Return a member's name as one path segment."""
    if name in ("in", "out"):
        return f"%{ord(name[0]):02X}{name[1:]}"
    return _RESERVED.sub(lambda match: f"%{ord(match[0]):02X}", name)


def decode_segment(segment: str) -> str:
    """Return the member's name of one path segment.

    Raises PathError: a ``%`` without two hexadecimal digits, bytes that are not UTF-8, or a part of a register.
    """
    if "%" not in segment:
        return segment
    if PART.fullmatch(segment):  # none is a name: not one of them decodes
        raise PathError(
            f"{shorten(segment)}: a bit or another part of a register ends the path of one register, and is not here"
        )
    data = bytearray()
    position = 0
    for match in _ESCAPE.finditer(segment):
        if match[1] is None:
            raise PathError(f"{shorten(segment)}: '%' must be followed by two hexadecimal digits")
        data += segment[position : match.start()].encode("utf-8", "surrogatepass")
        data.append(int(match[1], 16))
        position = match.end()
    data += segment[position:].encode("utf-8", "surrogatepass")
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        raise PathError(f"{shorten(segment)}: the percent-encoded bytes are not UTF-8") from None


def canonical_path(path: str, *, parts: bool = False) -> str:
    """Return a path with each segment in its one canonical encoding; ``parts``: it may end in a part of an integer.

    Raises PathError: an empty segment, a wrong percent-encoding, control characters, which no name has, or more
    segments than the deepest layout has.
    """
    segments = path.split("/", MAX_SEGMENTS)
    if len(segments) > MAX_SEGMENTS:
        raise PathError(f"{shorten(path)}: a path has at most {MAX_SEGMENTS} segments")
    if "" in segments:
        raise PathError(f"{shorten(path)}: empty segment in the path")
    suffix = ""
    if parts and (part := PART.fullmatch(segments[-1])):
        segments[-1], suffix = part["head"], f".%{part['kind']}{int(part['number'])}"
    canonical = "/".join(encode_segment(decode_segment(segment)) for segment in segments) + suffix
    if _CONTROL.search(canonical):
        raise PathError(f"{shorten(path)!r}: a path must not hold control characters")
    return canonical


def parse_topic(text: str, sources: Collection[str], default: str | None) -> Topic:
    """Split a topic into source, path and direction.

    A first segment that is a source's name, or a reserved name, is the source; otherwise ``default`` is.
    A text that names the source alone gives an empty path: the whole block.

    Raises PathError: no such source, no default where one is needed, or a malformed path.
    """
    if len(text) > MAX_TOPIC:
        raise PathError(f"{shorten(text)}: a path is at most {MAX_TOPIC} characters long")
    text = text.removeprefix("/")
    source, rest = default, text
    named = True
    if scheme := _SCHEME.match(text):
        source, rest = _source_of_scheme(scheme[1], sources), text[scheme.end() :].removeprefix("/")
    else:
        first, _, below = text.partition("/")
        if first in sources or first in RESERVED_SOURCES:
            source, rest = first, below
        else:
            named = False
    if source is None:
        raise PathError(f"{shorten(text)}: {_which(shorten(text.partition('/')[0]), sources)}")
    head, _, last = rest.rpartition("/")
    direction: Direction | None = None
    if last in ("in", "out"):
        direction, rest = cast(Direction, last), head
    if rest:
        return Topic(source, canonical_path(rest, parts=True), direction, named)
    if not named:
        raise PathError(f"{shorten(text)!r}: the path names no register")
    return Topic(source, "", direction)


def _source_of_scheme(scheme: str, sources: Collection[str]) -> str:
    if scheme in sources:
        return scheme
    for source in (*sources, *sorted(RESERVED_SOURCES)):
        if source.lower() == scheme.lower():
            return source
    raise PathError(f"{shorten(scheme)}://: no source of this name; there are: {', '.join(sources)}")


def _which(first: str, sources: Collection[str]) -> str:
    """What to say of a path whose first segment is no source, where none can be left out."""
    if not sources:
        return "there is no source"
    some = [f"{source}/…" for source in sources][:_SOURCES_SHOWN]
    more = ", …" if len(sources) > len(some) else ""
    return f"there are {len(sources)} sources, and {first!r} is none of them: write {' or '.join(some)}{more}"


def look_up(layout: Layout, topic: Topic) -> Register:
    """As :func:`find`; the PathError names the source, and says so if the topic did not."""
    return _told(layout, topic, find)


def look_up_each(layout: Layout, topic: Topic) -> list[Register]:
    """As :func:`find_each`, with the errors of :func:`look_up`."""
    return _told(layout, topic, lambda layout, path: list(find_each(layout, path)))


def _told(layout: Layout, topic: Topic, search: Callable[[Layout, str], _Found]) -> _Found:
    try:
        return search(layout, topic.path)
    except PathError as error:
        if topic.named and topic.path:
            raise PathError(f"{topic.source}/{error}") from None
        if topic.named:
            raise
        raise PathError(f"{error}; looked for in source {topic.source}, as the path begins with no source") from None


def find(layout: Layout, path: str) -> Register:
    """Return the register of a canonical path, or what the path names of one: an element, a slice, a bit.

    Raises PathError: there is none; the message has near names.
    """
    index = layout.by_path.get(path)
    if index is not None:
        return layout.registers[index]
    head, _, last = path.rpartition("/")
    if part := PART.fullmatch(last):
        whole = find(layout, path[: -len(last) + part.end("head")])
        return part_of(layout, whole, part["kind"], int(part["number"]))
    if bounds := RANGE.fullmatch(last):
        if (found := _array(layout, head)) is None:
            raise PathError(f"{shorten(path)}: a range stands in place of an array's last index")
        return slice_of(layout, *found, int(bounds["low"]), int(bounds["high"]))
    if found := _array(layout, head):
        array, indices = found
        if _INDEX.fullmatch(last):
            return layout.element(array, (*indices, int(last)))
    raise PathError(_unknown(layout, path))


def names_part(path: str) -> bool:
    """Whether a path ends as that of a slice, or of a bit or another part of an integer."""
    last = path.rpartition("/")[2]
    return bool(PART.fullmatch(last) or RANGE.fullmatch(last))


def holders(path: str) -> Iterator[str]:
    """A canonical path, and those of what it may be a part of: elements, arrays, structures."""
    yield path
    if part := PART.fullmatch(path):
        path = part["head"]
        yield path
    while path := path.rpartition("/")[0]:
        yield path


def holder(layout: Layout, register: Register) -> str:
    """The path of the register of a layout that this one, which :func:`find` has found, is or is a part of."""
    return next(path for path in holders(register.path) if path in layout.by_path)


def find_each(layout: Layout, path: str) -> Iterator[Register]:
    """As :func:`find`; of a slice the elements."""
    register = find(layout, path)
    head, _, last = path.rpartition("/")
    if path in layout.by_path or not RANGE.fullmatch(last):
        yield register
        return
    ((low, high),) = register.dims
    for index in range(low, high + 1):
        yield find(layout, f"{head}/{index}")


def _array(layout: Layout, path: str) -> tuple[Register, tuple[int, ...]] | None:
    """The register, an array in a sound path, that a path is or lies below by indices; and these."""
    indices: tuple[int, ...] = ()
    while (index := layout.by_path.get(path)) is None:
        path, _, last = path.rpartition("/")
        if len(indices) == MAX_DIMENSIONS or not _INDEX.fullmatch(last):
            return None
        indices = (int(last), *indices)
    return layout.registers[index], indices


def _unknown(layout: Layout, path: str) -> str:
    if not path:
        return f"{layout.name}: the path names a source, not a register"
    if below := layout.members(path):
        inside = ", ".join(layout.registers[i].path for i in below[:3])
        return f"{shorten(path)}: a structure, not a register; it holds {inside}{', …' if below[3:] else ''}"
    known, missing, names = _where_it_ends(layout, path)
    prefix = f"{known}/" if known else ""
    if names and all(map(_INDEX.fullmatch, names)):
        numbers = sorted(map(int, names))
        return f"{shorten(prefix + missing)}: the index is outside {numbers[0]}..{numbers[-1]}"
    like = ", ".join(near(layout, path))
    return f"{shorten(path)}: no such register in {layout.name}{f'; near: {like}' if like else ''}"


def near(layout: Layout, path: str) -> list[str]:
    """Up to three paths of registers, elements or structures that are like this one, whatever the case."""
    wanted = path[:_NEAR_CHARACTERS].lower()
    head, indices = wanted, ""
    while not (same := layout.in_any_case(head)) and _INDEX.fullmatch(last := head.rpartition("/")[2]):
        head, indices = head.removesuffix(last).removesuffix("/"), f"/{last}{indices}"
    if same and (not indices or (same in layout.by_path and layout.registers[layout.by_path[same]].dims)):
        return [f"{same}{indices}"]
    known = wanted
    while known and not (below := layout.members(layout.in_any_case(known) or "")):
        known = known.rpartition("/")[0]
    names: dict[str, None] = {}
    for index in below if known else range(len(layout.registers)):
        name = layout.registers[index].path.lower()
        while len(name) > len(known) and name not in names:
            names[name] = None
            name = name.rpartition("/")[0]
        if len(names) >= _NEAR_CANDIDATES:
            break
    near = difflib.get_close_matches(wanted, names, n=3)
    return [written for name in near if (written := layout.in_any_case(name))]


def _where_it_ends(layout: Layout, path: str) -> tuple[str, str, list[str]]:
    """(the longest prefix that is a structure, the segment after it, the names that could stand there)."""
    known, below = path, tuple[int, ...]()
    while known and not below:
        known = known.rpartition("/")[0]
        below = layout.members(known)
    start = len(known) + 1 if known else 0
    indices = below or range(len(layout.registers))
    names = dict.fromkeys(layout.registers[i].path[start:].partition("/")[0] for i in indices[:_NEAR_CANDIDATES])
    return known, path[start:].partition("/")[0], list(names)


def shorten(text: str, limit: int = 120) -> str:
    """Return text that fits an error message."""
    return text if len(text) <= limit else f"{text[: limit - 1]}…"
