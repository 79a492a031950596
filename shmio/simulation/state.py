"""Encodes the state of models for snapshots, as data that runs no code when it is read.

The data may contain None, numbers, texts, bytes, bytearrays, lists, tuples, dicts, sets, deques,
numpy arrays, random generators, and objects, named tuples and enumerations of classes that the
model's own modules or the modules in its ``state_modules`` define. An object is created without
calling its class, and only its attributes are set. An object that is referenced from several places
stays one object.
"""

from __future__ import annotations

import math
import random
import sys
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping
from enum import Enum
from typing import Any, Final, Literal, cast

import msgspec
import numpy as np

from shmio.errors import SnapshotError

MAX_STATE_BYTES: Final = 64 << 20
"""Maximum size of the encoded state of one model, in bytes."""
_MAX_DEPTH: Final = 100
_GENERATORS: Final = ("PCG64", "PCG64DXSM", "Philox", "MT19937", "SFC64")
_ARRAY_KINDS: Final = "biufcSUmM"
_SMALL: Final = 1 << 63
_SELF = "self"


def encode_state(value: object, model: object, modules: Collection[str]) -> bytes:
    """Encode a value.

    Args:
        value: The value.
        model: The model. A reference to this object is encoded as a reference to the model.
        modules: The names of the modules whose classes the objects may have.

    Raises:
        SnapshotError: A part of the value cannot be encoded; the message names it.

    """
    try:
        data = msgspec.msgpack.encode(_Encoder(model, modules).node(value, "", 0))
    except (msgspec.MsgspecError, UnicodeEncodeError, RecursionError) as error:
        raise SnapshotError(f"the state cannot be encoded: {error}") from None
    if len(data) > MAX_STATE_BYTES:
        raise SnapshotError(f"the state has {len(data)} bytes, more than {MAX_STATE_BYTES}")
    return data


def decode_state(data: bytes, model: object, modules: Collection[str]) -> Any:
    """Decode a value of :func:`encode_state`. ``model`` and ``modules`` are the same as for that function.

    Raises:
        SnapshotError: The data are invalid.

    """
    if len(data) > MAX_STATE_BYTES:
        raise SnapshotError(f"the state has {len(data)} bytes, more than {MAX_STATE_BYTES}")
    try:
        return _Decoder(model, modules).value(msgspec.msgpack.decode(data), 0)
    except SnapshotError:
        raise
    except Exception as error:  # noqa: BLE001  whatever damaged data cause
        raise SnapshotError(f"the state is damaged: {type(error).__name__}: {error}") from None


def find_class(module: str, name: str, modules: Collection[str]) -> type | None:
    """Return the class ``name`` of the module ``module``.

    Return None if ``modules`` does not contain the module, if the module is not imported yet, or if
    it defines no such class.
    """
    if module not in modules:
        return None
    found: object = sys.modules.get(module)
    for part in name.split("."):
        found = vars(found).get(part) if hasattr(found, "__dict__") else None
    ok = isinstance(found, type) and (found.__module__, found.__qualname__) == (module, name)
    return cast("type", found) if ok else None


class _Encoder:
    def __init__(self, model: object, modules: Collection[str]) -> None:
        self._model = model
        self._modules = modules
        self._seen: dict[int, int] = {}
        self._kept: list[object] = []  # so that no id is used twice
        self._memory: dict[int, str] = {}  # by the id of an object that owns memory: where it is used

    def node(self, value: object, where: str, depth: int) -> object:
        """Return the encoded form of a value; ``where`` names the value in messages."""
        if depth > _MAX_DEPTH:
            raise SnapshotError(f"{where} is nested deeper than {_MAX_DEPTH} levels")
        kind = type(value)
        if value is None or kind in (bool, float, str, bytes):
            return value
        if kind is int:
            number = cast("int", value)
            return number if -_SMALL <= number < _SMALL else ["int", hex(number)]
        if value is self._model:
            return [_SELF]
        if isinstance(value, np.generic):
            self._check_dtype(value.dtype, where)
            return ["scalar", value.dtype.str, value.tobytes()]
        if isinstance(value, Enum):
            self._check_class(kind, where)
            if value.name not in type(value).__members__:
                raise self._refusal(value, where)
            return ["enum", kind.__module__, kind.__qualname__, value.name]
        if kind is tuple or kind is frozenset:
            return [kind.__name__, self._items(cast("tuple[object, ...]", value), where, depth)]
        if isinstance(value, tuple):
            self._check_class(kind, where)
            return ["named", kind.__module__, kind.__qualname__, self._items(value, where, depth)]
        if id(value) in self._seen:
            return ["same", self._seen[id(value)]]
        self._seen[id(value)] = len(self._seen)
        self._kept.append(value)
        return self._mutable(value, kind, where, depth)

    def _mutable(self, value: Any, kind: type, where: str, depth: int) -> list[object]:
        if kind is list or kind is set:
            return [kind.__name__, self._items(value, where, depth)]
        if kind is deque:
            return ["deque", value.maxlen, self._items(value, where, depth)]
        if kind is bytearray:
            self._claim(value, where)
            return ["bytearray", bytes(value)]
        if kind is dict:
            return ["dict", self._pairs(value, where, depth)]
        if kind is np.ndarray:
            return self._array(value, where)
        if kind is np.random.Generator:
            made = value.bit_generator
            if type(made).__name__ not in _GENERATORS:
                raise self._refusal(value, where)
            return ["generator", type(made).__name__, _Encoder(None, ()).node(made.state, where, depth)]
        if kind is random.Random:
            return ["random", self.node(value.getstate(), where, depth + 1)]
        self._check_class(kind, where)
        return ["object", kind.__module__, kind.__qualname__, self._pairs(_attributes(value), where, depth)]

    def _items(self, values: Any, where: str, depth: int) -> list[object]:
        return [self.node(one, f"{where}[{place}]", depth + 1) for place, one in enumerate(values)]

    def _pairs(self, values: Mapping[Any, object], where: str, depth: int) -> list[object]:
        return [
            [self.node(key, where, depth + 1), self.node(one, f"{where}.{key}" if where else str(key), depth + 1)]
            for key, one in values.items()
        ]

    def _array(self, value: np.ndarray[Any, Any], where: str) -> list[object]:
        self._check_dtype(value.dtype, where)
        self._claim(value, where)
        order: Literal["C", "F"] = (
            "F" if value.flags.f_contiguous and not value.flags.c_contiguous else "C"
        )  # sums depend on it
        return ["array", value.dtype.str, list(value.shape), order, value.tobytes(order)]

    def _claim(self, value: object, where: str) -> None:
        """Raise SnapshotError if an array or a bytearray that was encoded before has the same memory."""
        owner: Any = value
        while isinstance(owner, np.ndarray | memoryview):
            base = owner.obj if isinstance(owner, memoryview) else owner.base
            if base is None or isinstance(base, bytes):  # nothing can change the memory of bytes
                break
            owner = base
        if id(owner) in self._memory:
            other = self._memory[id(owner)]
            raise SnapshotError(f"the arrays {other} and {where} share memory, which a snapshot cannot restore{_HOOKS}")
        self._memory[id(owner)] = where

    def _check_dtype(self, dtype: np.dtype[Any], where: str) -> None:
        if dtype.kind not in _ARRAY_KINDS:
            raise SnapshotError(f"{where} is an array of {dtype}, which a snapshot cannot store{_HOOKS}")

    def _check_class(self, kind: type, where: str) -> None:
        if find_class(kind.__module__, kind.__qualname__, self._modules) is not kind or not _is_plain(kind):
            raise SnapshotError(
                f"{where or 'the state'} is of type {kind.__module__}.{kind.__qualname__}, which a snapshot cannot "
                f"store{_HOOKS}"
            )

    def _refusal(self, value: object, where: str) -> SnapshotError:
        return SnapshotError(f"{where or 'the state'} is {value!r:.60}, which a snapshot cannot store{_HOOKS}")


_HOOKS: Final = "; give the model save_state() and restore_state()"


def _is_plain(kind: type) -> bool:
    """Return whether objects of a class consist of their attributes, or are enumerations or named tuples."""
    if issubclass(kind, Enum):
        return True
    if issubclass(kind, tuple):
        return hasattr(kind, "_fields")
    try:
        object.__new__(kind)
    except TypeError:
        return False
    return True


def _slots(kind: type) -> Iterator[str]:
    for base in kind.__mro__:
        slots = vars(base).get("__slots__", ())
        for name in (slots,) if isinstance(slots, str) else tuple(slots):
            if name not in ("__dict__", "__weakref__"):
                yield name


def _attributes(value: object) -> dict[str, object]:
    found = dict(getattr(value, "__dict__", {}))
    return found | {name: getattr(value, name) for name in _slots(type(value)) if hasattr(value, name)}


class _Decoder:
    def __init__(self, model: object, modules: Collection[str]) -> None:
        self._model = model
        self._modules = modules
        self._made: list[Any] = []

    def value(self, node: Any, depth: int) -> Any:
        """Return the value of an encoded form."""
        if depth > _MAX_DEPTH:
            raise ValueError("too many levels")
        if not isinstance(node, list):
            if isinstance(node, dict | msgspec.msgpack.Ext):
                raise TypeError("unexpected type")
            return node
        tag, *rest = node
        if tag in _MUTABLE:
            return _MUTABLE[tag](self, *rest, depth=depth + 1)
        return _FIXED[tag](self, *rest, depth=depth + 1)

    def _keep(self, made: Any) -> Any:
        self._made.append(made)
        return made

    def _items(self, nodes: list[Any], depth: int) -> Iterator[Any]:
        return (self.value(node, depth) for node in nodes)

    # -- values that cannot change -------------------------------------------------------------------------------------

    def _self(self, depth: int) -> Any:  # noqa: ARG002
        return self._model

    def _same(self, place: int, depth: int) -> Any:  # noqa: ARG002
        if not 0 <= place < len(self._made):
            raise ValueError("unknown reference")
        return self._made[place]

    def _int(self, text: str, depth: int) -> int:  # noqa: ARG002
        return int(text, 16)

    def _scalar(self, dtype: str, data: bytes, depth: int) -> Any:  # noqa: ARG002
        return np.frombuffer(data, _dtype(dtype), 1)[0]

    def _tuple(self, nodes: list[Any], depth: int) -> tuple[Any, ...]:
        return tuple(self._items(nodes, depth))

    def _frozenset(self, nodes: list[Any], depth: int) -> frozenset[Any]:
        return frozenset(self._items(nodes, depth))

    def _named(self, module: str, name: str, nodes: list[Any], depth: int) -> Any:
        kind: Any = self._class(module, name, tuple)
        if len(nodes) != len(kind._fields):
            raise ValueError(f"{name} has other fields")
        return tuple.__new__(kind, self._items(nodes, depth))

    def _enum(self, module: str, name: str, member: str, depth: int) -> Any:  # noqa: ARG002
        return self._class(module, name, Enum).__members__[member]

    def _class(self, module: str, name: str, base: type) -> Any:
        kind = find_class(module, name, self._modules)
        if kind is None or not issubclass(kind, base) or not _is_plain(kind):
            raise SnapshotError(f"the state has an object of class {module}.{name}, which the model does not have")
        return kind

    # -- values that can change, which may be reachable by several ways -----------------------------------------------

    def _list(self, nodes: list[Any], depth: int) -> list[Any]:
        made: list[Any] = self._keep([])
        made.extend(self._items(nodes, depth))
        return made

    def _set(self, nodes: list[Any], depth: int) -> set[Any]:
        made: set[Any] = self._keep(set())
        made.update(self._items(nodes, depth))
        return made

    def _deque(self, most: int | None, nodes: list[Any], depth: int) -> deque[Any]:
        made: deque[Any] = self._keep(deque(maxlen=most))
        made.extend(self._items(nodes, depth))
        return made

    def _bytearray(self, data: bytes, depth: int) -> bytearray:  # noqa: ARG002
        made: bytearray = self._keep(bytearray(memoryview(data)))
        return made

    def _dict(self, pairs: list[Any], depth: int) -> dict[Any, Any]:
        made: dict[Any, Any] = self._keep({})
        for key, node in pairs:
            name = self.value(key, depth)
            made[name] = self.value(node, depth)
        return made

    def _array(self, dtype: str, shape: list[int], order: Any, data: bytes, depth: int) -> Any:  # noqa: ARG002
        kind = _dtype(dtype)
        if min(shape, default=0) < 0 or math.prod(shape) * kind.itemsize != len(data):
            raise ValueError("the size of an array is wrong")
        if not data:
            return self._keep(np.zeros(shape, kind))
        return self._keep(np.frombuffer(data, kind).reshape(shape, order=order).copy(order))

    def _generator(self, name: str, state: Any, depth: int) -> Any:
        if name not in _GENERATORS:
            raise ValueError(f"unknown generator {name}")
        made: Any = getattr(np.random, name)(0)
        made.state = _Decoder(None, ()).value(state, depth)
        return self._keep(np.random.Generator(made))

    def _random(self, state: Any, depth: int) -> random.Random:
        made: random.Random = self._keep(random.Random())  # noqa: S311  not for security
        made.setstate(self.value(state, depth))
        return made

    def _object(self, module: str, name: str, pairs: list[Any], depth: int) -> Any:
        kind = self._class(module, name, object)
        if issubclass(kind, Enum | tuple):
            raise TypeError(f"{name} is not a class whose objects have attributes")
        slots = frozenset(_slots(kind))
        made = self._keep(object.__new__(kind))
        for key, node in pairs:
            attribute = self.value(key, depth)
            if not isinstance(attribute, str):
                raise TypeError("the name of an attribute is not text")
            if attribute in slots:
                object.__setattr__(made, attribute, self.value(node, depth))
            else:
                made.__dict__[attribute] = self.value(node, depth)
        return made


_Method = Callable[..., Any]
_FIXED: Final[Mapping[str, _Method]] = {
    _SELF: _Decoder._self,
    "same": _Decoder._same,
    "int": _Decoder._int,
    "scalar": _Decoder._scalar,
    "tuple": _Decoder._tuple,
    "frozenset": _Decoder._frozenset,
    "named": _Decoder._named,
    "enum": _Decoder._enum,
}
_MUTABLE: Final[Mapping[str, _Method]] = {
    "list": _Decoder._list,
    "set": _Decoder._set,
    "deque": _Decoder._deque,
    "bytearray": _Decoder._bytearray,
    "dict": _Decoder._dict,
    "array": _Decoder._array,
    "generator": _Decoder._generator,
    "random": _Decoder._random,
    "object": _Decoder._object,
}


def _dtype(text: str) -> np.dtype[Any]:
    kind = np.dtype(text)
    if kind.kind not in _ARRAY_KINDS or kind.str != text or not kind.itemsize:
        raise ValueError(f"unknown type of numbers {text!r:.20}")
    return kind
