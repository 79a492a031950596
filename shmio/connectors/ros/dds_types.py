"""Converts messages to samples of DDS and back. DDS types have the names that ROS 2 gives them."""

from __future__ import annotations

import dataclasses
import types
from functools import lru_cache
from typing import Any, Final

from cyclonedds.idl import IdlStruct
from cyclonedds.idl import types as idl

from shmio.connectors.ros import cdr
from shmio.connectors.ros.messages import DEFINITIONS

_PRIMITIVES: Final[dict[str, Any]] = {
    "bool": bool, "string": str, "float32": idl.float32, "float64": idl.float64,
    **{f"{sign}int{bits}": getattr(idl, f"{sign}int{bits}") for sign in ("", "u") for bits in (8, 16, 32, 64)},
}  # fmt: skip


def dds_topic(topic: str) -> str:
    """Return the DDS name of a ROS topic."""
    return f"rt{topic}"


def ros_topic(name: str) -> str:
    """Return the ROS topic with a DDS name; "" if the name is that of a service or of a topic of another program."""
    return name.removeprefix("rt") if name.startswith("rt/") else ""


def dds_type(kind: str) -> str:
    """Return the DDS name of a type ``package/Name``."""
    package, _, name = kind.partition("/")
    return f"{package}::msg::dds_::{name}_"


def ros_type(name: str) -> str:
    """Convert the DDS name of a type to ``package/Name``; return a name that ROS does not use unchanged."""
    package, middle, last = name.partition("::msg::dds_::")
    return f"{package}/{last.removesuffix('_')}" if middle else name


class Received:
    """A sample that a reader returns: its message, as dictionaries and lists."""

    def __init__(self, message: Any) -> None:
        self.message = message
        self.sample_info: Any = None
        """Set by the library."""


@lru_cache(maxsize=256)
def sample_type(kind: str) -> Any:
    """Return the class whose instances are samples of a type. Readers of such a type return :class:`Received`."""
    annotations = {name: _annotation(inner) for name, inner in DEFINITIONS[kind].items()}

    def deserialize(data: bytes) -> Received:
        message = cdr.decode(data, kind)
        return Received(to_message(made.__idl__.deserialize(data), kind) if message is None else message)

    def fill(namespace: dict[str, Any]) -> None:
        namespace |= {
            "__annotations__": annotations, "__module__": __name__, "deserialize": staticmethod(deserialize)
        }  # fmt: skip

    name = f"{kind.partition('/')[2]}_"
    made: Any = dataclasses.dataclass(types.new_class(name, (IdlStruct,), {"typename": dds_type(kind)}, fill))
    return made


def _annotation(kind: str) -> Any:
    if kind.endswith("[]"):
        return idl.sequence[_annotation(kind[:-2])]
    return _PRIMITIVES[kind] if kind in _PRIMITIVES else sample_type(kind)


def to_message(sample: Any, kind: str) -> Any:
    """Convert a sample, or the value of one of its fields, to dictionaries and lists."""
    if kind.endswith("[]"):
        inner = kind[:-2]
        return list(sample) if inner in _PRIMITIVES else [to_message(one, inner) for one in sample]
    if kind in _PRIMITIVES:
        return sample
    return {name: to_message(getattr(sample, name), inner) for name, inner in DEFINITIONS[kind].items()}


def to_sample(message: Any, kind: str) -> Any:
    """Convert a message to a sample. The message must conform to its type."""
    if kind.endswith("[]"):
        return [to_sample(one, kind[:-2]) for one in message]
    if kind in _PRIMITIVES:
        return message
    return sample_type(kind)(**{name: to_sample(message[name], inner) for name, inner in DEFINITIONS[kind].items()})
