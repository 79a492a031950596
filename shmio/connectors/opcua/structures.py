"""Reads and changes structures by the server's definitions of their data types (OPC 10000-6, section 5.2.7).

Both the definition and the structure come from the server, so either may be wrong. If the bytes of a
structure do not have exactly the length that its definition demands, none of its members has a value.
"""

from __future__ import annotations

import itertools
import math
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from shmio.connectors.opcua import decode as ua
from shmio.connectors.opcua.decode import Extension, MalformedError, NodeKey, Reader, Sample, node_key
from shmio.connectors.opcua.values import MismatchError
from shmio.layout.addresses.opcua import Member, member_text

MAX_DEPTH: Final = 16
"""Maximum number of levels of nested structures."""
MAX_VALUES: Final = 100_000
"""Maximum number of members and elements of a value. Elements of two or more bytes each do not count."""
_MAX_FIELDS: Final = 1000
_MAX_RANK: Final = 6
_MAX_NAMED: Final = 10
_MAX_OPTIONAL: Final = 32
_STRUCTURE_DEFINITION: Final = 122
_PLAIN, _OPTIONAL, _UNION = 0, 1, 2
NULL: Final[NodeKey] = (2, 0, 0)
"""The null node id."""


class DefinedField(NamedTuple):
    """A field as the definition of a data type declares it."""

    name: str
    data_type: NodeKey
    rank: int
    """Value rank of OPC UA: -1 for a scalar; if positive, the number of dimensions."""
    optional: bool


class Definition(NamedTuple):
    """Definition of a data type that is a structure, with the node id of its binary encoding."""

    encoding: NodeKey
    form: int
    fields: tuple[DefinedField, ...]


class Field(NamedTuple):
    """A member of a structure.

    ``kind`` is the number of the member's built-in type, unless the member is a structure itself.
    """

    name: str
    kind: int
    structure: Structure | None
    rank: int
    """Number of dimensions; 0 for a scalar, -1 if unknown."""
    optional: bool


@dataclass(eq=False)
class Structure:
    """A data type that is a structure, with everything needed to read its values."""

    name: str
    form: int = _PLAIN
    fields: list[Field] = field(default_factory=list)
    fault: str = ""
    """Why values of this type cannot be read; empty if they can."""

    @property
    def is_union(self) -> bool:
        """True if a value has at most one of the members."""
        return self.form == _UNION


class Members(NamedTuple):
    """The value of a structure. In ``values``, None stands for a member that is absent at present."""

    structure: Structure
    values: dict[str, Found | None]


class Elements(NamedTuple):
    """The value of an array of structures."""

    values: list[Members]
    dims: tuple[int, ...]


Found = Sample | Members | Elements


def read_definition(sample: Sample) -> Definition | None:
    """Return the definition in a value of the attribute DataTypeDefinition; None if it defines no structure.

    Raises:
        MalformedError: The definition does not follow the protocol.

    """
    value = sample.value
    if sample.kind != ua.EXTENSION or not isinstance(value, Extension):
        return None
    if Reader(value.encoding).type_id() != _STRUCTURE_DEFINITION:
        return None
    reader = Reader(value.body)
    encoding = node_key(reader.node_id())
    reader.node_id()  # the base type, whose fields are repeated below
    form = reader.i32()
    if (count := reader.count(20)) > _MAX_FIELDS:
        raise MalformedError(f"a structure has more than {_MAX_FIELDS} members")
    return Definition(encoding, form, tuple(_defined_field(reader) for _ in range(count)))


def _defined_field(reader: Reader) -> DefinedField:
    name = reader.text()
    reader.scalar(ua.LOCALIZED_TEXT, 0)
    data_type, rank = node_key(reader.node_id()), reader.i32()
    reader.skip(4 * reader.count(4))
    reader.skip(4)  # the maximum length of texts
    return DefinedField(name, data_type, rank, bool(reader.u8()))


def complete(structure: Structure, form: int, fields: list[Field]) -> None:
    """Set the fields of a structure, and set ``fault`` if its values cannot be read."""
    structure.form, structure.fields = form, fields
    names = [one.name for one in fields]
    if form not in (_PLAIN, _OPTIONAL, _UNION):
        structure.fault = "it may have values of types that its definition does not name"
    elif form == _OPTIONAL and sum(one.optional for one in fields) > _MAX_OPTIONAL:
        structure.fault = f"it has more than {_MAX_OPTIONAL} optional members"
    elif len({*names}) < len(names) or not all(names):
        structure.fault = "its members have no names of their own"
    for one in fields:
        if not structure.fault and not 0 <= one.rank <= _MAX_RANK:
            structure.fault = f"its definition does not say whether {one.name} is an array"
        if not structure.fault and not one.kind and one.structure is None:
            structure.fault = f"the server does not define the type of {one.name}"


def _read(structure: Structure, reading: _Reading) -> Members:
    """Read the body of a structure. Raise MismatchError if its definition does not fit, or cannot be used."""
    try:
        found = reading.members(structure, 0)
    except MalformedError as error:
        raise MismatchError(f"the structure {structure.name} does not match the server's definition") from error
    if reading.left:
        raise MismatchError(f"the structure {structure.name} is longer than in the server's definition")
    return found


class _Reading(Reader):
    """Reads the body of a structure."""

    def __init__(self, data: bytes, values: int) -> None:
        super().__init__(data)
        self.values_left = values
        """Number of members and elements that the body may still have."""

    def _count(self, values: int) -> None:
        self.values_left -= values
        if self.values_left < 0:
            raise MalformedError

    def members(self, structure: Structure, depth: int) -> Members:
        if structure.fault:
            raise MismatchError(f"the structure {structure.name} cannot be read: {structure.fault}")
        if depth >= MAX_DEPTH:
            raise MalformedError
        fields = structure.fields
        self._count(1 + len(fields))
        if structure.is_union:
            chosen = self.u32()
            if chosen > len(fields):
                raise MalformedError
            values: dict[str, Found | None] = {one.name: None for one in fields}
            if chosen:
                values[fields[chosen - 1].name] = self.field(fields[chosen - 1], depth)
            return Members(structure, values)
        mask = self.u32() if structure.form == _OPTIONAL else 0
        values = {}
        for one in fields:
            if structure.form == _OPTIONAL and one.optional:
                there, mask = mask & 1, mask >> 1
                values[one.name] = self.field(one, depth) if there else None
            else:
                values[one.name] = self.field(one, depth)
        if mask:
            raise MalformedError
        return Members(structure, values)

    def field(self, one: Field, depth: int) -> Found:
        inner, kind = one.structure, one.kind
        if not one.rank:
            if inner is not None:
                return self.members(inner, depth + 1)
            if kind == ua.VARIANT:
                return ua.sample(*self.variant(depth))
            return (
                self.data_value(depth) if kind == ua.DATA_VALUE else Sample(kind, self.value(kind, depth), None, 0, 0)
            )
        least = 1 if inner is not None else ua.size_of(kind)
        if one.rank == 1:
            dims: tuple[int, ...] = (self.count(least),)
        else:
            if self.count(4) != one.rank:
                raise MalformedError
            dims = tuple(max(self.i32(), 0) for _ in range(one.rank))
        count = math.prod(dims)
        if count * least > self.left:
            raise MalformedError
        if inner is not None:
            self._count(count)
            return Elements([self.members(inner, depth + 1) for _ in range(count)], dims)
        if least == 1:
            self._count(count)
        return Sample(kind, self.elements(kind, count, depth), dims, 0, 0)


class AbsentError(ValueError):
    """A node has no structure at present, or a structure does not have a member or an element."""


def read_value(structures: Mapping[NodeKey, Structure], sample: Sample) -> Members | Elements:
    """Return the value of a node that is a structure, or an array of structures.

    Args:
        structures: The known structures, by the node ids of their encodings.
        sample: The value.

    Raises:
        MismatchError: The value is no structure, or its definition is missing or does not fit.
        AbsentError: The value is null.

    """
    return _read_value(structures, sample, _Reading)


def _read_value(
    structures: Mapping[NodeKey, Structure], sample: Sample, reading_of: Callable[[bytes, int], _Reading]
) -> Members | Elements:
    if sample.kind != ua.EXTENSION:
        raise MismatchError(f"the node is {_named(sample)}, not a structure")
    values: list[Extension] = sample.value if sample.dims is not None else [sample.value]
    found: list[Members] = []
    left = MAX_VALUES
    for one in values:
        encoding = node_key(Reader(one.encoding).node_id())
        if encoding == NULL:
            raise AbsentError("it has no value")
        structure = structures.get(encoding)
        if structure is None:
            raise MismatchError("the server does not define the node's structure")
        reading = reading_of(one.body, left)
        found.append(_read(structure, reading))
        left = reading.values_left
    return found[0] if sample.dims is None else Elements(found, sample.dims)


def find(found: Found, member: Member) -> Sample:
    """Return the member of a value that ``member`` names.

    Raises:
        AbsentError: The value lacks this optional member, alternative of a union, or element at
            present.
        MismatchError: The data type has no such member, or ``member`` names a structure.

    """
    found = _walk(found, member)
    if not isinstance(found, Sample):
        raise MismatchError(f"the address names {_named(found)}; give the address of a member")
    return found


def _walk(found: Found, member: Member) -> Found:
    """Return what ``member`` names in a value, also if that is a structure. Raise the errors of :func:`find`."""
    for place, step in enumerate(member):
        here = member_text(member[:place])[1:] or "the value"
        if isinstance(step, str):
            if not isinstance(found, Members):
                raise MismatchError(f"{here} is {_named(found)}, which has no member {step}")
            if step not in found.values:
                raise MismatchError(f"the structure {found.structure.name} has no member {step}; {_there(found)}")
            inner = found.values[step]
            if inner is None:
                raise AbsentError(
                    f"the structure {found.structure.name} has no member {step} at present "
                    "(optional, or another alternative of the union)"
                )
            found = inner
        elif isinstance(found, Members) or found.dims is None or len(found.dims) != len(step):
            raise MismatchError(f"{here} is {_named(found)}, which has no element [{','.join(map(str, step))}]")
        else:
            index = _index(step, found.dims)
            element = found.values[index] if isinstance(found, Elements) else found.value[index]
            if isinstance(element, Members):
                found = element
            else:
                assert isinstance(found, Sample)  # noqa: S101 - for the type checker
                found = found._replace(value=element, dims=None)
    return found


def _index(step: Sequence[int], dims: Sequence[int]) -> int:
    """Return the place of an element in the flat list of an array. Raise AbsentError if the array is too short."""
    index = 0
    for one, size in zip(step, dims, strict=True):
        if one >= size:
            there, wanted = ",".join(map(str, dims)), ",".join(map(str, step))
            raise AbsentError(f"the array [{there}] has no element [{wanted}] at present")
        index = index * size + one
    return index


class ChangedValue:
    """The value of a node that is a structure, or an array of structures, with new values of some members.

    The bytes of all other members stay as the server sent them.
    """

    def __init__(self, structures: Mapping[NodeKey, Structure], sample: Sample) -> None:
        """Read a value.

        Raises:
            MismatchError: As :func:`read_value`.
            AbsentError: As :func:`read_value`.

        """
        self._sample = sample
        self._readings: list[_Locating] = []
        self._new: dict[int, Sample] = {}
        """By ``id`` of the sample of a changed member, its new sample."""
        self._found = _read_value(structures, sample, self._locating)

    def _locating(self, body: bytes, values: int) -> _Reading:
        self._readings.append(_Locating(body, values))
        return self._readings[-1]

    def find(self, member: Member) -> Sample:
        """Return the present or new value of a member. Raise the errors of :func:`find`."""
        owner, index = self._leaf(member)
        now = self._new.get(id(owner), owner)
        return now if index is None else now._replace(value=now.value[index], dims=None)

    def set(self, member: Member, new: Sample) -> None:
        """Change a member's value.

        Raises:
            ValueError: The member cannot be written.

        """
        owner, index = self._leaf(member)
        if index is not None:
            now = self._new.get(id(owner), owner)
            new = now._replace(value=[*now.value[:index], new.value, *now.value[index + 1 :]])
        where = next(one.places[id(owner)] for one in self._readings if id(owner) in one.places)
        _encode(where.field, new)  # raises ValueError
        self._new[id(owner)] = new

    def _leaf(self, member: Member) -> tuple[Sample, int | None]:
        """Return the sample that was read for a member, or for the array whose element ``member`` is, and its index."""
        if member and not isinstance(member[-1], str):
            owner = _walk(self._found, member[:-1])
            if isinstance(owner, Sample) and owner.dims is not None and len(owner.dims) == len(member[-1]):
                return owner, _index(member[-1], owner.dims)
        return find(self._found, member), None

    @property
    def sample(self) -> Sample:
        """The value with all changes applied."""
        given: list[Extension] = self._sample.value if self._sample.dims is not None else [self._sample.value]
        made = []
        for one, reading in zip(given, self._readings, strict=True):
            body, at = bytearray(), 0
            for key, where in reading.places.items():  # in the order of the bytes
                if (new := self._new.get(key)) is not None:
                    body += one.body[at : where.start] + _encode(where.field, new)
                    at = where.end
            made.append(one._replace(body=bytes(body + one.body[at:])))
        return self._sample._replace(value=made if self._sample.dims is not None else made[0])


class _Place(NamedTuple):
    """Where the bytes of a member are."""

    start: int
    end: int
    field: Field


class _Locating(_Reading):
    """Reads the body of a structure, and notes where its members are."""

    def __init__(self, data: bytes, values: int) -> None:
        super().__init__(data, values)
        self.places: dict[int, _Place] = {}
        """The places of members that are no structures, by the ``id`` of their samples."""

    def field(self, one: Field, depth: int) -> Found:
        start = self._at
        found = super().field(one, depth)
        if isinstance(found, Sample):
            self.places[id(found)] = _Place(start, self._at, one)
        return found


def _encode(one: Field, sample: Sample) -> bytes:
    """Encode the value of a member. Raise ValueError if its type cannot be written."""
    values = sample.value if sample.dims is not None else [sample.value]
    data = b"".join(ua.encoded(sample.kind, value) for value in values)
    dims = sample.dims or ()
    if one.kind == ua.VARIANT:
        flags = 0x80 * bool(dims) | 0x40 * (len(dims) > 1)
        sizes = struct.pack(f"<{1 + len(dims)}i", len(dims), *dims) if len(dims) > 1 else b""
        return bytes([sample.kind | flags]) + (struct.pack("<i", len(values)) if dims else b"") + data + sizes
    if sample.kind != one.kind or len(dims) != one.rank:
        raise ValueError(f"a {ua.NAMES[one.kind]} in a structure cannot be written")
    if one.rank == 1:
        return struct.pack("<i", len(values)) + data
    return (struct.pack(f"<{1 + one.rank}i", one.rank, *dims) if one.rank else b"") + data


class Listed(NamedTuple):
    """A member of a structure, as a candidate for a register. ``sample`` has only a type if the member has no value."""

    member: Member
    sample: Sample
    refused: str
    """Why the member cannot be a register; empty if it can."""


def members_of(found: Members | Elements) -> Iterator[Listed]:
    """Yield the members of a structure and of the structures inside it. The caller must limit their number."""
    if isinstance(found, Members):
        yield from _listed(found.structure, found, (), ())
    elif found.values:
        yield from _listed(found.values[0].structure, found, (), ())
    else:
        yield Listed((), Sample(ua.EXTENSION, None, None, 0, 0), "an array without elements")


def _listed(
    structure: Structure, found: Found | None, member: Member, outer: tuple[Structure, ...]
) -> Iterator[Listed]:
    """Yield the members of a structure. If it has no value (``found`` is None), yield those of its definition."""
    refused = structure.fault
    if not refused and not structure.fields:
        refused = "a structure without members"
    elif structure in outer and found is None:
        refused = "a structure that contains itself"
    elif len(outer) >= MAX_DEPTH:
        refused = f"structures deeper than {MAX_DEPTH} levels"
    elif isinstance(found, Elements) and not found.values:
        refused = "an array without elements"
    if refused:
        yield Listed(member, Sample(ua.EXTENSION, None, None, 0, 0), refused)
        return
    if isinstance(found, Elements):
        for index, element in zip(itertools.product(*map(range, found.dims)), found.values, strict=True):
            yield from _listed(element.structure, element, (*member, index), outer)
        return
    for one in structure.fields:
        here = (*member, one.name)
        value = found.values.get(one.name) if isinstance(found, Members) else None
        if one.structure is not None:
            inner = Elements([], ()) if one.rank and value is None else value
            yield from _listed(one.structure, inner, here, (*outer, structure))
        elif isinstance(value, Sample):
            yield Listed(here, value, "")
        else:
            yield Listed(here, Sample(one.kind, None, (0,) * one.rank if one.rank else None, 0, 0), "")


def _named(found: Found) -> str:
    if isinstance(found, Members):
        return f"the structure {found.structure.name}"
    if isinstance(found, Elements):
        return f"an array of {len(found.values)} structures"
    name = ua.NAMES[found.kind] if found.kind < len(ua.NAMES) else f"type {found.kind}"
    return f"a {name}" if found.dims is None else f"an array of {name}"


def _there(found: Members) -> str:
    names = [*found.values]
    return f"it has {', '.join(names[:_MAX_NAMED])}{', …' if len(names) > _MAX_NAMED else ''}"
