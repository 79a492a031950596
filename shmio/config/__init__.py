"""Read, check and resolve ``supervisor.toml``."""

from __future__ import annotations

import importlib

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from shmio.config.address import Address, UnixAddress, parse_address
    from shmio.config.model import (
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
    from shmio.config.read import load
    from shmio.config.reserved import RESERVED_SOURCES

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


_MODULES = {"load": "read", "RESERVED_SOURCES": "reserved"} | dict.fromkeys(
    ("Address", "UnixAddress", "parse_address"), "address"
)
"""The module that defines each name; all others are in ``model``."""


def __getattr__(name: str) -> Any:
    """Import a name at its first use: programs that attach need no types of the configuration."""
    if name not in __all__:
        raise AttributeError(f"module 'shmio.config' has no attribute {name!r}")
    return getattr(importlib.import_module(f"shmio.config.{_MODULES.get(name, 'model')}"), name)
