"""Read, check and resolve ``supervisor.toml``."""

from shmio.config.address import Address, UnixAddress, parse_address
from shmio.config.model import (
    Config,
    Declaration,
    Emulator,
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
from shmio.config.read import RESERVED_SOURCES, load

__all__ = [
    "RESERVED_SOURCES",
    "Address",
    "Config",
    "Declaration",
    "Emulator",
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
