"""``shmio-supervisor init``: write a configuration to start from."""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
from importlib import resources
from pathlib import Path

from shmio.cli.supervise.target import config_file
from shmio.config.properties import read_properties
from shmio.errors import ConfigError
from shmio.layout import compiler
from shmio.layout.lexer import MAX_SOURCE_BYTES

EXAMPLE = ("supervisor.toml", "db201.db")
_NAME = re.compile(r"[^A-Za-z0-9_-]+")


def execute(arguments: argparse.Namespace) -> int:
    """Write the files, or none of them when one is there already."""
    file = config_file(arguments)
    written = _own(file, arguments.files) if arguments.files else _example(file)
    _write(written)
    for path in written:
        print(f"wrote {path}")
    print(f"next: shmio-supervisor check{_option(file)}, then shmio-supervisor up{_option(file)}")
    return 0


def _option(file: Path) -> str:
    return "" if file == Path("supervisor.toml") else f" -c {file}"


def _example(file: Path) -> dict[Path, str]:
    """The A50 cell with its controller emulated, beside each other."""
    folder = resources.files("shmio.cli.a50")
    config, layout = ((folder / name).read_text(encoding="utf-8") for name in EXAMPLE)
    return {file: config, file.parent / EXAMPLE[1]: layout}


def _own(file: Path, files: list[Path]) -> dict[Path, str]:
    """A configuration for the two files of the Java version (D6.5, section 4.2): plc.ini and the block's source."""
    layouts = [path for path in files if path.suffix.lower() == ".db"]
    others = [path for path in files if path not in layouts]
    if len(layouts) != 1 or len(others) > 1:
        raise ConfigError("init takes one .db file and at most one properties file such as plc.ini, or no file")
    block = _compile(layouts[0])
    name = _NAME.sub("-", block.lower()).strip("-_")[:40] or "cell"
    lines = ["[instance]", f"name = {_text(name)}", "", "[[source]]", 'name = "cell"', 'connector = "s7"']
    lines.append(f"layout = {_text(_relative(layouts[0], file))}")
    if others:
        read_properties(others[0], "init")
        lines.append(f"properties = {_text(_relative(others[0], file))}")
    else:
        lines.append('host = "192.168.0.1"                  # the address of your controller')
    lines += [
        "period_ms = 20",
        "writable = []                         # nothing is writable unless named",
        "armed = false                         # whether an injection may reach the device",
        "",
        "[grpc]",
        'listen = ["127.0.0.1:8089", "127.0.0.1:8090"]',
        'default_source = "cell"',
        "",
    ]
    return {file: "\n".join(lines)}


def _compile(path: Path) -> str:
    """Check the source and return its block's name; warnings go to standard error."""
    with path.open("rb") as stream:
        compiled = compiler.compile_sources([compiler.Source(str(path), stream.read(MAX_SOURCE_BYTES + 4))])
    for warning in compiled.warnings:
        print(warning, file=sys.stderr)
    return compiled.layouts[0].name


def _relative(path: Path, file: Path) -> str:
    """A path as the configuration writes it: relative to its folder when it lies below."""
    absolute, folder = path.resolve(), file.resolve().parent
    return str(absolute.relative_to(folder)) if absolute.is_relative_to(folder) else str(absolute)


def _text(value: str) -> str:
    """A TOML basic string; JSON's escapes are a subset of TOML's."""
    return json.dumps(value, ensure_ascii=False)


def _write(files: dict[Path, str]) -> None:
    """Write all or none; a file that is there is never touched, one with the same content serves as it is."""
    for path, content in files.items():
        if os.path.lexists(path) and not (path.is_file() and path.suffix == ".db" and path.read_text() == content):
            raise ConfigError(f"{path} is there already and is left as it is; choose another by -c FILE, or remove it")
    for path, content in files.items():
        if not path.exists():
            with path.open("x", encoding="utf-8") as stream:
                stream.write(content)
