"""From the file to a checked :class:`Config`; every message names the file, the full key and the remedy."""

from __future__ import annotations

import difflib
import re
import tomllib
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from shmio.config.declaration import check_declarations
from shmio.config.listening import check_listening, resolve
from shmio.config.model import (
    Client,
    Config,
    Declaration,
    Emulator,
    Grpc,
    Instance,
    Listening,
    Recorder,
    Replay,
    Source,
    Tls,
    Token,
    Trigger,
)
from shmio.config.mqtt import check_mqtt, resolve_mqtt
from shmio.config.mqttmodel import Mqtt, MqttAccount, MqttTls, MqttTopic, Sparkplug
from shmio.config.properties import read_properties
from shmio.config.section import Section
from shmio.config.wording import explain, explain_toml, named
from shmio.errors import ConfigError

RESERVED_SOURCES = frozenset({"simlog", "model", "shmio"})
SECTION_PROCESSES = frozenset({"broker", "grpc", "mqtt", "recorder", "supervisor", "web"})
MAX_FILE_BYTES = 1 << 20

_TABLES: dict[str, type[Section]] = {
    "instance": Instance,
    "source": Source,
    "emulator": Emulator,
    "injection": Declaration,
    "grpc": Grpc,
    "grpc.tls": Tls,
    "grpc.token": Token,
    "grpc.client": Client,
    "grpc.address": Listening,
    "mqtt": Mqtt,
    "mqtt.account": MqttAccount,
    "mqtt.tls": MqttTls,
    "mqtt.topic": MqttTopic,
    "mqtt.sparkplug": Sparkplug,
    "recorder": Recorder,
    "recorder.trigger": Trigger,
    "replay": Replay,
}
_OF_GRPC = ("token", "client", "address")
_DERIVED = ("folder", "options", "texts")  # fields that are no keys of the file
_Table = TypeVar("_Table", bound=Section)


def load(file: Path) -> Config:
    """Read, check and resolve a ``supervisor.toml``.

    Raises ConfigError: no such file, not TOML, unknown key, wrong type, a rule of the contract broken.
    """
    tables = read_tables(file)
    try:
        return _resolve(tables, file.resolve().parent)
    except ConfigError as error:
        raise ConfigError(f"{file}: {named(str(error), tables)}") from None


def read_tables(file: Path) -> dict[str, Any]:
    """The file's TOML, unchecked; ConfigError."""
    try:
        with file.open("rb") as stream:
            data = stream.read(MAX_FILE_BYTES + 1)
    except FileNotFoundError as error:
        raise ConfigError(f"{file}: {error.strerror}; write one with shmio-supervisor init") from None
    except IsADirectoryError as error:
        raise ConfigError(f"{file}: {error.strerror}; name the file, such as {file / 'supervisor.toml'}") from None
    except OSError as error:
        raise ConfigError(f"{file}: {error.strerror}") from None
    if len(data) > MAX_FILE_BYTES:
        raise ConfigError(f"{file}: larger than {MAX_FILE_BYTES} bytes")
    try:
        text = data.decode("utf-8")
        return tomllib.loads(text)
    except UnicodeDecodeError as error:
        raise ConfigError(f"{file}: not UTF-8 at byte {error.start}") from None
    except (ValueError, RecursionError) as error:  # a TOMLDecodeError, or a number that int() does not take
        raise ConfigError(f"{file}: not TOML: {explain_toml(error, text)}") from None


def _resolve(tables: dict[str, Any], folder: Path) -> Config:
    if "folder" in tables:
        raise ConfigError(_unknown("folder", ""))
    inner = [("grpc", name) for name in _OF_GRPC] + [("mqtt", "account"), ("mqtt", "topic")]
    for name, table in [
        ("source", tables),
        ("emulator", tables),
        ("injection", tables),
        *((f"{section}.{name}", tables.get(section)) for section, name in inner),
    ]:
        if isinstance(table, dict) and isinstance(table.get(name.rpartition(".")[2]), dict):
            raise ConfigError(f"{name}: write [[{name}]], in two brackets: there can be several")
    check_text(tables, "")
    sources = tables.get("source", [])
    if isinstance(sources, list):
        tables = {**tables, "source": [_with_options(source, i, folder) for i, source in enumerate(sources)]}
    config = convert({**tables, "folder": str(folder)}, Config)
    _check_names(config)
    _check_times(config)
    _check_rotation(config)
    check_declarations(config.injection)
    check_listening(config)
    check_mqtt(config)
    if config.grpc:
        resolve(config.grpc, config)
    if config.mqtt:
        resolve_mqtt(config.mqtt, config)
    return config


def _with_options(source: Any, index: int, folder: Path) -> Any:
    """Move the connector's own keys to ``options`` and ``texts``; inline keys win."""
    if not isinstance(source, dict):
        return source
    common = set(Source.__struct_fields__) - set(_DERIVED)
    inline = {key: value for key, value in source.items() if key not in common}
    properties = source.get("properties")
    read = read_properties(folder / properties, f"source[{index}]") if isinstance(properties, str) else {}
    texts = {key: text for key, text in read.items() if key not in inline}
    return {key: source[key] for key in source if key in common} | {"options": inline, "texts": texts}


def convert(tables: dict[str, Any], kind: type[_Table]) -> _Table:
    """The tables as this type; ConfigError names what is unknown or of a wrong type by its full key."""
    try:
        return msgspec.convert(tables, kind)
    except msgspec.ValidationError as error:
        text, _, at = str(error).partition(" - at `$")
        path = at.rstrip("`").lstrip(".")
        unknown = re.search(r"unknown field `([^`]*)`", text)
        if unknown is None:
            raise ConfigError(explain(error)) from None
        raise ConfigError(_unknown(f"{path}.{unknown[1]}" if path else unknown[1], path, kind)) from None


def _unknown(key: str, table: str, whole: type[Section] = Config) -> str:
    known = whole if not table else _TABLES.get(re.sub(r"\[[^]]*\]", "", table))
    names = [name for name in known.__struct_fields__ if name not in _DERIVED] if known else []
    hint = _hint(key.rpartition(".")[2], names, f"known here: {', '.join(names)}")
    return f"{key}: unknown key; {hint}"


def unknown_option(index: int, key: str, known: list[str]) -> str:
    """Message for a key of ``source[index]`` that neither the contract nor the connector knows."""
    names = [*known, *(name for name in Source.__struct_fields__ if name not in _DERIVED)]
    hint = _hint(key, names, f"the connector knows: {', '.join(known)}")
    return f"source[{index}].{key}: unknown key; {hint}"


def _hint(key: str, names: list[str], otherwise: str) -> str:
    near = difflib.get_close_matches(key, names, 1)
    return f"did you mean {near[0]}?" if near else otherwise


def check_text(value: Any, key: str) -> None:
    """No control characters: no file name or terminal takes them. (Not a pattern: msgspec 0.22 crashes at exit.)."""
    if isinstance(value, str) and any(char < " " or char == "\x7f" for char in value):
        raise ConfigError(f"{key}: must not hold control characters")
    if isinstance(value, dict):
        for name, item in value.items():
            check_text(item, f"{key}.{name}".lstrip("."))
    elif isinstance(value, list):
        for index, item in enumerate(value):
            check_text(item, f"{key}[{index}]")


def _check_names(config: Config) -> None:
    seen: dict[str, str] = {}
    for table in ("source", "emulator"):
        for index, section in enumerate(getattr(config, table)):
            key = f"{table}[{index}].name"
            folded = section.name.lower()
            if folded in RESERVED_SOURCES:
                raise ConfigError(f"{key}: {section.name!r} is reserved")
            if folded in SECTION_PROCESSES:
                raise ConfigError(f"{key}: {section.name!r} is the name of a process of ours")
            if folded in seen:
                raise ConfigError(
                    f"{key}: {section.name!r} is already the name of {seen[folded]} (case does not count)"
                )
            seen[folded] = f"{table}[{index}]"
    names = [source.name for source in config.source]
    for name in config.recorder.sources if config.recorder else ():
        if name not in names:
            raise ConfigError(f"recorder.sources: no source {name!r}; there are: {', '.join(names)}")
    if config.grpc and config.grpc.default_source is not None and config.grpc.default_source not in names:
        raise ConfigError(
            f"grpc.default_source: no source {config.grpc.default_source!r}; there are: {', '.join(names)}"
        )


def _check_times(config: Config) -> None:
    for index, source in enumerate(config.source):
        if source.stale_ms is not None and source.stale_ms < 2 * source.period_ms:
            raise ConfigError(
                f"source[{index}].stale_ms: {source.stale_ms:g} is less than two periods of {source.period_ms:g} ms: "
                "one late frame would make the source bad"
            )


def _check_rotation(config: Config) -> None:
    for key, least in (("rotate_min", 0.1), ("rotate_mb", 1)) if config.recorder else ():
        value: float = getattr(config.recorder, key)
        if 0 < value < least:
            raise ConfigError(
                f"recorder.{key}: {value:g} is less than {least:g}, which would make files without number; 0: never"
            )
