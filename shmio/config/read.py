"""Reads ``supervisor.toml`` into a checked :class:`Config`. Messages name the file, the key and the remedy."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

import msgspec

from shmio.config.alert import alert_faults, resolve_alert
from shmio.config.declaration import declaration_faults
from shmio.config.fabric import check_fabric, resolve_fabric
from shmio.config.faults import MAX_KEY, MAX_PARTS, Faults, but_found, decode, explain, explain_toml, too_long
from shmio.config.listening import check_listening, resolve
from shmio.config.model import (
    Alert,
    Client,
    Config,
    Declaration,
    Emulator,
    Expectation,
    Fabric,
    FabricAllow,
    FabricHistory,
    FabricRule,
    Grpc,
    Instance,
    Listening,
    Metrics,
    Mqtt,
    MqttAccount,
    MqttTls,
    MqttTopic,
    OpcUa,
    Recorder,
    Replay,
    Section,
    Source,
    Sparkplug,
    Tls,
    Token,
    Trigger,
    Web,
)
from shmio.config.mqtt import check_mqtt, resolve_mqtt
from shmio.config.opcua import check_opcua, resolve_opcua
from shmio.config.reserved import RESERVED_SOURCES
from shmio.config.web import check_web, resolve_web
from shmio.errors import ConfigError
from shmio.wording import already_named, did_you_mean, larger_than, listed, near, unknown

SECTION_PROCESSES = frozenset(
    {"alerts", "broker", "fabric", "grpc", "metrics", "mqtt", "nats", "opcua", "recorder", "supervisor", "web"}
)
MAX_FILE_BYTES = 1 << 20
MAX_PROPERTIES_BYTES = 64 << 10
MAX_DEPTH = 64
MAX_SECTIONS = 1_000
"""Maximum number of sections of the same name to check."""
MAX_SOURCES = 200
"""Maximum number of sources of an instance."""

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
    "opcua": OpcUa,
    "opcua.account": Token,
    "opcua.client": Client,
    "fabric": Fabric,
    "fabric.tls": MqttTls,
    "fabric.rule": FabricRule,
    "fabric.allow": FabricAllow,
    "fabric.history": FabricHistory,
    "metrics": Metrics,
    "web": Web,
    "recorder": Recorder,
    "recorder.trigger": Trigger,
    "replay": Replay,
    "alert": Alert,
}
_CAMPAIGN_TABLES: Final[Mapping[str, type[Section]]] = {"expect": Expectation}
_SEVERAL = {
    "source",
    "emulator",
    "injection",
    "alert",
    "grpc.token",
    "grpc.client",
    "grpc.address",
    "mqtt.account",
    "mqtt.topic",
    "opcua.account",
    "opcua.client",
    "fabric.rule",
    "fabric.allow",
}
_SLIPPED = re.compile(r"[A-Za-z]:[\x00-\x1f\\]")  # a Windows path in double quotes, \t being a tab
DERIVED: Final[Mapping[type[Section], tuple[str, ...]]] = {Config: ("folder",), Source: ("options", "texts")}
"""For each type of section, the fields that are not keys of the file."""
_Table = TypeVar("_Table", bound=Section)


REMEDY: Final = "; create it with shmio-supervisor init"
"""Text that the message about a missing ``supervisor.toml`` ends with."""


def load(file: Path, text: str | None = None) -> Config:
    """Read and check a ``supervisor.toml``, and make its paths absolute.

    Args:
        file: The file.
        text: Its text; None: read it.

    Raises:
        ConfigError: The file cannot be read or is not TOML, it has unknown keys or values of a
            wrong type, or it breaks other rules. The message has a line for each fault.

    """
    found = examine(file, text)
    found.faults.raise_any()
    return found.config


class Examined(NamedTuple):
    """A configuration, from which faulty sections are left out, and its faults."""

    config: Config
    faults: Faults
    broken: dict[int, tuple[str, dict[str, Any], dict[str, str]]]
    """For each faulty source, by index: connector, its keys in the section, and its keys in the properties file."""
    names: list[str] | None
    """The names of all sources of the file, also of faulty ones; None if one of them has none or a wrong one."""


def examine(file: Path, text: str | None = None) -> Examined:
    """Read a ``supervisor.toml``, and collect its faults.

    Args:
        file: The file.
        text: Its text; None: read it.

    Raises:
        ConfigError: The file cannot be read or is not TOML.

    """
    if text is None:
        text = read_text(file, REMEDY)
    tables = parse(file, text)
    return _examine(tables, file.resolve().parent, Faults(file, tables, text))


@contextmanager
def located(file: Path) -> Iterator[None]:
    """Within a ``with`` block, add the file and the line of the key to the message of a fault.

    Raises:
        ConfigError: There was a fault, whose message began with its key.

    """
    try:
        yield
    except ConfigError as error:
        text = read_text(file)
        raise ConfigError(Faults(file, parse(file, text), text).located(str(error))) from None


def read_tables(file: Path) -> dict[str, Any]:
    """Parse a TOML file without checking its keys.

    Raises:
        ConfigError: The file cannot be read or is not TOML.

    """
    return parse(file, read_text(file))


def read_text(file: Path, remedy: str = "") -> str:
    """Return the text of a TOML file.

    Args:
        file: The file.
        remedy: Text to append to the message if the file does not exist.

    Raises:
        ConfigError: The file cannot be read, is too large, or is not UTF-8.

    """
    try:
        with file.open("rb") as stream:
            data = stream.read(MAX_FILE_BYTES + 1)
    except FileNotFoundError as error:
        raise ConfigError(f"{file}: {error.strerror}{remedy}") from None
    except IsADirectoryError as error:
        raise ConfigError(f"{file}: {error.strerror}; name the file, such as {file / 'supervisor.toml'}") from None
    except OSError as error:
        raise ConfigError(f"{file}: {error.strerror}") from None
    if len(data) > MAX_FILE_BYTES:
        raise ConfigError(f"{file}: {larger_than(MAX_FILE_BYTES)}")
    return decode(data, str(file))


def parse(file: Path, text: str) -> dict[str, Any]:
    """Parse TOML text.

    Raises:
        ConfigError: The text is not TOML, a key is too long, or tables are nested too deeply.

    """
    if line := too_long(text):
        raise ConfigError(f"{file}:{line}: a key is longer than {MAX_KEY} characters or {MAX_PARTS} parts")
    try:
        tables = tomllib.loads(text)
    except ValueError as error:  # TOMLDecodeError, or a number too long for int()
        raise ConfigError(f"{file}: the file is not valid TOML: {explain_toml(error, text)}") from None
    except RecursionError:
        tables = None
    if tables is None or _depth(tables) > MAX_DEPTH:
        raise ConfigError(f"{file}: tables and lists are nested more than {MAX_DEPTH} deep")
    return tables


def _depth(value: Any) -> int:
    """Return how deeply tables and lists are nested; at most ``MAX_DEPTH + 1``.

    The function is not recursive, because the depth of a file is unlimited.
    """
    depth, level = 0, [value]
    while level and depth <= MAX_DEPTH:
        depth += 1
        inner: list[Any] = []
        for item in level:
            inner += (
                one for one in (item.values() if isinstance(item, dict) else item) if isinstance(one, dict | list)
            )
        level = inner
    return depth


def read_properties(file: Path, key: str) -> dict[str, tuple[str, int]]:
    """Return the text and the line number of each key in a properties file, such as ``plc.ini``.

    The file has lines ``key=value``. Blank lines, ``[section]`` lines and lines that begin with
    ``#``, ``;`` or ``!`` are skipped. ``key`` is the configuration key that names the file, for
    messages.

    Raises:
        ConfigError: The file cannot be read, is too large or not UTF-8, or has an invalid line or a
            duplicate key.

    """
    place = f"{key}.properties: {file}"
    try:
        with file.open("rb") as stream:
            data = stream.read(MAX_PROPERTIES_BYTES + 1)
    except OSError as error:
        raise ConfigError(f"{place}: {error.strerror}") from None
    if len(data) > MAX_PROPERTIES_BYTES:
        raise ConfigError(f"{place}: {larger_than(MAX_PROPERTIES_BYTES)}")
    values: dict[str, tuple[str, int]] = {}
    for number, line in enumerate(decode(data, place).splitlines(), 1):
        stripped = line.strip()
        if not stripped or stripped[0] in "#;!" or (stripped[0] == "[" and stripped[-1] == "]"):
            continue
        name, equals, value = stripped.partition("=")
        name = name.strip()
        if not equals or not name:
            raise ConfigError(f"{place}:{number}: expected key=value")
        if name in values:
            raise ConfigError(f"{place}:{number}: {name} is given twice; remove one of the lines")
        values[name] = value.strip(), number
    return values


def _examine(tables: dict[str, Any], folder: Path, faults: Faults) -> Examined:
    broken: dict[int, tuple[str, dict[str, Any], dict[str, str]]] = {}
    sources = tables.get("source", [])
    if isinstance(sources, list):
        tables = {**tables, "source": sources[:MAX_SOURCES]}
        if len(sources) > MAX_SOURCES:
            faults.add(
                f"source: there are {len(sources)} sources, but an instance has at most {MAX_SOURCES} processes; "
                f"only the first {MAX_SOURCES} sources are checked"
            )
    sound, places = _ConfigStructure(faults, folder, broken).sections(tables)
    faults.places = places
    config = convert({**sound, "folder": str(folder)}, Config)
    for source in config.source:
        if source.tags is not None:
            source.layout, source.tags = [*_files(source.layout), *_files(source.tags)], None
    misnamed = [*_name_faults(config)]
    for fault in misnamed:
        faults.add(fault)
    names = _names(tables.get("source", [])) if not misnamed else None
    for fault in _reference_faults(config, names) if names is not None else ():
        faults.add(fault)
    for fault in (*_time_faults(config), *_rotation_faults(config), *declaration_faults(config.injection)):
        faults.add(fault)
    for fault in alert_faults(config):
        faults.add(fault)
    check_listening(config, faults.catching)
    with faults.catching():
        check_mqtt(config)
    with faults.catching():
        check_opcua(config)
    with faults.catching():
        check_fabric(config)
    with faults.catching():
        check_web(config)
    if config.grpc:
        with faults.catching():
            resolve(config.grpc, config)
    if config.mqtt:
        resolve_mqtt(config.mqtt, config)
    if config.opcua:
        resolve_opcua(config.opcua, config)
    if config.fabric:
        resolve_fabric(config.fabric, config)
    resolve_web(config)
    for alert in config.alert:
        resolve_alert(alert, config)
    return Examined(config, faults, broken, names)


def _names(sources: Any) -> list[str] | None:
    """Return the names of all sources; None if one of them has none, so that a reference may be to that source."""
    names = [one.get("name") if isinstance(one, dict) else None for one in sources] if isinstance(sources, list) else []
    found = [name for name in names if isinstance(name, str)]
    return found if len(found) == len(names) and isinstance(sources, list) else None


def _files(names: str | list[str] | None) -> list[str]:
    return [names] if isinstance(names, str) else names or []


@cache
def _fields(kind: type[Section]) -> tuple[msgspec.structs.FieldInfo, ...]:
    """Return the keys of a section."""
    return tuple(field for field in msgspec.structs.fields(kind) if field.name not in DERIVED.get(kind, ()))


class Structure:
    """Checks the keys of a file: that each is known, present where needed, and of the right type."""

    def __init__(
        self, faults: Faults, whole: type[Section], kinds: Mapping[str, type[Section]], several: Collection[str]
    ) -> None:
        """Describe the tables of one kind of file.

        Args:
            faults: Where to add the faults.
            whole: The type of the file.
            kinds: The type of each table, by its dotted name without indices.
            several: Names of the tables that may repeat.

        """
        self._faults = faults
        self._whole, self._kinds, self._several = whole, kinds, several

    def sections(self, tables: dict[str, Any]) -> tuple[dict[str, Any], dict[str, list[int]]]:
        """Return what has no faults, and the indices that sections have in the file if they may repeat.

        Add the faults of the other sections and keys to the faults of the file.
        """
        sound: dict[str, Any] = {}
        places: dict[str, list[int]] = {}
        hinted = self._unknown(tables, "", "")
        for field in _fields(self._whole):
            if field.required and field.name not in tables and field.name not in hinted:
                self._faults.add(f"{field.name}: this key is needed")
            if field.name not in self._kinds and field.name in tables:
                value = tables[field.name]
                sound |= {field.name: value} if self._field(value, field.name, field.type) else {}
        for name in (one for one in self._kinds if "." not in one):
            if name not in tables:
                continue
            value = tables[name]
            if name not in self._several:
                good, found = self.table(value, name, name)
                sound |= {name: found} if good else {}
            elif isinstance(value, list):
                results = [self._one(item, name, index) for index, item in enumerate(self._first(value, name))]
                places[name] = [index for index, (good, _) in enumerate(results) if good]
                sound[name] = [found for good, found in results if good]
            else:
                self._no_list(name, value)
        return sound, places

    def _one(self, value: Any, name: str, index: int) -> tuple[bool, Any]:
        """Check one of several tables with the same name."""
        return self.table(value, f"{name}[{index}]", name)

    def _no_list(self, key: str, value: Any) -> None:
        if isinstance(value, dict):
            self._faults.add(f"{key}: write [[{key}]] with double brackets, because there can be several")
        else:
            self._faults.add(f"{key}: expected tables, each with the header [[{key}]]{but_found(key, value)}")

    def table(self, value: Any, key: str, name: str) -> tuple[bool, dict[str, Any]]:
        """Return whether a table has no faults, and its keys without faults, with their values.

        Args:
            value: The table.
            key: The key of the table in messages, such as ``source[0]``.
            name: The dotted name of the table without indices.
        """
        if not isinstance(value, dict):
            self._faults.add(f"{key}: expected a table with the header [{name}]{but_found(key, value)}")
            return False, {}
        kind = self._kinds[name]
        before = self._faults.count
        hinted = self._unknown(value, key, name)
        found: dict[str, Any] = {}
        for field in _fields(kind):
            inner = f"{key}.{field.name}"
            if field.name not in value:
                if field.required and field.name not in hinted:
                    self._faults.add(f"{inner}: this key is needed")
            elif f"{name}.{field.name}" in self._kinds:
                found[field.name] = self._inner(value[field.name], inner, f"{name}.{field.name}")
            elif self._field(value[field.name], inner, field.type):
                found[field.name] = value[field.name]
        return self._faults.count == before, found

    def _inner(self, value: Any, key: str, name: str) -> Any:
        if name not in self._several:
            return self.table(value, key, name)[1]
        if not isinstance(value, list):
            self._no_list(name, value)
            return []
        return [self.table(item, f"{key}[{index}]", name)[1] for index, item in enumerate(self._first(value, key))]

    def _first(self, value: list[Any], key: str) -> list[Any]:
        """Return the sections to check, which are at most ``MAX_SECTIONS``."""
        if len(value) > MAX_SECTIONS:
            self._faults.add(f"{key}: there are {len(value)} sections; only the first {MAX_SECTIONS} are checked")
        return value[:MAX_SECTIONS]

    def _field(self, value: Any, key: str, kind: Any) -> bool:
        for fault in text_faults(value, key):
            self._faults.add(fault)
            return False
        try:
            msgspec.convert(value, kind)
        except msgspec.ValidationError as error:
            self._faults.add(explain(error, key, kind, value))
            return False
        return True

    def _unknown(self, table: dict[str, Any], key: str, name: str) -> set[str]:
        """Add a fault for each unknown key; return the known keys that are probably meant."""
        known = _known(self._kinds[name] if name else self._whole)
        hinted: set[str] = set()
        for one in table:
            if one in known:
                continue
            if self._faults.full:
                self._faults.count += 1
                continue
            self._faults.add(_unknown(f"{key}.{one}".lstrip("."), known))
            hinted |= {*near(one, known)}
        return hinted


class _ConfigStructure(Structure):
    """Checks ``supervisor.toml``, in which a source may also have keys of its connector."""

    def __init__(
        self, faults: Faults, folder: Path, broken: dict[int, tuple[str, dict[str, Any], dict[str, str]]]
    ) -> None:
        super().__init__(faults, Config, _TABLES, _SEVERAL)
        self._folder = folder
        self._broken = broken

    def sections(self, tables: dict[str, Any]) -> tuple[dict[str, Any], dict[str, list[int]]]:
        """Return the sections without faults; if ``instance`` is not among them, with a substitute for it."""
        sound, places = super().sections(tables)
        sound.setdefault("instance", {"name": "unnamed"})
        return sound, places

    def _one(self, value: Any, name: str, index: int) -> tuple[bool, Any]:
        if name != "source" or not isinstance(value, dict):
            return super()._one(value, name, index)
        key = f"{name}[{index}]"
        common = {*_known(Source)}
        connector, misspelled = _connector_of(value, common)
        options = {name: item for name, item in value.items() if name not in common and name != misspelled}
        before = self._faults.count
        for fault in text_faults(options, key):
            self._faults.add(fault)
        texts: dict[str, str] = {}
        properties = value.get("properties")
        if isinstance(properties, str) and not any(text_faults(properties, "")):
            with self._faults.catching():
                read = read_properties(self._folder / properties, key)
                texts = {name: text for name, (text, _) in read.items() if name not in options}
                self._faults.lies_in(properties, key, {name: line for name, (_, line) in read.items() if name in texts})
        usable = self._faults.count == before
        good, found = self.table({name: value[name] for name in value if name not in options}, key, name)
        if good and usable:
            return True, found | {"options": options, "texts": texts}
        if isinstance(connector, str) and usable:
            self._broken[index] = connector, options, texts
        return False, found


def _connector_of(source: dict[str, Any], common: Collection[str]) -> tuple[object, str]:
    """Return the connector of a ``[[source]]``, and the misspelled key that gives it; "" if it is not misspelled."""
    if "connector" in source:
        return source["connector"], ""
    for key, value in source.items():
        if key not in common and near(key, ["connector"]):
            return value, key
    return None, ""


def convert(tables: dict[str, Any], kind: type[_Table]) -> _Table:
    """Convert the tables of a file to the type ``kind``.

    Raises:
        ConfigError: A key is unknown or its value is wrong; the message begins with the key.

    """
    try:
        return msgspec.convert(tables, kind)
    except msgspec.ValidationError as error:
        text, _, at = str(error).partition(" - at `$")
        path = at.rstrip("`").lstrip(".")
        unknown = re.search(r"unknown field `([^`]*)`", text)
        if unknown is None:
            raise ConfigError(explain(error, "", kind, tables)) from None
        table = re.sub(r"\[[^]]*\]", "", path)
        known = kind if not table else {**_TABLES, **_CAMPAIGN_TABLES}.get(table)
        raise ConfigError(
            _unknown(f"{path}.{unknown[1]}" if path else unknown[1], _known(known) if known else [])
        ) from None


def _known(kind: type[Section]) -> list[str]:
    """Return the names of the keys of a table."""
    return [name for name in kind.__struct_fields__ if name not in DERIVED.get(kind, ())]


def _unknown(key: str, known: Sequence[str]) -> str:
    remedy = did_you_mean(near(key.rpartition(".")[2], known)) or listed(known)
    return f"{key}: unknown key; {remedy}"


def unknown_option(index: int, key: str, known: list[str]) -> str:
    """Return the message for a key of ``source[index]`` that neither shmio nor the connector knows."""
    names = [*known, *_known(Source)]
    remedy = did_you_mean(near(key, names)) or f"the connector's keys are {', '.join(known)}"
    return f"source[{index}].{key}: unknown key; {remedy}"


def check_text(value: Any, key: str) -> None:
    """Check that no text in the value of ``key`` has control characters, which harm file names and terminals.

    (A type with a pattern would be simpler, but makes msgspec 0.22 crash when Python exits.)

    Raises:
        ConfigError: A text contains a control character.

    """
    for fault in text_faults(value, key):
        raise ConfigError(fault)


def text_faults(value: Any, key: str) -> Iterator[str]:
    """Yield a fault for each text with control characters in the value of ``key``, however deeply it is nested."""
    if isinstance(value, str) and any(char < " " or char == "\x7f" for char in value):
        path = "; write a path with backslashes in single quotes" if _SLIPPED.search(value) else ""
        yield f"{key}: must not contain control characters{but_found(key, value)}{path}"
    if isinstance(value, dict):
        for name, item in value.items():
            yield from text_faults(item, f"{key}.{name}".lstrip("."))
    elif isinstance(value, list):
        for index, item in enumerate(value):
            yield from text_faults(item, f"{key}[{index}]")


def _name_faults(config: Config) -> Iterator[str]:
    seen: dict[str, str] = {}
    for table in ("source", "emulator"):
        for index, section in enumerate(getattr(config, table)):
            key = f"{table}[{index}].name"
            folded = section.name.lower()
            if folded in RESERVED_SOURCES:
                yield f"{key}: {section.name!r} is reserved; choose another name"
            elif folded in SECTION_PROCESSES:
                yield f"{key}: {section.name!r} is the name of one of shmio's processes; choose another name"
            elif folded in seen:
                yield (
                    f"{key}: {already_named(section.name, seen[folded])} (names that differ only in case are the same)"
                )
            seen[folded] = f"{table}[{index}]"


def _reference_faults(config: Config, names: Sequence[str]) -> Iterator[str]:
    for name in config.recorder.sources if config.recorder else ():
        if name not in names:
            yield f"recorder.sources: {unknown('source', name, names)}"
    if config.grpc and config.grpc.default_source is not None and config.grpc.default_source not in names:
        yield f"grpc.default_source: {unknown('source', config.grpc.default_source, names)}"


def _time_faults(config: Config) -> Iterator[str]:
    for index, source in enumerate(config.source):
        if source.stale_ms is not None and source.stale_ms < 2 * source.period_ms:
            yield (
                f"source[{index}].stale_ms: {source.stale_ms:g} is less than two periods of {source.period_ms:g} ms: "
                "one late frame would make the source bad; raise stale_ms"
            )


def _rotation_faults(config: Config) -> Iterator[str]:
    for key, least in (("rotate_min", 0.1), ("rotate_mb", 1)) if config.recorder else ():
        value: float = getattr(config.recorder, key)
        if 0 < value < least:
            yield (
                f"recorder.{key}: {value:g} is less than {least:g} and would create too many files; write 0 to "
                "disable it"
            )
