"""A model's hold on the images of its block."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, Protocol

import numpy as np

from shmio.errors import ValueRangeError
from shmio.layout.checks import brief
from shmio.layout.codec import codec
from shmio.layout.model import ByteOrder, Register
from shmio.simulation.bulk import Bulk

_PYTHON: Final = frozenset({bool, int, float, str, list, tuple})
_NUMPY: Final = (np.ndarray, np.generic)
_BYTES: Final = (bytes, bytearray)


class Port(Protocol):
    """One declaration in one image."""

    def read(self) -> Any:
        """The value in the image."""

    def write(self, value: object) -> None:
        """Put a value into the image; ValueRangeError."""


def port_of(path: str, registers: Mapping[str, Register], byte_order: ByteOrder, image: bytearray) -> Port:
    """The port of a declaration's registers, by their paths in it: a structure, or one register under ``""``."""
    ports = {member: RegisterPort(register, byte_order, image) for member, register in registers.items()}
    return ports.get("") or StructurePort(path, ports, Bulk.of(registers, byte_order), image)


class RegisterPort:
    """A register, or an array's element."""

    def __init__(self, register: Register, byte_order: ByteOrder, image: bytearray) -> None:
        self._path = register.path
        self._codec = codec(register, byte_order)
        self._image = image
        self._start, self._stop = register.offset, register.offset + register.size
        self._is_row = register.type == "BYTE" and len(register.dims) == 1

    def read(self) -> Any:
        """The value; an array as tuples, for setting an element of a list would go nowhere."""
        if self._is_row:
            return bytes(self._image[self._start : self._stop])
        value = self._codec.decode(self._image)
        return _frozen(value) if isinstance(value, list) else value

    def write(self, value: object) -> None:
        """Put a value into the image, or change nothing; numpy's are as good as Python's."""
        if self._is_row and isinstance(value, _BYTES) and len(value) == self._stop - self._start:
            self._image[self._start : self._stop] = value
            return
        try:
            self._codec.encode_into(value if type(value) in _PYTHON else _plain(value), self._image)
        except ValueRangeError as error:
            text = str(error)
            raise ValueRangeError(text if text.startswith(f"{self._path}:") else f"{self._path}: {text}") from None


class StructurePort:
    """A structure's registers."""

    def __init__(self, path: str, ports: Mapping[str, RegisterPort], bulk: Bulk | None, image: bytearray) -> None:
        """``bulk``: all of them at once, if that can be."""
        self._path = path
        self._ports = ports
        self._bulk = bulk
        self._image = image

    def read(self) -> dict[str, Any]:
        """All members, by path."""
        if self._bulk is not None:
            return self._bulk.read(self._image)
        return {path: port.read() for path, port in self._ports.items()}

    def write(self, value: object) -> None:
        """Change the members that are named."""
        if isinstance(value, Mapping) and self._bulk is not None and self._bulk.write(value, self._image):
            return
        if not isinstance(value, Mapping) or value.keys() - self._ports.keys():
            some = ", ".join(self._ports)
            raise ValueRangeError(f"{self._path}: expected a dict with some of {some}, found {brief(value)}")
        for path, member in value.items():
            self._ports[path].write(member)


class Ends:
    """The two ends of an in-out register."""

    __slots__ = ("_commanded", "_shown")

    def __init__(self, commanded: Port, shown: Port) -> None:
        self._commanded = commanded
        self._shown = shown

    @property
    def commanded(self) -> Any:
        """What was written to it last, its ``/in``; before that its initial value."""
        return self._commanded.read()

    @property
    def shown(self) -> Any:
        """What consumers see, its ``/out``: what the model has set last."""
        return self._shown.read()

    @shown.setter
    def shown(self, value: object) -> None:
        self._shown.write(value)


def _frozen(value: object) -> object:
    return tuple(map(_frozen, value)) if isinstance(value, list) else value


def _plain(value: object) -> object:
    if isinstance(value, _NUMPY):
        return value.tolist()
    return list(value) if isinstance(value, _BYTES) else value
