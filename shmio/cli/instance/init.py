"""``shmio-supervisor init``: write a configuration to start from."""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from importlib import resources
from itertools import islice
from pathlib import Path

from shmio.cli.instance import naming
from shmio.cli.target import config_file, option_for
from shmio.config import Address
from shmio.config.properties import read_properties
from shmio.config.read import RESERVED_SOURCES, SECTION_PROCESSES
from shmio.errors import ConfigError, LayoutError
from shmio.layout.compiler import Program
from shmio.layout.model import Diagnostic, Layout
from shmio.layout.source.foreign import HEAD_BYTES, foreign
from shmio.logs import printable
from shmio.plan.layouts import read_program, summarize
from shmio.plan.ports import in_use

EXAMPLE = ("supervisor.toml", "db201.db")
EXAMPLE_NAME = "a50"
SOURCES = (".db", ".udt", ".scl", ".awl")
GRPC_PORTS = range(8089, 8189)
S7_PORTS = range(1102, 1202)
MAX_SOURCES = 50
"""Made of one file; of more data blocks one is chosen."""
RESERVED = RESERVED_SOURCES | SECTION_PROCESSES | {"plc"}
_DB_NUMBER = re.compile(r"[0-9]{1,5}", re.ASCII)
_NAME = re.compile(r"[^A-Za-z0-9_-]+")


def execute(arguments: argparse.Namespace) -> int:
    """Write the files, or none of them when one is there already."""
    file = config_file(arguments)
    _refuse_present(file)
    text, missing = None, list[str]()
    if arguments.files:
        text, missing = _own(file, arguments.files, arguments.block, emulated=arguments.emulated)
    elif arguments.block:
        raise ConfigError("--block chooses a data block of the files that are given, and there are none")
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


def _own(file: Path, files: Sequence[Path], name: str | None, *, emulated: bool) -> tuple[str, list[str]]:
    """A configuration for the controller's files (D6.5, section 4.2), and the keys that are left to fill in.

    ``name``: of the one data block that is wanted. ``emulated``: with a process in the controller's place, which holds
    the blocks.
    """
    sources = [path for path in files if path.suffix.lower() in SOURCES]
    others = [path for path in files if path not in sources]
    for path in others:
        _refuse_foreign(path)
    if not sources or len(others) > 1:
        raise ConfigError(
            f"init takes the sources of one controller ({', '.join(SOURCES)}) and at most one properties file such as "
            "plc.ini, or no file"
        )
    properties = read_properties(others[0], "init") if others else {}
    number = properties.get("dbNumber", "")
    program = read_program(sources)
    blocks = _compile(program, name, number)
    paths = [_relative(path, file) for path in sources]
    layout = f"layout = {_toml(paths if len(paths) > 1 else paths[0])}"
    held = ", ".join(block.name for block in program.blocks) if len(program.blocks) > 1 else ""
    names = _source_names(blocks)
    missing: list[str] = []
    lines = ["[instance]", f"name = {_toml(naming.vacant(_instance(blocks[0]), file))}", ""]
    addresses, emulators = _emulators(layout, blocks, len(program.blocks), number) if emulated else ([], [])
    for index, block in enumerate(blocks):
        if emulated:
            device, writable = _emulated(block, number, addresses[index]), '["**"]                     # all of it'
        else:
            device, left = _real(block, properties)
            missing += [key for key in left if key not in missing]
            writable = "[]                         # nothing is writable unless named"
        lines += [
            "[[source]]",
            f"name = {_toml(names[index])}",
            'connector = "s7"',
            layout,
            *([f"block = {_toml(block.name)}  # of {printable(held)}"] if held else []),
            *([f"properties = {_toml(_relative(others[0], file))}"] if others else []),
            *device,
            "period_ms = 20",
            f"writable = {writable}",
            "armed = false                         # whether an injection may reach the device",
            "",
        ]
    lines += [
        *emulators,
        "[grpc]",
        f"default_source = {_toml(names[0])}",
        "",
        *_addresses(["read", "write", "inject", "control"] if emulated else ["read"]),
        "# [recorder]                          # without the first #: everything, to files that shmio-dump reads",
        '# directory = "dumps"',
        "",
    ]
    return "\n".join(lines), missing


def _compile(program: Program, name: str | None, number: str) -> list[Layout]:
    """The data blocks that are to be sources: the one of this name, else of this number, else all that can be."""
    held = ", ".join(block.name for block in program.blocks)
    if name is not None:
        wanted = [block.name for block in program.blocks if block.name.lower() == name.lower()]
        if not wanted:
            raise ConfigError(f"--block: no data block {name!r}; there are: {held}")
    else:
        wanted = [block.name for block in program.blocks if str(block.number) == number]
    if not wanted and len(program.blocks) > 1 and number:
        raise ConfigError(f"no data block has the number {number} ({held}); choose one by --block NAME")
    if not wanted and len(program.blocks) > MAX_SOURCES:
        raise ConfigError(f"there are {len(program.blocks)} data blocks ({held}); choose one by --block NAME")
    if wanted or len(program.blocks) <= 1:
        compiled = program.compile(wanted or None)
        _warn(compiled.warnings)
        return list(compiled.layouts[:1])
    found: list[Layout] = []
    refused: list[LayoutError] = []
    for block in program.blocks:
        try:
            compiled = program.compile((block.name,))
        except LayoutError as error:
            refused.append(error)
            continue
        _warn(compiled.warnings)
        found += compiled.layouts
    if not found:
        raise refused[0]
    for why in refused:
        print(printable(f"left out: {why.diagnostics[0]}"), file=sys.stderr)
    return found


def _warn(warnings: Iterable[Diagnostic]) -> None:
    for line in summarize(warnings):
        print(printable(line), file=sys.stderr)


def _refuse_foreign(path: Path) -> None:
    """ConfigError: it is no properties file, but what TIA Portal exports in place of a source."""
    with suppress(OSError), path.open("rb") as stream:  # what cannot be read is told with the others
        if what := foreign(path.name, stream.read(HEAD_BYTES)):
            raise ConfigError(f"{path}: {what}")


def _source_names(blocks: Sequence[Layout]) -> list[str]:
    """A name for each source: ``cell`` for the only one, else after their blocks."""
    if len(blocks) == 1:
        return ["cell"]
    names: list[str] = []
    for block in blocks:
        name = first = _instance(block)
        count = 2
        while name in names or name in RESERVED:
            name, count = f"{first[:36]}-{count}", count + 1
        names.append(name)
    return names


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


def _number(block: Layout, number: str) -> int:
    return int(number) if _DB_NUMBER.fullmatch(number) else block.number or 1


def _emulated(block: Layout, number: str, address: Address) -> list[str]:
    """The source's lines that name an emulated controller."""
    return [
        f"host = {_toml(address.host):<31}# the emulator below; for a real controller: its address",
        f"port = {address.port:<31}# for a real controller: without this line",
        f"dbNumber = {_number(block, number):<27}# for a real controller: the number of its data block",
    ]


def _emulators(layout: str, blocks: Sequence[Layout], held: int, number: str) -> tuple[list[Address], list[str]]:
    """The address of each block's emulated controller, and the emulators' sections: one for all blocks if it can be."""
    together = len(blocks) == held > 1 and all(block.number is not None for block in blocks)
    ports = _free(S7_PORTS, 1 if together else len(blocks))
    if not together and len(ports) < len(blocks):
        raise ConfigError(f"there are {len(blocks)} data blocks and fewer free ports; choose one by --block NAME")
    lines: list[str] = []
    for index, block in enumerate(blocks[: len(ports)]):
        key = [f"block = {_toml(block.name)}"] if held > 1 else []
        lines += [
            "[[emulator]]                          # a process that plays the controller; for a real one: without it",
            f"name = {_toml('plc' if index == 0 else f'plc-{index + 1}')}",
            'kind = "s7"',
            layout,
            *([] if together else [*key, f"dbNumber = {_number(block, number)}"]),
            f"listen = {_toml(str(ports[index]))}",
            "",
        ]
    return [ports[0]] * len(blocks) if together else ports, lines


def _instance(block: Layout) -> str:
    """A name for the instance, after its block."""
    return _NAME.sub("-", block.name.lower()).strip("-_")[:40] or "cell"


def _addresses(roles: list[str]) -> list[str]:
    """The sections of the addresses at which gRPC is served, with what all may do who reach them."""
    others = "all that there are" if len(roles) > 1 else "there are write, inject and control, too"
    comment = f"# what every user of this host may do here; {others}"
    lines = []
    for address in _free(GRPC_PORTS, 2):
        lines += ["[[grpc.address]]", f"listen = {_toml(str(address))}", f"roles = {_toml(roles)}  {comment}", ""]
    return lines


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
