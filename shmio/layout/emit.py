"""Placed structures to registers: structures are flattened, arrays of structures expanded."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from shmio.layout.initial import DTL_PARTS, InitialTexts
from shmio.layout.model import Dims, Register
from shmio.layout.place import Field, Group, Leaf, Repeat
from shmio.layout.report import Report
from shmio.layout.syntax import Assignment


def registers(group: Group, prefix: str = "", base: int = 0) -> Iterator[Register]:
    """Yield the registers of a structure that begins at byte ``base``, in address order."""
    for field in group.fields.values():
        path, offset = prefix + field.segment, base + field.offset
        if isinstance(field.type, Leaf):
            yield _register(field, field.type, path, offset)
        elif isinstance(field.type, Group):
            yield from registers(field.type, f"{path}/", offset)
        else:
            inner = field.type.group
            for flat, index in enumerate(_indices(field.type.dims)):
                yield from registers(inner, f"{path}/{index}/", offset + flat * inner.size)


def _register(field: Field, leaf: Leaf, path: str, offset: int) -> Register:
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
        initial=field.member.initial,
    )


def _indices(dims: Dims) -> Iterator[str]:
    ranges = (range(low, high + 1) for low, high in dims)
    return ("/".join(map(str, index)) for index in itertools.product(*ranges))


def assign(
    group: Group, found: Sequence[Register], assignments: Sequence[Assignment], report: Report
) -> tuple[Register, ...]:
    """Return the registers with the values assigned after BEGIN as their initial ones.

    Elements of one array are gathered into one array literal.
    """
    by_path = {register.path: index for index, register in enumerate(found)}
    texts: dict[int, InitialTexts] = {}
    for assignment in assignments:
        target = _target(group, assignment)
        if isinstance(target, str):
            report.add(assignment.position.error(target))
            continue
        index = by_path[target.path]
        text = texts.setdefault(index, InitialTexts(found[index]))
        if not target.part:
            text.set(target.index, assignment.value)
        elif not text.set_part(target.index, target.part, assignment.value):
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


def _target(group: Group, assignment: Assignment) -> _Target | str:
    """Return the register that is assigned; or what is wrong."""
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
