"""Placed structures to registers: structures are flattened, arrays of structures expanded."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

from shmio.layout.initial import InitialTexts
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
        path, element = target
        index = by_path[path]
        register = found[index]
        texts.setdefault(index, InitialTexts(register)).set(element, assignment.value)
    result = list(found)
    for index, text in texts.items():
        result[index] = replace(found[index], initial=str(text))
    return tuple(result)


def _target(group: Group, assignment: Assignment) -> tuple[str, tuple[int, ...]] | str:
    """Return the register's path and the element's index, ``()`` for the whole; or what is wrong."""
    path = ""
    place: Leaf | Group | Repeat = group
    for part in assignment.target:
        if isinstance(part, str):
            field = place.fields.get(part.lower()) if isinstance(place, Group) else None
            if field is None:
                return f"expected a member of this block, found {part!r}"
            path, place = (f"{path}/" if path else "") + field.segment, field.type
            continue
        dims = () if isinstance(place, Group) else place.dims
        if len(part) != len(dims) or not all(low <= i <= high for i, (low, high) in zip(part, dims, strict=True)):
            return f"expected an index within {list(map(list, dims))}, found {list(part)}"
        if isinstance(place, Leaf):
            return path, part
        if isinstance(place, Repeat):
            path, place = f"{path}/{'/'.join(map(str, part))}", place.group
    if isinstance(place, Leaf):
        return path, ()
    return "expected the name of a single value, found a structure"
