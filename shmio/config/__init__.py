"""Read, check and resolve ``supervisor.toml``."""

from __future__ import annotations

from shmio.config.address import Address, UnixAddress, parse_address
from shmio.config.model import (
    RESERVED_SOURCES,
    Alert,
    Config,
    Declaration,
    Emulator,
    Expectation,
    Grpc,
    Instance,
    Metrics,
    Mqtt,
    MqttAccount,
    MqttTls,
    MqttTopic,
    OpcUa,
    Recorder,
    Source,
    Sparkplug,
    Tls,
    Token,
    Trigger,
)

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from shmio.config.read import load

__all__ = [
    "RESERVED_SOURCES",
    "Address",
    "Alert",
    "Config",
    "Declaration",
    "Emulator",
    "Expectation",
    "Grpc",
    "Instance",
    "Metrics",
    "Mqtt",
    "MqttAccount",
    "MqttTls",
    "MqttTopic",
    "OpcUa",
    "Recorder",
    "Source",
    "Sparkplug",
    "Tls",
    "Token",
    "Trigger",
    "UnixAddress",
    "load",
    "parse_address",
]


def __getattr__(name: str) -> Any:
    """Import ``load`` at its first use: most processes of an instance read no configuration file."""
    if name == "load":
        from shmio.config.read import load  # noqa: PLC0415

        return load
    raise AttributeError(f"module 'shmio.config' has no attribute {name!r}")
