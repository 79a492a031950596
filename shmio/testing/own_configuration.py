"""A copy of a configuration for one test, with its own folder, instance name and addresses."""

from __future__ import annotations

import re
import secrets
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, Final

from shmio.config import Address
from shmio.config.read import read_tables
from shmio.config.toml import toml_file
from shmio.connectors import registry
from shmio.connectors.base import Computed, Replayed
from shmio.emulators.ports import reserved_port
from shmio.errors import ConfigError

FILE: Final = "supervisor.toml"
LOGS: Final = "logs"
LEFT_OUT: Final = ("alert", "recorder")
"""Sections that the copy leaves out: a test must alert nobody, and makes its own recording."""
_NAME_CHARS: Final = 31


class OwnConfiguration:
    """A copy of a configuration in a folder of its own, for an instance that disturbs no other.

    The folder has links to all files beside the original. Each address to listen on is replaced by
    a free port of this host. Sources that read from such an address read from the new one.
    """

    def __init__(self, file: Path, folder: Path, cleanup: ExitStack, *, real_time: bool = False) -> None:
        """Write the copy.

        Args:
            file: The original.
            folder: An empty folder.
            cleanup: Frees the ports when it is closed.
            real_time: True to run in real time even if virtual time is possible.

        Raises:
            ConfigError: The original cannot be read.

        """
        tables = read_tables(file)
        if not isinstance(tables.get("instance"), dict):
            raise ConfigError(f"{file}: instance: this section is needed")
        self.name = f"{str(tables['instance'].get('name', 'cell'))[:_NAME_CHARS]}-{secrets.token_hex(4)}"
        """Name of the instance."""
        self.virtual = not real_time and _all_computed(tables)
        """True if time is virtual from the start."""
        tables = {key: value for key, value in tables.items() if key not in LEFT_OUT}
        tables["instance"] |= {"name": self.name, "log_dir": LOGS}
        if self.virtual:
            tables["instance"]["clock"] = "stepped"
        _link(file, folder)
        ports = {str(old): cleanup.enter_context(reserved_port()) for old in dict.fromkeys(_listening(tables))}
        tables = _replaced(tables, ports, file.parent)
        for source in tables.get("source", ()):
            _redirect(source, ports)
        self.file = folder / FILE
        """The file of the copy."""
        self.file.write_text(toml_file(tables))


def _all_computed(tables: dict[str, Any]) -> bool:
    """Return whether all sources follow the instance's clock."""
    kinds = []
    for source in tables.get("source", ()):
        with suppress(ConfigError, AttributeError):  # the start of the instance will report it
            kinds.append(registry.load(str(source.get("connector"))))
    return bool(kinds) and all(issubclass(kind, Computed | Replayed) for kind in kinds)


def _link(file: Path, folder: Path) -> None:
    for entry in file.parent.iterdir():
        if entry.name not in (file.name, FILE, LOGS, "__pycache__"):
            (folder / entry.name).symlink_to(entry.resolve())


def _address(text: object) -> Address | None:
    """Return a TCP address in a normal form; None if ``text`` is not a TCP address."""
    if not isinstance(text, str) or text.startswith("unix:"):
        return None
    try:
        found = Address.parse(text)
    except ConfigError:
        return None
    return Address("127.0.0.1" if found.host == "localhost" else found.host, found.port)


def _listening(value: object) -> Iterator[Address]:
    """Yield the addresses of all keys ``listen``."""
    if isinstance(value, list):
        for one in value:
            yield from _listening(one)
    elif isinstance(value, dict):
        for key, inner in value.items():
            if key == "listen":
                texts = inner if isinstance(inner, list) else [inner]
                yield from (found for text in texts if (found := _address(text)) is not None)
            else:
                yield from _listening(inner)


def _replaced(value: Any, ports: dict[str, Address], folder: Path) -> Any:
    """Return a value with the new addresses, and with absolute paths instead of those that begin with ``..``."""
    if isinstance(value, dict):
        return {key: _replaced(inner, ports, folder) for key, inner in value.items()}
    if isinstance(value, list):
        return [_replaced(one, ports, folder) for one in value]
    if not isinstance(value, str):
        return value
    if (own := _address(value)) is not None:
        return str(ports.get(str(own), value))
    for old, new in ports.items():
        for spelled in (old, old.replace("127.0.0.1", "localhost")):
            if re.search(place := rf"(?<=//){re.escape(spelled)}(?!\d)", value):
                return re.sub(place, str(new), value)
    return str((folder / value).resolve()) if value.startswith("../") else value


def _redirect(source: dict[str, Any], ports: dict[str, Address]) -> None:
    """Let a source with the keys ``host`` and ``port`` read from the new address."""
    new = ports.get(str(_address(f"{source.get('host')}:{source.get('port')}")))
    if new is not None:
        source["host"], source["port"] = new.host, new.port
