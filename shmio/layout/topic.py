"""Topics: the paths by which clients name registers.

A topic is ``<source>/<member>/…[/<index>…]``, optionally followed by ``/in`` or ``/out``. Before the
direction, the path may end in a part of a register:

- ``Inputs/2..5``: a range in place of an array's last index; the slice has one dimension.
- ``Outputs/13.%X0``: a bit of an integer, as in STEP 7's slice access; bit 0 is the lowest.
  ``.%B1`` is a byte, ``.%W0`` a word, ``.%D0`` a double word; number 0 is the least significant.

No member's name looks like such a part of an integer, because ``%`` is encoded in names.

A topic may begin with a slash, or with ``<SCHEME>://``, in which the scheme is the name of a source in
upper or lower case. In a member's name ``/ % + #`` are percent-encoded, and so is the first letter of a
member named exactly ``in`` or ``out``.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final, Literal, TypeVar, cast

from shmio.config.reserved import RESERVED_SOURCES
from shmio.errors import PathError
from shmio.layout.model import INTEGERS, MAX_DEPTH, MAX_DIMENSIONS, MAX_PATH, Layout, Register, array_size
from shmio.wording import did_you_mean, unknown
from shmio.wording import near as similar_name

Direction = Literal["in", "out"]

_Found = TypeVar("_Found")

MAX_TOPIC = MAX_PATH
_MAX_SEGMENTS = MAX_DEPTH * (1 + MAX_DIMENSIONS)  # names and their indices
_NEAR_CANDIDATES = 500
_NEAR_CHARACTERS = 200
_SOURCES_SHOWN = 4

_SCHEME = re.compile(r"([^/:]+)://")
_INDEX = re.compile(r"0|-?[1-9][0-9]{0,9}")
_PART: Final = re.compile(r"(?P<head>.+)\.%(?P<kind>[XBWD])(?P<number>[0-9]{1,3})")
"""Matches a last segment that names a part of an integer."""
_RANGE: Final = re.compile(r"(?P<low>0|-?[1-9][0-9]{0,9})\.\.(?P<high>0|-?[1-9][0-9]{0,9})")
"""Matches a last segment that names a slice."""
_WIDTHS: Final = {"B": ("BYTE", 1), "W": ("WORD", 2), "D": ("DWORD", 4)}
_ESCAPE = re.compile(r"%([0-9A-Fa-f]{2})?")
_RESERVED = re.compile(r"[/%+#]")
_CONTROL = re.compile(r"[\x00-\x1f\x7f]")


@dataclass(frozen=True, slots=True)
class Topic:
    """The parts of a topic: a source, a path within the source, and a direction if the text has one.

    ``path`` is in canonical encoding, and "" if the text names only the source. ``named`` is False
    if the text names no source; ``source`` is then the default source.
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
    """Return the member's name that a path segment encodes.

    Raises:
        PathError: A ``%`` lacks its two hexadecimal digits, the bytes are not UTF-8, or the segment
            names a part of a register.

    """
    if "%" not in segment:
        return segment
    if _PART.fullmatch(segment):  # not a name, where % would be encoded
        raise PathError(
            f"{shorten(segment)}: a bit or another part of a register is allowed only at the end of a register's path"
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
    """Return a path with each segment in canonical encoding.

    Args:
        path: The path, with any valid encoding.
        parts: Whether the path may end in a part of an integer.

    Raises:
        PathError: A segment is empty or wrongly encoded, the path has control characters, or it has
            more segments than the deepest layout.

    """
    segments = path.split("/", _MAX_SEGMENTS)
    if len(segments) > _MAX_SEGMENTS:
        raise PathError(f"{shorten(path)}: a path has at most {_MAX_SEGMENTS} segments")
    if "" in segments:
        raise PathError(f"{shorten(path)}: the path has an empty segment")
    suffix = ""
    if parts and (part := _PART.fullmatch(segments[-1])):
        segments[-1], suffix = part["head"], f".%{part['kind']}{int(part['number'])}"
    canonical = "/".join(encode_segment(decode_segment(segment)) for segment in segments) + suffix
    if _CONTROL.search(canonical):
        raise PathError(f"{shorten(path)!r}: a path must not contain control characters")
    return canonical


def check_canonical(paths: Sequence[str]) -> None:
    """Check that paths are in canonical encoding. This is fast for paths without encoded characters.

    Raises:
        PathError: A path is not in its canonical form.

    """
    text = f"/{'/'.join(paths)}/"
    # Finding a text is faster than a regular expression. No printable text has control characters.
    plain = text.isprintable() and not any(part in text for part in ("%", "+", "#", "//", "/in/", "/out/"))
    # A path has fewer segments than characters, and most paths are short.
    if plain and (
        max(map(len, paths), default=0) < _MAX_SEGMENTS or all(path.count("/") < _MAX_SEGMENTS for path in paths)
    ):
        return
    for path in paths:
        if canonical_path(path) != path:
            raise PathError(f"{path!r} is not a path in its canonical form")


def parse_topic(text: str, sources: Collection[str], default: str | None) -> Topic:
    """Split a topic into source, path and direction.

    Args:
        text: The topic. The first segment is the source if it is the name of a source or a reserved
            name.
        sources: Names of the sources.
        default: The source of a topic that names none; None if a topic must name one.

    Returns:
        The topic. Its path is empty if the text names only the source, which stands for the whole
        block.

    Raises:
        PathError: The source is unknown or missing, or the path is malformed.

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
        raise PathError(f"{shorten(text)}: {_which(text, sources)}")
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
    raise PathError(unknown("source", scheme, sources))


def _which(text: str, sources: Collection[str]) -> str:
    """Return a message for a topic that must begin with a source, but begins with another name."""
    if not sources:
        return "there are no sources"
    first, _, rest = text.partition("/")
    if rest and (like := similar_name(first, sources)):
        remedy = did_you_mean([shorten(f"{like[0]}/{rest}")])
    else:
        some = [f"{source}/…" for source in sources][:_SOURCES_SHOWN]
        remedy = f"begin the path with {' or '.join(some)}{', …' if len(sources) > len(some) else ''}"
    return f"{shorten(first)!r} is not one of the {len(sources)} sources; {remedy}"


def look_up(layout: Layout, topic: Topic) -> Register:
    """Return the register that a topic names. Like :func:`find`, but a PathError also names the source."""
    return _with_source_in_errors(layout, topic, find)


def look_up_each(layout: Layout, topic: Topic) -> list[Register]:
    """Return the registers that a topic names. Like :func:`find_each`, but a PathError also names the source."""
    return _with_source_in_errors(layout, topic, lambda *where: list(find_each(*where)))


def _with_source_in_errors(layout: Layout, topic: Topic, search: Callable[[Layout, str, str], _Found]) -> _Found:
    try:
        return search(layout, topic.path, topic.source)
    except PathError as error:
        if topic.named and topic.path:
            raise PathError(f"{topic.source}/{error}") from None
        if topic.named:
            raise
        first, slash, _ = topic.path.partition("/")
        if slash and layout.in_any_case(first) is None:
            suggestion = did_you_mean(_near_topics(layout, topic.path, topic.source))
            raise PathError(
                f"no source {shorten(first)!r} and no register {shorten(topic.path)!r} in source {topic.source!r}"
                f"{suggestion and f'; {suggestion}'}"
            ) from None
        raise PathError(f"{error} (searched in source {topic.source!r}, because the path names no source)") from None


def find(layout: Layout, path: str, source: str = "") -> Register:
    """Return the register, element, slice, bit or other part that a canonical path names.

    Args:
        layout: The layout.
        path: The path.
        source: Name of the source with this layout, with which suggested paths begin. Empty: they begin with a
            member of the layout.

    Raises:
        PathError: The layout has nothing at this path; the message suggests similar paths.

    """
    index = layout.by_path.get(path)
    if index is not None:
        return layout.registers[index]
    head, _, last = path.rpartition("/")
    if part := _PART.fullmatch(last):
        whole = find(layout, path[: -len(last) + part.end("head")], source)
        return part_of(layout, whole, part["kind"], int(part["number"]))
    if bounds := _RANGE.fullmatch(last):
        if (found := _array(layout, head)) is None:
            raise PathError(f"{shorten(path)}: a range must take the place of an array's last index")
        return slice_of(layout, *found, int(bounds["low"]), int(bounds["high"]))
    if found := _array(layout, head):
        array, indices = found
        if _INDEX.fullmatch(last):
            return layout.element(array, (*indices, int(last)))
    raise PathError(_unknown(layout, path, source))


def part_of(layout: Layout, register: Register, kind: str, number: int) -> Register:
    """Return part ``number`` of an integer: a bit (kind ``X``), byte (``B``), word (``W``) or double word (``D``).

    Raises:
        PathError: The register is not an integer, or has no such part.

    """
    path = f"{register.path}.%{kind}{number}"
    if register.dims or register.type not in INTEGERS:
        what = "an array" if register.dims else register.type
        raise PathError(f"{path}: {what} has no such part; only a single integer has bits, bytes and words")
    size = register.size
    if kind == "X":
        byte, bit = divmod(number, 8)
        if byte >= size:
            raise PathError(f"{path}: {register.type} has bits 0 to {8 * size - 1}")
        at = size - 1 - byte if layout.byte_order == "big" else byte
        return Register(path, "BOOL", (), register.offset + at, bit, 1, 1, register.comment)
    name, width = _WIDTHS[kind]
    if width >= size or number >= size // width:
        widths = [(other, step) for other, (_, step) in _WIDTHS.items() if step < size]
        there = [f"%X0 to %X{8 * size - 1}", *(f"%{other}0 to %{other}{size // step - 1}" for other, step in widths)]
        raise PathError(f"{path}: {register.type} has no such part; it has {', '.join(there)}")
    at = size - width * (number + 1) if layout.byte_order == "big" else width * number
    return Register(path, name, (), register.offset + at, None, width, 1, register.comment)


def slice_of(layout: Layout, array: Register, leading: tuple[int, ...], low: int, high: int) -> Register:
    """Return the elements ``low`` to ``high`` of an array's last dimension as one register.

    ``leading`` are the indices in the other dimensions.

    Raises:
        PathError: The array has no elements with the indices ``leading``, or lacks some from
            ``low`` to ``high``.

    """
    path = "/".join((array.path, *map(str, leading), f"{low}..{high}"))
    if len(array.dims) != len(leading) + 1:
        raise PathError(f"{path}: a range must take the place of an array's last index")
    if high < low:
        raise PathError(f"{path}: write the lower index first")
    first = layout.element(array, (*leading, low))
    layout.element(array, (*leading, high))
    count = high - low + 1
    if first.bit is None:
        size = array_size(array.element, (count,))
        return Register(
            path, array.type, ((low, high),), first.offset, None, size, count, array.comment, unit=array.unit,
            encoding=array.encoding,
        )  # fmt: skip
    size = -(-(first.bit + count) // 8)
    return Register(
        path, "BOOL", ((low, high),), first.offset, first.bit, size, count, array.comment, partial=True
    )  # fmt: skip


def names_part(path: str) -> bool:
    """Return whether a path names a slice, or a bit or another part of an integer."""
    last = path.rpartition("/")[2]
    return bool(_PART.fullmatch(last) or _RANGE.fullmatch(last))


def holders(path: str) -> Iterator[str]:
    """Yield a canonical path, and then the path of each element, array and structure that contains it."""
    yield path
    if part := _PART.fullmatch(path):
        path = part["head"]
        yield path
    while path := path.rpartition("/")[0]:
        yield path


def holder(layout: Layout, register: Register) -> str:
    """Return the path of the layout's register that is or contains ``register``, which :func:`find` returned."""
    return next(path for path in holders(register.path) if path in layout.by_path)


def find_each(layout: Layout, path: str, source: str = "") -> Iterator[Register]:
    """Yield the register that a canonical path names, or each element of the slice it names.

    The arguments are those of :func:`find`.

    Raises:
        PathError: The layout has nothing at this path: see :func:`find`.

    """
    register = find(layout, path, source)
    head, _, last = path.rpartition("/")
    if path in layout.by_path or not _RANGE.fullmatch(last):
        yield register
        return
    ((low, high),) = register.dims
    for index in range(low, high + 1):
        yield find(layout, f"{head}/{index}")


def _array(layout: Layout, path: str) -> tuple[Register, tuple[int, ...]] | None:
    """Split a path into a register and the indices after its path; return None if this is impossible."""
    indices: tuple[int, ...] = ()
    while (index := layout.by_path.get(path)) is None:
        path, _, last = path.rpartition("/")
        if len(indices) == MAX_DIMENSIONS or not _INDEX.fullmatch(last):
            return None
        indices = (int(last), *indices)
    return layout.registers[index], indices


def _unknown(layout: Layout, path: str, source: str) -> str:
    if not path:
        return f"{layout.name}: the path names a source, not a register"
    if below := layout.members(path):
        inside = ", ".join(layout.registers[i].path for i in below[:3])
        return f"{shorten(path)}: this is a structure, not a register; it contains {inside}{', …' if below[3:] else ''}"
    known, missing, names = _where_it_ends(layout, path)
    prefix = f"{known}/" if known else ""
    if names and all(map(_INDEX.fullmatch, names)):
        numbers = sorted(map(int, names))
        return f"{shorten(prefix + missing)}: the index is outside {numbers[0]}..{numbers[-1]}"
    like = _near_topics(layout, path, source) if source else near(layout, path)
    return f"{shorten(path)}: {layout.name} has no such register{f'; {did_you_mean(like)}' if like else ''}"


def _near_topics(layout: Layout, path: str, source: str) -> list[str]:
    """Return up to three topics that resemble a path, whose first segment may be a misspelt or another source."""
    first, _, rest = path.partition("/")
    below = rest.partition("/")[0]
    like = near(layout, rest) if rest and (similar_name(first, [source]) or layout.in_any_case(below)) else []
    return [f"{source}/{one}" for one in like or near(layout, path)]


def near(layout: Layout, path: str) -> list[str]:
    """Return up to three paths of registers, elements or structures that resemble this one."""
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
    import difflib  # noqa: PLC0415  only this message needs it

    near = difflib.get_close_matches(wanted, names, n=3)
    return [written for name in near if (written := layout.in_any_case(name))]


def _where_it_ends(layout: Layout, path: str) -> tuple[str, str, list[str]]:
    """Return the longest prefix that is a structure, the segment after it, and the structure's members."""
    known, below = path, tuple[int, ...]()
    while known and not below:
        known = known.rpartition("/")[0]
        below = layout.members(known)
    start = len(known) + 1 if known else 0
    indices = below or range(len(layout.registers))
    names = dict.fromkeys(layout.registers[i].path[start:].partition("/")[0] for i in indices[:_NEAR_CANDIDATES])
    return known, path[start:].partition("/")[0], list(names)


def shorten(text: str, limit: int = 120) -> str:
    """Return a text, cut to at most ``limit`` characters, for error messages."""
    return text if len(text) <= limit else f"{text[: limit - 1]}…"
