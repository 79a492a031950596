"""Finds connectors by name: built-in ones, and entry points of the group ``shmio.connectors``.

Most connectors read a device. Others compute their values or play a recording, and follow the
instance clock; one reproduces a source of another instance.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec

from shmio.config.faults import explain
from shmio.connectors.base import Computed, Connector, Mirrored, Replayed
from shmio.errors import ConfigError
from shmio.wording import brief, did_you_mean, unknown

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint, EntryPoints

GROUP = "shmio.connectors"

BUILT_IN = {
    "fabric": "shmio.connectors.fabric.source:Mirror",
    "memory": "shmio.connectors.models.memory:Memory",
    "modbus": "shmio.connectors.modbus.connector:ModbusConnector",
    "mqtt": "shmio.connectors.mqtt.connector:MqttConnector",
    "opcua": "shmio.connectors.opcua.connector:OpcUaConnector",
    "remote": "shmio.connectors.models.remote:Remote",
    "ros2": "shmio.connectors.ros.dds:Ros2Connector",
    "rosbridge": "shmio.connectors.ros.rosbridge:RosbridgeConnector",
    "replay": "shmio.connectors.replay.source:Replay",
    "simulation": "shmio.connectors.models.simulation:Simulation",
    "s7": "shmio.connectors.s7.connector:S7Connector",
}

BROWSED = {
    "opc.tcp://HOST:PORT": "opcua",
    "mqtt://HOST:PORT": "mqtt",
    "mqtts://HOST:PORT": "mqtt",
    "ws://HOST:PORT": "rosbridge",
    "ros2://DOMAIN": "ros2",
}
"""The connectors that can browse a device, by the form of the device's URL."""


_SEPARATE = {"mtconnect": "is a separate package; in a clone of shmio, run pip install ./examples/mtconnect"}
"""How to install the connectors that are in packages of their own, by name."""


def names() -> list[str]:
    """Return all valid values of ``connector = "…"``, sorted."""
    return sorted({*BUILT_IN, *(point.name for point in _offered())})


def _offered() -> EntryPoints:
    return _found(tuple(sys.path), tuple(map(_changed_ns, sys.path)))


def _changed_ns(folder: str) -> int:
    """Return when a package was last installed in a folder or removed from it; 0 if there is no such folder."""
    try:
        return Path(folder).stat().st_mtime_ns
    except OSError:
        return 0


@lru_cache(maxsize=1)
def _found(_folders: tuple[str, ...], _changed_ns: tuple[int, ...]) -> EntryPoints:
    """Return the entry points in the folders of ``sys.path``; to look for them takes 20 ms."""
    from importlib.metadata import entry_points  # noqa: PLC0415  built-in connectors do not need it

    return entry_points(group=GROUP)


def clash(name: str) -> str:
    """Return a message if several connectors have this name; else "".

    A package may offer a connector with the name of another package's connector, or of a built-in
    one.
    """
    packages = sorted({_package(point) for point in _offered() if point.name == name})
    if name in BUILT_IN and packages:
        return (
            f"{name!r} is a connector of shmio, and {' and '.join(packages)} {'offer' if packages[1:] else 'offers'} "
            f"another one with this name; rename the entry point, or pip uninstall {' '.join(packages)}"
        )
    if len(packages) > 1:
        return (
            f"{' and '.join(packages)} each offer a connector {name!r}; pip uninstall all but the one that you want, "
            "or rename an entry point"
        )
    return ""


def _package(point: EntryPoint) -> str:
    return point.dist.name if point.dist is not None else f"the package of {point.value}"


_MEANT: Final = {
    "simatic": "s7", "siemens": "s7", "step7": "s7", "tia": "s7", "profinet": "s7", "plc": "s7", "snap7": "s7",
    "opc": "opcua", "ua": "opcua", "ros": "ros2", "dds": "ros2", "sparkplug": "mqtt", "fmu": "simulation",
    "model": "simulation", "nats": "fabric", "mirror": "fabric",
}  # fmt: skip
"""What a name that begins so means: names of products and protocols that people write."""


def _unknown(name: str) -> str:
    """Return the message about a connector that does not exist, with the one that is meant, if that is clear."""
    found = meant_by(name)
    return f"unknown connector {brief(name)}; {did_you_mean([found])}" if found else unknown("connector", name, names())


def meant_by(name: str) -> str:
    """Return the connector that is probably meant by a name; "" if that is not clear."""
    known = names()
    if name in known:
        return name
    folded = "".join(char for char in name.lower() if char.isalnum())
    meant = {one: one for one in known} | _MEANT
    return next((meant[begin] for begin in sorted(meant, key=len, reverse=True) if folded.startswith(begin)), "")


def load(name: str) -> type[Connector] | type[Computed] | type[Replayed] | type[Mirrored]:
    """Import a connector by name.

    Raises:
        ConfigError: There is no such connector, several packages offer it, it cannot be imported,
            or it is not a connector class.

    """
    if name in BUILT_IN:
        module, _, attribute = BUILT_IN[name].partition(":")
        found: Any = getattr(importlib.import_module(module), attribute)
    else:
        points = [point for point in _offered() if point.name == name]
        if not points:
            remedy = _SEPARATE.get(name)
            raise ConfigError(f"connector {name!r} {remedy}" if remedy else _unknown(name))
        if len(points) > 1:
            raise ConfigError(clash(name) or f"the package {_package(points[0])} offers the connector {name!r} twice")
        try:
            found = points[0].load()
        except Exception as error:
            raise ConfigError(f"connector {name!r} ({points[0].value}) cannot be imported: {error}") from error
    if not (isinstance(found, type) and issubclass(found, Connector | Computed | Replayed | Mirrored)):
        raise ConfigError(f"connector {name!r} is not a subclass of shmio.connectors.base.Connector")
    return found


def options_type(name: str) -> type[msgspec.Struct]:
    """Return the struct type for the connector's own keys of ``[[source]]``."""
    return load(name).Options


def convert_options(name: str, options: dict[str, Any], texts: Mapping[str, str] | None = None) -> msgspec.Struct:
    """Check the connector's own keys of a source, and convert them to its options struct.

    Args:
        name: The connector's name.
        options: The keys and values from the TOML file.
        texts: Keys and values from a properties file; the values are text and are converted.

    Raises:
        ConfigError: A key is invalid. The message begins with the key, and names no file or line.

    """
    for fault in option_faults(name, options, texts or {}):
        raise ConfigError(fault)
    kind = options_type(name)
    given = _read(kind, texts or {}) | options
    try:
        return msgspec.convert(given, kind)
    except msgspec.ValidationError as error:
        raise ConfigError(explain(error, "", kind, given)) from None


def option_faults(name: str, options: Mapping[str, Any], texts: Mapping[str, str]) -> Iterator[str]:
    """Yield a message for every invalid or missing key; each message begins with the key."""
    kind = options_type(name)
    read: dict[str, Any] = {}
    for field in msgspec.structs.fields(kind):
        key = field.encode_name
        try:
            if key in options:
                msgspec.convert(options[key], field.type)
            elif key in texts:
                read[key] = _convert_text(key, texts[key], field.type)
            elif field.required:
                yield f"{key}: this key is needed"
        except msgspec.ValidationError as error:
            yield explain(error, key, field.type, options.get(key))
        except ConfigError as error:
            yield str(error)


def _read(kind: type[msgspec.Struct], texts: Mapping[str, str]) -> dict[str, Any]:
    types = {field.encode_name: field.type for field in msgspec.structs.fields(kind)}
    return {key: _convert_text(key, text, types.get(key, Any)) for key, text in texts.items()}


def _convert_text(key: str, text: str, kind: Any) -> Any:
    try:
        return msgspec.convert(text, kind, strict=False)
    except msgspec.ValidationError as error:
        raise ConfigError(explain(error, key, kind, text)) from None
