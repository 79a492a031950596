"""``shmio-supervisor new-connector``: writes a package with a working connector to start from."""

from __future__ import annotations

import argparse
import os
import re
import shutil
from importlib import resources
from pathlib import Path
from typing import Final

from shmio.connectors.registry import BUILT_IN, names
from shmio.errors import ConfigError
from shmio.files import create_file
from shmio.wording import printable

MAX_LENGTH: Final = 40
_NAME = re.compile(r"[a-z][a-z0-9]*(?:[-_][a-z0-9]+)*", re.ASCII)
_FILES: Final = {
    "README.md": "README.md",
    "docs/{name}.md": "docs.md",
    "pyproject.toml": "pyproject.toml",
    "src/{module}/__init__.py": "__init__.py",
    "src/{module}/client.py": "client.py",
    "src/{module}/connector.py": "connector.py",
    "src/{module}/py.typed": "py.typed",
    "supervisor.toml": "supervisor.toml",
    "tags.toml": "tags.toml",
    "tests/conftest.py": "conftest.py",
    "tests/device.py": "device.py",
    "tests/test_{part}.py": "test_fieldbus.py",
}
"""Templates by the path of the new file. In the templates, the connector is called ``fieldbus``."""


def new_connector(arguments: argparse.Namespace) -> int:
    """Write the package to a new folder."""
    name: str = arguments.connector
    _check_name(name)
    folder: Path = arguments.directory or Path(f"shmio-{name.replace('_', '-')}")
    if os.path.lexists(folder):
        raise ConfigError(
            f"{folder} exists already and was not changed; choose another name by -o FOLDER, or remove the folder"
        )
    files = {folder / path: content.encode() for path, content in package(name).items()}
    try:
        for file, content in files.items():
            file.parent.mkdir(parents=True, exist_ok=True)
            create_file(file, content)
    except OSError:
        shutil.rmtree(folder, ignore_errors=True)  # else another attempt would refuse the folder
        raise
    for file in files:
        print(printable(f"wrote {file}"))
    print(printable(f"next: cd {folder}, then pip install -e '.[test]', then pytest; README.md says what to replace"))
    return 0


def package(name: str) -> dict[str, str]:
    """Return the files of a package with a new connector: their texts, by path."""
    part = name.replace("-", "_")
    module = f"shmio_{part}"
    letters = "".join(word.capitalize() for word in part.split("_"))
    words = [
        ("shmio_fieldbus", module),
        ("shmio-fieldbus", f"shmio-{name.replace('_', '-')}"),
        ("Fieldbus", letters),
        ("fieldbus-example", f"{name[:30].rstrip('-_')}-example"),
        ("test_fieldbus", f"test_{part}"),
        ("fieldbus", name),
    ]
    swap = re.compile("|".join(old for old, _ in words))
    templates = resources.files("shmio.cli") / "connector_template"
    files = {}
    for path, template in _FILES.items():
        text = (templates / f"{template}.template").read_text(encoding="utf-8")
        files[path.format(name=name, module=module, part=part)] = swap.sub(lambda found: dict(words)[found[0]], text)
    return files


def _check_name(name: str) -> None:
    if len(name) > MAX_LENGTH or not _NAME.fullmatch(name):
        raise ConfigError(
            f"{name[:MAX_LENGTH]!r} is not a name for a connector; use at most {MAX_LENGTH} characters: a lower-case "
            "letter, then lower-case letters and digits, with single '-' or '_' between them, such as my-bus"
        )
    if name in BUILT_IN:
        raise ConfigError(f"{name!r} is a connector of shmio; choose another name")
    if name in names():
        raise ConfigError(f"an installed package offers a connector {name!r}; choose another name, or pip uninstall it")
