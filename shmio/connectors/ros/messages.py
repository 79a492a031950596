"""The message types that the connectors know, from the public definitions of ROS 2.

A type is ``package/Name``. The type of a field is a primitive, ``string`` or another message type;
``[]`` at its end makes it a sequence. Messages are dictionaries and lists, as in JSON.
"""

from __future__ import annotations

import base64
import math
import re
from collections.abc import Mapping
from functools import lru_cache
from types import MappingProxyType
from typing import Any, Final

FLOATS: Final = ("float32", "float64")
INTEGERS: Final[Mapping[str, tuple[int, int]]] = MappingProxyType(
    {f"int{bits}": (-(1 << bits - 1), (1 << bits - 1) - 1) for bits in (8, 16, 32, 64)}
    | {f"uint{bits}": (0, (1 << bits) - 1) for bits in (8, 16, 32, 64)}
)
"""The smallest and the largest value of each integer type."""
PRIMITIVES: Final = frozenset({"bool", "string", *FLOATS, *INTEGERS})
TYPE: Final = re.compile(r"([a-z][a-z0-9_]*)/(?:msg/)?([A-Z][A-Za-z0-9]*)")

_STAMPED: Final = {"header": "std_msgs/Header"}
_XYZ: Final = {"x": "float64", "y": "float64", "z": "float64"}
_POSE: Final = {"position": "geometry_msgs/Point", "orientation": "geometry_msgs/Quaternion"}
_TWIST: Final = {"linear": "geometry_msgs/Vector3", "angular": "geometry_msgs/Vector3"}
_WRENCH: Final = {"force": "geometry_msgs/Vector3", "torque": "geometry_msgs/Vector3"}

DEFINITIONS: Final[Mapping[str, Mapping[str, str]]] = MappingProxyType({
    "builtin_interfaces/Time": {"sec": "int32", "nanosec": "uint32"},
    "builtin_interfaces/Duration": {"sec": "int32", "nanosec": "uint32"},
    "std_msgs/Header": {"stamp": "builtin_interfaces/Time", "frame_id": "string"},
    "std_msgs/Bool": {"data": "bool"},
    "std_msgs/String": {"data": "string"},
    **{f"std_msgs/{name.capitalize()}": {"data": name} for name in (*FLOATS, "int8", "int16", "int32", "int64")},
    **{f"std_msgs/UInt{bits}": {"data": f"uint{bits}"} for bits in (8, 16, 32, 64)},
    "std_msgs/MultiArrayDimension": {"label": "string", "size": "uint32", "stride": "uint32"},
    "std_msgs/MultiArrayLayout": {"dim": "std_msgs/MultiArrayDimension[]", "data_offset": "uint32"},
    **{
        f"std_msgs/{name.capitalize()}MultiArray": {"layout": "std_msgs/MultiArrayLayout", "data": f"{name}[]"}
        for name in (*FLOATS, "int8", "int16", "int32", "int64")
    },
    **{
        f"std_msgs/UInt{bits}MultiArray": {"layout": "std_msgs/MultiArrayLayout", "data": f"uint{bits}[]"}
        for bits in (8, 16, 32, 64)
    },
    "geometry_msgs/Vector3": _XYZ,
    "geometry_msgs/Point": _XYZ,
    "geometry_msgs/Quaternion": {**_XYZ, "w": "float64"},
    "geometry_msgs/Pose": _POSE,
    "geometry_msgs/PoseStamped": {**_STAMPED, "pose": "geometry_msgs/Pose"},
    "geometry_msgs/Twist": _TWIST,
    "geometry_msgs/TwistStamped": {**_STAMPED, "twist": "geometry_msgs/Twist"},
    "geometry_msgs/Wrench": _WRENCH,
    "geometry_msgs/WrenchStamped": {**_STAMPED, "wrench": "geometry_msgs/Wrench"},
    "sensor_msgs/JointState": {
        **_STAMPED, "name": "string[]", "position": "float64[]", "velocity": "float64[]", "effort": "float64[]",
    },
    "trajectory_msgs/JointTrajectoryPoint": {
        "positions": "float64[]", "velocities": "float64[]", "accelerations": "float64[]", "effort": "float64[]",
        "time_from_start": "builtin_interfaces/Duration",
    },
    "trajectory_msgs/JointTrajectory": {
        **_STAMPED, "joint_names": "string[]", "points": "trajectory_msgs/JointTrajectoryPoint[]",
    },
})  # fmt: skip


def plain(name: str) -> str:
    """Convert a type to ``package/Name``; the argument may also have the form ``package/msg/Name``."""
    return name.replace("/msg/", "/")


def default(kind: str) -> Any:
    """Return the default value of a field: zero, empty, or a message of default values."""
    if kind.endswith("[]"):
        return []
    if kind in PRIMITIVES:
        return "" if kind == "string" else False if kind == "bool" else 0.0 if kind in FLOATS else 0
    return {name: default(inner) for name, inner in DEFINITIONS[kind].items()}


def from_json(message: Any, kind: str) -> Any:
    """Return a JSON message of a known type, with lists of numbers instead of base64 for sequences of uint8."""
    if not _has_bytes(kind):
        return message
    if kind == "uint8[]" and isinstance(message, str):
        try:
            return list(base64.b64decode(message, validate=True))
        except ValueError:
            return message
    if kind in DEFINITIONS and isinstance(message, dict):
        return {name: from_json(one, DEFINITIONS[kind].get(name, "")) for name, one in message.items()}
    if kind.removesuffix("[]") in DEFINITIONS and isinstance(message, list):
        return [from_json(one, kind.removesuffix("[]")) for one in message]
    return message


@lru_cache(maxsize=256)
def _has_bytes(kind: str) -> bool:
    """Return whether a type has a sequence of uint8 at any depth. Most have none, so their messages need no copy."""
    fields = DEFINITIONS.get(kind.removesuffix("[]"), {})
    return kind == "uint8[]" or any(map(_has_bytes, fields.values()))


def conforms(message: Any, kind: str) -> bool:
    """Return whether a value has all fields of a known type, each with the right type."""
    if kind.endswith("[]"):
        return isinstance(message, list) and all(conforms(one, kind[:-2]) for one in message)
    if kind in ("bool", "string"):
        return type(message) is (bool if kind == "bool" else str)
    if kind in FLOATS:
        return type(message) in (int, float)
    if kind in INTEGERS:
        return type(message) is int and INTEGERS[kind][0] <= message <= INTEGERS[kind][1]
    if not isinstance(message, dict):
        return False
    return all(name in message and conforms(message[name], inner) for name, inner in DEFINITIONS[kind].items())


def finite(message: Any) -> bool:
    """Return whether all numbers in a message are finite: neither NaN nor infinite."""
    if isinstance(message, dict):
        return all(map(finite, message.values()))
    if isinstance(message, list):
        return all(map(finite, message))
    return not isinstance(message, float) or math.isfinite(message)
