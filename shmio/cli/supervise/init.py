"""``shmio-supervisor init``: write a configuration to start from."""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
from collections.abc import Mapping, Sequence
from importlib import resources
from itertools import islice
from pathlib import Path

from shmio.cli.supervise import naming
from shmio.cli.supervise.layouts import compile_files, summarize
from shmio.cli.supervise.ports import in_use
from shmio.cli.target import config_file, option_for
from shmio.config import Address
from shmio.config.properties import read_properties
from shmio.errors import ConfigError
from shmio.layout.model import Layout
from shmio.logs import printable

EXAMPLE = ("supervisor.toml", "db201.db")
EXAMPLE_NAME = "a50"
SOURCES = (".db", ".udt", ".scl", ".awl")
GRPC_PORTS = range(8089, 8189)
S7_PORTS = range(1102, 1202)
_DB_NUMBER = re.compile(r"[0-9]{1,5}", re.ASCII)
_NAME = re.compile(r"[^A-Za-z0-9_-]+")


def execute(arguments: argparse.Namespace) -> int:
    """Write the files, or none of them when one is there already."""
    file = config_file(arguments)
    _refuse_present(file)
    text, missing = _own(file, arguments.files, emulated=arguments.emulated) if arguments.files else (None, [])
    written = _example(file) if text is None else {file: text}
    other = naming.vacant(EXAMPLE_NAME, file) if text is None else EXAMPLE_NAME  # before it is taken by this one
    _write(written)
    for path in written:
        print(printable(f"wrote {path}"))
    if other != EXAMPLE_NAME:
        print(
            f"an instance or a configuration nearby is called {EXAMPLE_NAME}, too: to run both, call this one {other}"
        )
    first = f"fill in {' and '.join(missing)} in {file}, then " if missing else ""
    check, up = (f"shmio-supervisor {verb} {option_for(file)}".rstrip() for verb in ("check", "up"))
    print(printable(f"next: {first}{check}, then {up}"))
    return 0


def _example(file: Path) -> dict[Path, str]:
    """The A50 cell with its controller emulated, beside each other."""
    folder = resources.files("shmio.cli.a50")
    config, layout = ((folder / name).read_text(encoding="utf-8") for name in EXAMPLE)
    return {file: config, file.parent / EXAMPLE[1]: layout}


def _own(file: Path, files: Sequence[Path], *, emulated: bool) -> tuple[str, list[str]]:
    """A configuration for the controller's files (D6.5, section 4.2), and the keys that are left to fill in.

    ``emulated``: with a process in the controller's place, which holds the block.
    """
    sources = [path for path in files if path.suffix.lower() in SOURCES]
    others = [path for path in files if path not in sources]
    if not sources or len(others) > 1:
        raise ConfigError(
            f"init takes the sources of one controller ({', '.join(SOURCES)}) and at most one properties file such as "
            "plc.ini, or no file"
        )
    properties = read_properties(others[0], "init") if others else {}
    compiled = compile_files(sources)
    for line in summarize(compiled.warnings):
        print(printable(line), file=sys.stderr)
    block = _first(compiled.layouts, properties.get("dbNumber"))
    paths = [_relative(path, file) for path in sources]
    what = [f"layout = {_toml(paths if len(paths) > 1 else paths[0])}"]
    if len(compiled.layouts) > 1:
        held = ", ".join(layout.name for layout in compiled.layouts)
        what.append(f"block = {_toml(block.name)}  # of {printable(held)}")
    missing: list[str] = []
    if emulated:
        device, emulator = _emulated(what, block, properties.get("dbNumber", ""))
        writable = '["**"]                     # all of it'
    else:
        (device, missing), emulator = _real(block, properties), []
        writable = "[]                         # nothing is writable unless named"
    lines = [
        "[instance]",
        f"name = {_toml(naming.vacant(_instance(block), file))}",
        "",
        "[[source]]",
        'name = "cell"',
        'connector = "s7"',
        *what,
        *([f"properties = {_toml(_relative(others[0], file))}"] if others else []),
        *device,
        "period_ms = 20",
        f"writable = {writable}",
        "armed = false                         # whether an injection may reach the device",
        "",
        *emulator,
        "[grpc]",
        f"listen = {_toml([str(address) for address in _free(GRPC_PORTS, 2)])}",
        'default_source = "cell"',
        "",
        "# [recorder]                          # without the first #: everything, to files that shmio-dump reads",
        '# directory = "dumps"',
        "",
    ]
    return "\n".join(lines), missing


def _real(block: Layout, properties: Mapping[str, str]) -> tuple[list[str], list[str]]:
    """The source's lines that name its controller as far as that is not known, and the keys that are left."""
    lines, missing = [], []
    if "host" not in properties:
        missing.append("host")
        lines.append('# host = ""                           # needed: the address of your controller')
    if block.number is None and "dbNumber" not in properties:
        missing.append("dbNumber")
        lines.append("# dbNumber =                          # needed: the number of the data block")
    return lines, missing


def _emulated(what: Sequence[str], block: Layout, number: str) -> tuple[list[str], list[str]]:
    """The source's lines that name an emulated controller, and the section of that, which serves ``what``."""
    (address,) = _free(S7_PORTS, 1)
    key = f"dbNumber = {int(number) if _DB_NUMBER.fullmatch(number) else block.number or 1}"
    lines = [
        f"host = {_toml(address.host):<31}# the emulator below; for a real controller: its address",
        f"port = {address.port:<31}# for a real controller: without this line",
        f"{key:<38}# for a real controller: the number of its data block",
    ]
    section = [
        "[[emulator]]                          # a process that plays the controller; for a real one: without it",
        'name = "plc"',
        'kind = "s7"',
        *what,
        key,
        f"listen = {_toml(str(address))}",
        "",
    ]
    return lines, section


def _first(layouts: Sequence[Layout], number: str | None) -> Layout:
    """The block of this number, else the first."""
    return next((layout for layout in layouts if str(layout.number) == number), layouts[0])


def _instance(block: Layout) -> str:
    """A name for the instance, after its block."""
    return _NAME.sub("-", block.name.lower()).strip("-_")[:40] or "cell"


def _free(ports: range, count: int) -> list[Address]:
    """Addresses to listen on: the usual ones, else the next on which nobody listens now."""
    free = (address for port in ports if not in_use(address := Address("127.0.0.1", port)))
    return list(islice(free, count)) or [Address("127.0.0.1", 0)]


def _relative(path: Path, file: Path) -> str:
    """A path as the configuration writes it: relative to its folder when it lies below."""
    absolute, folder = path.resolve(), file.resolve().parent
    return str(absolute.relative_to(folder)) if absolute.is_relative_to(folder) else str(absolute)


def _toml(value: str | list[str]) -> str:
    """A TOML basic string, or an array of them; JSON's escapes are a subset of TOML's."""
    return json.dumps(value, ensure_ascii=False)


def _refuse_present(path: Path) -> None:
    if os.path.lexists(path):
        raise ConfigError(f"{path} is there already and is left as it is; choose another by -c FILE, or remove it")


def _write(files: dict[Path, str]) -> None:
    """Write all or none; a file that is there is never touched, a layout with the same content serves as it is."""
    for path, content in files.items():
        if not (path.is_file() and path.suffix == ".db" and path.read_bytes() == content.encode()):
            _refuse_present(path)
    for path, content in files.items():
        if not path.exists():
            with path.open("x", encoding="utf-8") as stream:
                stream.write(content)
