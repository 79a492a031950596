"""The variables of an exported instance, and the messages between the FMU's library and its process.

A message is u32 kind, u32 size, then ``size`` bytes, in the byte order of the machine. The process
first sends the number of variables of each kind. Then, each request has two numbers and the values of
all variables. Each answer has the values of all variables, or is an error with a text.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple

from shmio.errors import ConfigError, ValueRangeError
from shmio.lab.laboratory import Laboratory
from shmio.layout.glob import choose
from shmio.layout.model import Register
from shmio.layout.values.codec import RegisterCodec, codec, flatten
from shmio.layout.values.write import cover

KINDS: Final = ("Real", "Integer", "Boolean", "String")
MAX_VARIABLES: Final = 50_000
_SMALL: Final = frozenset({"BYTE", "WORD", "SINT", "USINT", "INT", "UINT", "DINT"})
_LARGE: Final = frozenset({"DWORD", "LWORD", "UDINT", "LINT", "ULINT", "REAL", "LREAL"})


class Group(NamedTuple):
    """The variables of a register: one variable or, for an array, one for each element.

    ``kind`` is the type of the variables in FMI. ``first`` is the index of the first variable among
    all variables of this kind.
    """

    source: str
    register: Register
    kind: str
    first: int
    names: tuple[str, ...]
    is_input: bool
    codec: RegisterCodec


def groups_of(lab: Laboratory, patterns: Sequence[str]) -> tuple[list[Group], list[str]]:
    """Return the variables of an instance, and the registers whose types FMI 2.0 does not have.

    A register is an input if it is writable, and is not computed by a model.

    Args:
        lab: The instance.
        patterns: Patterns of the registers to export; empty for all.

    Raises:
        PathError: A pattern matches no register.
        ConfigError: There are too many variables, or none.

    """
    layouts = {block.source: block.layout for block in lab.plan.blocks}
    found: list[Group] = []
    left_out: list[str] = []
    counts = dict.fromkeys(KINDS, 0)
    writable = {block.source: cover(block.layout, block.attributes.writable) for block in lab.plan.blocks}
    for source, register in dict.fromkeys(choose(patterns or list(layouts), layouts)):
        kind = kind_of(register)
        if kind is None:
            left_out.append(f"{source}/{register.path}")
            continue
        names = tuple(_names(source, register))
        inputs = lab.inputs(source)
        bits = writable[source][register.offset : register.offset + register.size]
        given = (inputs is None or register.path in inputs) and all(bits)
        if kind == "Boolean" and not register.dims:
            given = (inputs is None or register.path in inputs) and bool(bits[0] >> (register.bit or 0) & 1)
        found.append(
            Group(source, register, kind, counts[kind], names, given, codec(register, layouts[source].byte_order))
        )
        counts[kind] += len(names)
    if not found:
        raise ConfigError("the instance has no register that an FMU can have")
    if sum(counts.values()) > MAX_VARIABLES:
        raise ConfigError(
            f"the FMU would have {sum(counts.values())} variables, more than {MAX_VARIABLES}; "
            "select registers with --only"
        )
    return found, left_out


def kind_of(register: Register) -> str | None:
    """Return the type in FMI 2.0 of a register's variables; None if FMI has no type for them."""
    base = register.element.base
    if base in _SMALL:
        return "Integer"
    if base in _LARGE:
        return "Real"
    return "Boolean" if base == "BOOL" else "String" if base in ("STRING", "WSTRING") else None


def _names(source: str, register: Register) -> Iterator[str]:
    if not register.dims:
        yield f"{source}/{register.path}"
        return
    indices: list[tuple[int, ...]] = [()]
    for low, high in register.dims:
        indices = [(*before, index) for before in indices for index in range(low, high + 1)]
    for index in indices:
        yield f"{source}/{register.path}/{'/'.join(map(str, index))}"


class Values:
    """Encodes and decodes the values of all variables, which are lists by kind."""

    def __init__(self, groups: Sequence[Group]) -> None:
        self._groups = groups
        self.counts = {kind: sum(len(one.names) for one in groups if one.kind == kind) for kind in KINDS}
        numbers = f"{self.counts['Real']}d{self.counts['Integer']}i{self.counts['Boolean']}i"
        self._numbers = struct.Struct("=" + numbers)

    def encode(self, images: Mapping[str, bytes]) -> bytes:
        """Encode the values of all registers, from the image of each source, for a message."""
        lists: dict[str, list[Any]] = {kind: [] for kind in KINDS}
        for one in self._groups:
            value = one.codec.decode(images[one.source])
            flat = list(flatten(value, one.register.shape, one.register.path)) if one.register.dims else [value]
            if None in flat:  # the bytes are not a valid value
                flat = [("" if one.kind == "String" else 0) if each is None else each for each in flat]
            lists[one.kind] += flat
        numbers = self._numbers.pack(*lists["Real"], *lists["Integer"], *map(bool, lists["Boolean"]))
        texts = [text.encode() for text in lists["String"]]
        return numbers + b"".join(struct.pack("=I", len(text)) + text for text in texts)

    def decode(self, data: bytes) -> dict[str, list[Any]]:
        """Decode the values of a message, as a list for each kind.

        Raises:
            ValueRangeError: The message is too short.

        """
        try:
            numbers = self._numbers.unpack_from(data)
            at, texts = self._numbers.size, []
            for _ in range(self.counts["String"]):
                (size,) = struct.unpack_from("=I", data, at)
                texts.append(data[at + 4 : at + 4 + size].decode())
                at += 4 + size
        except struct.error:
            raise ValueRangeError("the message of the FMU's library is too short") from None
        except UnicodeDecodeError:
            raise ValueRangeError("the program that runs the FMU has set a text that is not UTF-8") from None
        reals, integers = self.counts["Real"], self.counts["Integer"]
        return {
            "Real": list(numbers[:reals]),
            "Integer": list(numbers[reals : reals + integers]),
            "Boolean": [bool(one) for one in numbers[reals + integers :]],
            "String": texts,
        }

    def changes(
        self, before: Mapping[str, Sequence[Any]], now: Mapping[str, Sequence[Any]]
    ) -> Iterable[tuple[str, Any]]:
        """Yield (path, value) of each input whose value has changed from ``before`` to ``now``."""
        for one in self._groups:
            if not one.is_input:
                continue
            for index, name in enumerate(one.names, one.first):
                value = now[one.kind][index]
                if value != before[one.kind][index]:
                    whole = one.kind == "Real" and one.register.element.base not in ("REAL", "LREAL")
                    yield name, _whole(name, value) if whole else value


def _whole(name: str, value: float) -> int:
    if not value.is_integer():
        raise ValueRangeError(f"{name}: {value:g} is not a whole number")
    return int(value)
