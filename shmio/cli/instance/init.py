"""``shmio-supervisor init``: write a first configuration."""

from __future__ import annotations

import argparse
import os
import sys
from importlib import resources
from pathlib import Path

from shmio.cli.target import config_file, option_for
from shmio.errors import ConfigError
from shmio.logs import printable
from shmio.plan.new_config import new_config, vacant_name

EXAMPLE = ("supervisor.toml", "db201.db")
EXAMPLE_NAME = "a50"


def init(arguments: argparse.Namespace) -> int:
    """Write the files, or none of them if one exists already."""
    file = config_file(arguments)
    _refuse_present(file)
    text, missing = None, dict[Path, list[str]]()
    if arguments.files:
        text, missing, warnings = new_config(file, arguments.files, arguments.block, emulated=arguments.emulated)
        for line in warnings:
            print(printable(line), file=sys.stderr)
    elif arguments.block:
        raise ConfigError("--block chooses a data block of the files that are given, and there are none")
    written = _example(file) if text is None else {file: text}
    other = vacant_name(EXAMPLE_NAME, file) if text is None else EXAMPLE_NAME  # before this instance takes the name
    _write(written)
    for path in written:
        print(printable(f"wrote {path}"))
    if other != EXAMPLE_NAME:
        print(
            f"an instance or a configuration nearby is called {EXAMPLE_NAME}, too: to run both, call this one {other}"
        )
    left = [f"{' and '.join(keys)} in {place}" for place, keys in missing.items()]
    first = f"fill in {', and '.join(left)}, then " if left else ""
    check, up = (f"shmio-supervisor {verb} {option_for(file)}".rstrip() for verb in ("check", "up"))
    print(printable(f"next: {first}{check}, then {up}"))
    return 0


def _example(file: Path) -> dict[Path, str]:
    """Return the files of the A50 cell with its emulated controller, by path."""
    folder = resources.files("shmio.cli.a50")
    config, layout = ((folder / name).read_text(encoding="utf-8") for name in EXAMPLE)
    return {file: config, file.parent / EXAMPLE[1]: layout}


def _refuse_present(path: Path) -> None:
    if os.path.lexists(path):
        raise ConfigError(f"{path} is there already and is left as it is; choose another by -c FILE, or remove it")


def _write(files: dict[Path, str]) -> None:
    """Write all files or none; never change an existing file, but use a layout that is the same."""
    for path, content in files.items():
        if not (path.is_file() and path.suffix == ".db" and path.read_bytes() == content.encode()):
            _refuse_present(path)
    for path, content in files.items():
        if not path.exists():
            with path.open("x", encoding="utf-8") as stream:
                stream.write(content)
