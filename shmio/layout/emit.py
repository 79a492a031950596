"""Placed structures to registers: structures are flattened, arrays of structures expanded."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from shmio.errors import ValueRangeError
from shmio.layout.constants import Constants
from shmio.layout.initial import DTL_PARTS, InitialTexts
from shmio.layout.model import Dims, Register
from shmio.layout.placed import Field, Group, Leaf, Repeat
from shmio.layout.report import Report
from shmio.layout.structured import element_values, member_values
from shmio.layout.syntax import Assignment, Position

Layers = tuple[Mapping[str, str], ...]


def registers(group: Group, report: Report) -> Iterator[Register]:
    """Yield the registers of a placed block in address order."""
    return _Expansion(report).registers(group, "", 0, ())


class _Expansion:
    """Flattens structures. Values given to a structure as a whole come down in layers, the outermost first."""

    def __init__(self, report: Report) -> None:
        self._report = report
        # Each text is read once, however often its structure is expanded.
        self._split: dict[tuple[int, str], dict[str, str]] = {}
        self._listed: dict[tuple[int, str], list[str | None]] = {}
        self._told: set[Position] = set()

    def registers(self, group: Group, prefix: str, base: int, layers: Layers) -> Iterator[Register]:
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
                self._listed[key] = element_values(text, array.dims)
            texts.append(self._listed[key])
        for flat, index in enumerate(_indices(array.dims)):
            own = [values[flat] for values in texts]
            layers = tuple(self._members(text, array.group, field) for text in own if text is not None)
            yield from self.registers(array.group, f"{path}/{index}/", offset + flat * array.group.size, layers)

    def _members(self, text: str, group: Group, field: Field) -> dict[str, str]:
        key = id(group), text
        if key not in self._split:
            try:
                self._split[key] = member_values(text, group)
            except ValueRangeError as error:
                self._split[key] = {}
                position = field.member.position
                if position not in self._told:
                    self._told.add(position)
                    what = f"the initial value of the structure {field.member.name!r} is not read: {error}"
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


def assign(
    group: Group,
    found: Sequence[Register],
    assignments: Sequence[Assignment],
    constants: Constants,
    report: Report,
) -> tuple[Register, ...]:
    """Return the registers with the values assigned after BEGIN as their initial ones.

    Elements of one array are gathered into one array literal.
    """
    if not assignments:
        return tuple(found)
    by_path = {register.path: index for index, register in enumerate(found)}
    texts: dict[int, InitialTexts] = {}
    for assignment in assignments:
        target = _target(group, assignment)
        if target is None:
            what = "the value is not read: the members of its type are not known"
            report.add(assignment.position.warning(what))
            continue
        if isinstance(target, str):
            report.add(assignment.position.error(target))
            continue
        index = by_path[target.path]
        text = texts.setdefault(index, InitialTexts(found[index]))
        value = constants.substitute(assignment.value) or ""
        if not target.part:
            text.set(target.index, value)
        elif not text.set_part(target.index, target.part, value):
            report.add(assignment.position.error(f"expected a whole number for {target.part}"))
    result = list(found)
    for index, text in texts.items():
        result[index] = replace(found[index], initial=str(text))
    return tuple(result)


@dataclass(frozen=True, slots=True)
class _Target:
    path: str
    index: tuple[int, ...] = ()  # of an array's element
    part: str = ""  # of a DTL, which TIA Portal also assigns member by member


def _target(group: Group, assignment: Assignment) -> _Target | str | None:
    """Return the register that is assigned, or what is wrong; None: the members of its type are not known."""
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
        and part.upper() in DTL_PARTS
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
