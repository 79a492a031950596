"""Leaves secrets out of an exported instance: files with secrets, sections of endpoints, and values of sources."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from shmio.config.masking import is_secret, mask_value
from shmio.config.toml import toml_file
from shmio.errors import ConfigError

SECTIONS: Final = ("instance", "source", "injection")
"""The sections that a laboratory uses. Those of endpoints have tokens, accounts and addresses of webhooks."""
MARK: Final = "left out by export-fmu"
"""Takes the place of a secret text."""
SECRET_FILES: Final = frozenset(
    {"token_file", "password_file", "webhook_header_file", "credentials", "key", "user_key"}
)
"""shmio's own keys that name a file with a secret. The names of other packages' keys decide."""


def read_instance(file: Path) -> dict[str, Any] | None:
    """Return the tables of a configuration of an instance; None if the file is something else.

    Faults in it are for :func:`shmio.plan.prepare.prepare` to report.
    """
    try:
        found = tomllib.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    return found if isinstance(found.get("source"), list) or isinstance(found.get("instance"), dict) else None


def secret_files(tables: dict[str, Any], folder: Path) -> set[Path]:
    """Return the files that keys for secrets name; relative names are below a folder."""
    return {
        (folder / value).resolve() for key, value in _texts("", tables) if key in SECRET_FILES or _names_secret(key)
    }


def kept(tables: dict[str, Any]) -> dict[str, Any]:
    """Return the tables that a laboratory uses."""
    return {name: tables[name] for name in SECTIONS if name in tables}


def without_secrets(tables: dict[str, Any]) -> tuple[str, list[str]]:
    """Return the text of a configuration without secret texts, and the keys that had them."""
    keys: list[str] = []
    return toml_file({name: _cleaned(name, name, value, keys) for name, value in tables.items()}), keys


def check_complete(config: Path) -> None:
    """Check that a configuration has all secrets that its sources use.

    Raises:
        ConfigError: The export has left one out.

    """
    tables = read_instance(config)
    if tables is None:
        return
    keys: list[str] = []
    _find_marks("", tables, keys)
    if keys:
        raise ConfigError(
            f"{', '.join(keys)}: the export has left this secret out; write it into {config.name} in resources/"
            f"{config.parent.name} of the FMU, which is a ZIP archive, or give the key a name that means no secret"
        )


def _names_secret(key: str) -> bool:
    stem = key.removesuffix("_file").removesuffix("_path")
    return is_secret(stem)


def _texts(key: str, value: Any) -> Iterator[tuple[str, str]]:
    """Yield each text below a value, with the name of its key."""
    if isinstance(value, str):
        yield key, value
    elif isinstance(value, dict):
        for name, inner in value.items():
            yield from _texts(name, inner)
    elif isinstance(value, list):
        for inner in value:
            yield from _texts(key, inner)


def _cleaned(place: str, key: str, value: Any, keys: list[str]) -> Any:
    """Return a value in which a mark replaces secret texts. Numbers are no secrets."""
    if isinstance(value, dict):
        return {name: _cleaned(f"{place}.{name}", name, inner, keys) for name, inner in value.items()}
    if isinstance(value, list):
        return [_cleaned(f"{place}[{index}]", key, inner, keys) for index, inner in enumerate(value)]
    if isinstance(value, str) and value and mask_value(key, value) != value:
        keys.append(place)
        return MARK
    return value


def _find_marks(place: str, value: Any, keys: list[str]) -> None:
    if value == MARK:
        keys.append(place)
    elif isinstance(value, dict):
        for name, inner in value.items():
            _find_marks(f"{place}.{name}" if place else name, inner, keys)
    elif isinstance(value, list):
        for index, inner in enumerate(value):
            _find_marks(f"{place}[{index}]", inner, keys)
