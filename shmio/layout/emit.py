"""Turn placed structures into registers: flatten structures and expand arrays of structures."""

from __future__ import annotations

import itertools
import math
import re
from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby

import msgspec

from shmio.errors import ValueRangeError
from shmio.layout.model import Dims, Register, flat_index, shape_of
from shmio.layout.place import Field, Group, Leaf, Repeat
from shmio.layout.report import Report
from shmio.layout.source.constants import Constants
from shmio.layout.source.syntax import Assignment, Position
from shmio.layout.values import calendar
from shmio.layout.values.literal import REPEAT, default_text, split_array, split_items
from shmio.wording import brief

_NAMED = re.compile(r'\s*(?:"([^"]*)"|(\w+))\s*:=(.*)', re.DOTALL)
_BRACKETS = {"(": ")", "[": "]"}
_DTL_PARTS = ("YEAR", "MONTH", "DAY", "WEEKDAY", "HOUR", "MINUTE", "SECOND", "NANOSECOND")
_DTL = "DTL#{YEAR:04}-{MONTH:02}-{DAY:02}-{HOUR:02}:{MINUTE:02}:{SECOND:02}.{NANOSECOND:09}"
_Layers = tuple[Mapping[str, str], ...]


def registers(group: Group, report: Report) -> Iterator[Register]:
    """Yield the registers of a placed block in address order."""
    return _Expansion(report).registers(group, "", 0, ())


class _Expansion:
    """Flattens structures.

    The initial value of a structure is split into the initial values of its members, a *layer*. If
    several nested structures give a member a value, the value of the outermost structure counts.
    """

    def __init__(self, report: Report) -> None:
        self._report = report
        # Caches: each text is parsed only once, however often its structure is expanded.
        self._split: dict[tuple[int, str], dict[str, str]] = {}
        self._listed: dict[tuple[int, str], list[str | None]] = {}
        self._reported: set[Position] = set()

    def registers(self, group: Group, prefix: str, base: int, layers: _Layers) -> Iterator[Register]:
        for key, field in group.fields.items():
            path, offset = prefix + field.segment, base + field.offset
            given = [layer[key] for layer in layers if key in layer]
            if field.member.initial is not None:
                given.append(field.member.initial)
            if isinstance(field.type, Leaf):
                yield _register(field, field.type, path, offset, given[0] if given else None)
            elif isinstance(field.type, Group):
                inner = tuple(self._members(text, field.type, field) for text in given)
                yield from self.registers(field.type, f"{path}/", offset, inner)
            else:
                yield from self._elements(field, field.type, path, offset, given)

    def _elements(self, field: Field, array: Repeat, path: str, offset: int, given: list[str]) -> Iterator[Register]:
        texts = []
        for text in given:
            key = id(array), text
            if key not in self._listed:
                self._listed[key] = _element_values(text, array.dims)
            texts.append(self._listed[key])
        if not texts:  # all elements are alike
            first = list(self.registers(array.group, "", 0, ()))
            for flat, index in enumerate(_indices(array.dims)):
                prefix, start = f"{path}/{index}/", offset + flat * array.group.size
                for one in first:
                    yield Register(
                        prefix + one.path, one.type, one.dims, start + one.offset, one.bit, one.size, one.count,
                        one.comment, one.initial,
                    )  # fmt: skip
            return
        for flat, index in enumerate(_indices(array.dims)):
            own = [values[flat] for values in texts]
            layers = tuple(self._members(text, array.group, field) for text in own if text is not None)
            yield from self.registers(array.group, f"{path}/{index}/", offset + flat * array.group.size, layers)

    def _members(self, text: str, group: Group, field: Field) -> dict[str, str]:
        key = id(group), text
        if key not in self._split:
            try:
                self._split[key] = _member_values(text, group)
            except ValueRangeError as error:
                self._split[key] = {}
                position = field.member.position
                if position not in self._reported:
                    self._reported.add(position)
                    what = f"the initial value of the structure {field.member.name!r} is ignored: {error}"
                    self._report.add(position.warning(what))
        return self._split[key]


def _register(field: Field, leaf: Leaf, path: str, offset: int, initial: str | None) -> Register:
    is_bool = leaf.element.base == "BOOL"
    return Register(
        path=path,
        type=leaf.element.name,
        dims=leaf.dims,
        offset=offset,
        bit=(field.bit or 0) if is_bool else None,
        size=leaf.size,
        count=math.prod(leaf.shape),
        comment=field.member.comment,
        initial=initial,
    )


def _indices(dims: Dims) -> Iterator[str]:
    ranges = (range(low, high + 1) for low, high in dims)
    return ("/".join(map(str, index)) for index in itertools.product(*ranges))


def _member_values(text: str, group: Group) -> dict[str, str]:
    """Split a structure's initial value into the texts of its members.

    Returns:
        The texts of the members that have an initial value, by name in lower case.

    Raises:
        ValueRangeError: The text is not a list of values, names an unknown member, or has too many
            values.
    """
    inner = _inside_structure(text)
    if inner is None:
        raise ValueRangeError(f"expected a value such as (1, 2) or (a := 1, b := 2), found {brief(text)}")
    items = list(split_items(inner))
    if items and all(_NAMED.fullmatch(item) for item in items):
        return dict(_by_name(items, group))
    values: dict[str, str] = {}
    all_names = group.names or tuple(group.fields)
    names = iter(all_names)
    for item in _repeated(items, len(all_names)):
        name = next(names, None)
        if name is None:
            raise ValueRangeError(f"expected at most {len(all_names)} values, found {brief(text)}")
        if item not in ("", "()"):
            values[name] = item
    return values


def _element_values(text: str, dims: Dims) -> list[str | None]:
    """Split the initial value of an array of structures into one text for each element.

    The text of an element without an initial value is None.
    """
    shape = shape_of(dims)
    values: list[str | None] = [None] * math.prod(shape)
    if text.strip().startswith("("):
        text = f"[{_inside_structure(text) or ''}]"
    for start, count, item in split_array(text, shape):
        if item not in ("", "()"):
            values[start : start + count] = [item] * count
    return values


def _by_name(items: list[str], group: Group) -> Iterator[tuple[str, str]]:
    for item in items:
        if match := _NAMED.fullmatch(item):
            name = match[1] or match[2] or ""
            if name.lower() not in (group.names or group.fields):
                raise ValueRangeError(f"expected a member of the structure, found {name!r}")
            yield name.lower(), match[3].strip()


def _repeated(items: list[str], most: int) -> Iterator[str]:
    for item in items:
        if match := REPEAT.fullmatch(item):
            inner = list(split_items(match[2]))
            for _ in range(min(int(match[1]), most + 1)):
                yield from inner
        else:
            yield item


def _inside_structure(text: str) -> str | None:
    """Return the text inside the enclosing brackets, or None if there are none."""
    text = text.strip()
    return text[1:-1] if len(text) >= 2 and _BRACKETS.get(text[0]) == text[-1] else None


def assign(
    group: Group,
    found: Sequence[Register],
    assignments: Sequence[Assignment],
    constants: Constants,
    report: Report,
) -> tuple[Register, ...]:
    """Return the registers ``found``, with the values that the source assigns after BEGIN as initial values.

    Assignments to elements of one array are joined into one array literal.
    """
    if not assignments:
        return tuple(found)
    by_path = {register.path: index for index, register in enumerate(found)}
    texts: dict[int, _InitialTexts] = {}
    for assignment in assignments:
        target = _target(group, assignment)
        if target is None:
            what = "the value is ignored: the members of its type are unknown"
            report.add(assignment.position.warning(what))
            continue
        if isinstance(target, str):
            report.add(assignment.position.error(target))
            continue
        index = by_path[target.path]
        text = texts.setdefault(index, _InitialTexts(found[index]))
        value = constants.substitute(assignment.value) or ""
        if not target.part:
            text.set(target.index, value)
        elif not text.set_part(target.index, target.part, value):
            report.add(assignment.position.error(f"expected a whole number for {target.part}"))
    result = list(found)
    for index, text in texts.items():
        result[index] = msgspec.structs.replace(found[index], initial=str(text))
    return tuple(result)


@dataclass(frozen=True, slots=True)
class _Target:
    path: str
    index: tuple[int, ...] = ()  # of an array element
    part: str = ""  # member of a DTL: TIA Portal may assign a DTL member by member


def _target(group: Group, assignment: Assignment) -> _Target | str | None:
    """Return the register to which a value is assigned, or the text of an error.

    Return None if the register is inside a structure whose members are unknown.
    """
    path = ""
    element: tuple[int, ...] = ()
    place: Leaf | Group | Repeat = group
    parts = list(assignment.target)
    while parts and not isinstance(place, Leaf):
        part = parts.pop(0)
        if isinstance(place, Repeat):
            if isinstance(part, str) or not _inside(part, place.dims):
                return _expected_index(place.dims, part)
            path, place = f"{path}/{'/'.join(map(str, part))}", place.group
            continue
        if place.opaque:
            return None
        field = place.fields.get(part.lower()) if isinstance(part, str) else None
        if field is None and isinstance(part, str) and part.lower() in place.names:
            return None
        if field is None:
            return f"expected a member of this block, found {_written(part)}"
        path, place = (f"{path}/" if path else "") + field.segment, field.type
    if not isinstance(place, Leaf):
        return "expected the name of a single value, found a structure"
    if parts and not isinstance(index := parts[0], str):
        if not _inside(index, place.dims):
            return _expected_index(place.dims, index)
        element = index
        del parts[0]
    if not parts:
        return _Target(path, element)
    part, single = parts[0], bool(element) or not place.dims
    if (
        single
        and place.element.base == "DTL"
        and len(parts) == 1
        and isinstance(part, str)
        and part.upper() in _DTL_PARTS
    ):
        return _Target(path, element, part.upper())
    return f"expected ':=' and a value, found {_written(part)}"


def _inside(index: tuple[int, ...], dims: Dims) -> bool:
    return len(index) == len(dims) and all(low <= i <= high for i, (low, high) in zip(index, dims, strict=True))


def _expected_index(dims: Dims, found: str | tuple[int, ...]) -> str:
    if not dims:
        return f"expected no index, found {_written(found)}"
    return f"expected an index within {list(map(list, dims))}, found {_written(found)}"


def _written(part: str | tuple[int, ...]) -> str:
    return repr(part) if isinstance(part, str) else str(list(part))


class _InitialTexts:
    """Applies assignments to the initial value of one register; ``str()`` returns the result as source text.

    Of an array, it stores only the assigned elements, because a large array may have few of them.
    """

    def __init__(self, register: Register) -> None:
        self._register = register
        self._whole = register.initial
        self._elements: dict[int, str] = {}
        self._parts: dict[tuple[int, ...], dict[str, int]] = {}  # DTLs to whose members values are assigned

    def set(self, index: tuple[int, ...], text: str) -> None:
        """Assign one element, or the whole register if ``index`` is empty."""
        self._parts.pop(index, None)
        if not index:
            self._whole = text
            self._elements.clear()
            self._parts.clear()
            return
        self._elements[flat_index(self._register.dims, index)] = text

    def set_part(self, index: tuple[int, ...], part: str, text: str) -> bool:
        """Assign one member of a DTL; return False if the text is not a whole number."""
        digits = text.replace("_", "")
        if not digits.isdecimal() or not digits.isascii() or len(digits) > 9:
            return False
        parts = self._parts.get(index)
        if parts is None:
            current = self._elements.get(flat_index(self._register.dims, index)) if index else self._whole
            ns = calendar.parse_moment((current or "").rpartition("#")[2]) or 0
            moment = [int(field) for field in re.findall(r"[0-9]+", calendar.format_moment(ns, 9))]
            parts = dict(zip(_DTL_PARTS, [*moment[:3], 0, *moment[3:]], strict=True))
        parts[part] = int(digits)
        self.set(index, _DTL.format(**parts))
        self._parts[index] = parts
        return True

    def __str__(self) -> str:
        if not self._elements:
            return self._whole or ""
        default = default_text(self._register.element)
        assigned = sorted(self._elements)
        runs: list[tuple[str, int]] = []
        position = 0
        for start, count, text in split_array(self._whole or "", self._register.shape):
            self._fill(runs, assigned, position, start, default)
            self._fill(runs, assigned, start, start + count, text)
            position = start + count
        self._fill(runs, assigned, position, self._register.count, default)
        merged = [(text, sum(n for _, n in group)) for text, group in groupby(runs, key=lambda run: run[0])]
        return f"[{', '.join(text if n == 1 else f'{n}({text})' for text, n in merged)}]"

    def _fill(self, runs: list[tuple[str, int]], assigned: list[int], start: int, stop: int, text: str) -> None:
        """Append the values of the elements ``start`` to ``stop`` - 1; ``text`` if none was assigned."""
        for flat in assigned[bisect_left(assigned, start) : bisect_left(assigned, stop)]:
            if flat > start:
                runs.append((text, flat - start))
            runs.append((self._elements[flat], 1))
            start = flat + 1
        if stop > start:
            runs.append((text, stop - start))
