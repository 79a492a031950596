"""``shmio-supervisor init``: writes a first configuration.

The configuration is the A50 example, or is made for a controller from its files.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
import unicodedata
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from importlib import resources
from itertools import chain, count, islice
from pathlib import Path
from typing import Final, NamedTuple

from shmio.cli.target import config_file, option_for
from shmio.config import RESERVED_SOURCES, Address
from shmio.config.read import SECTION_PROCESSES, read_properties, read_tables
from shmio.config.web import check_library
from shmio.endpoints.mqtt.broker.program import check_installed
from shmio.errors import ConfigError, LayoutError
from shmio.files import create_file
from shmio.layout.compiler import SUFFIXES as SOURCES
from shmio.layout.compiler import Program
from shmio.layout.foreign import foreign
from shmio.layout.model import Layout
from shmio.layout.source.lexer import MAX_SOURCE_BYTES
from shmio.plan.layouts import read_program, summarize
from shmio.plan.ports import in_use
from shmio.segment import instances
from shmio.wording import printable, unknown

EXAMPLE = ("supervisor.toml", "db201.db", "scene.toml")
EXAMPLE_NAME = "a50"
TABLES = (".toml", ".csv", ".xlsx")
"""File name endings of tag tables."""
LISTS = (".csv", ".xlsx", ".sdf", ".asc", ".seq")
"""File name endings of other tools' tag lists."""
_URL = re.compile(r"([a-z][a-z.+-]*):/+", re.IGNORECASE)
TAG_LISTS: Final = (
    "a device without such files has a tag table: shmio-layout import converts the tag list of another tool, "
    "shmio-supervisor browse asks an OPC UA server, and docs/how-to/use-a-tag-list.md says how to write one"
)
GRPC_PORTS = range(8089, 8189)
S7_PORTS = range(1102, 1202)
MAX_SOURCES = 50
"""Maximum number of sources of a new configuration.

If the controller has more data blocks, the user must choose one.
"""
RESERVED = RESERVED_SOURCES | SECTION_PROCESSES | {"plc"}
_DB_NUMBER = re.compile(r"[0-9]{1,5}", re.ASCII)
_UMLAUTS: Final = str.maketrans({"ä": "ae", "ö": "oe", "ü": "ue", "ß": "ss"})
_NAME = re.compile(r"[^A-Za-z0-9_-]+")
MAX_LENGTH: Final = 40
MAX_FILES: Final = 500
"""Maximum number of configurations nearby that are searched for names in use."""


def init(arguments: argparse.Namespace) -> int:
    """Write the files of a first configuration. If one of them exists already, write none."""
    file = config_file(arguments)
    _refuse_present(file)
    text, missing = None, dict[Path, list[str]]()
    left_out: list[str] = []
    if arguments.files and arguments.demo:
        raise ConfigError("--demo writes the A50 example; give no files with it")
    if arguments.files:
        text, missing, warnings = new_config(file, arguments.files, arguments.block, emulated=arguments.emulated)
        for line in warnings:
            print(printable(line), file=sys.stderr)
    elif arguments.block:
        raise ConfigError("--block chooses a data block in the given files, but no file is given")
    written = {file: text} if text is not None else _example(file, left_out)
    other = vacant_name(EXAMPLE_NAME, file) if text is None else EXAMPLE_NAME  # before this instance takes the name
    _write(written)
    for path in written:
        print(printable(f"wrote {path}"))
    for line in left_out:
        print(line)
    if other != EXAMPLE_NAME:
        print(
            f"another instance or configuration has the name {EXAMPLE_NAME}, too; to run both, give this one the "
            f"name {other}"
        )
    left = [f"{' and '.join(keys)} in {place}" for place, keys in missing.items()]
    first = f"fill in {', and '.join(left)}, then " if left else ""
    check, up = (f"shmio-supervisor {verb} {option_for(file)}".rstrip() for verb in ("check", "up"))
    print(printable(f"next: {first}{check}, then {up}"))
    if text is None:
        print(f"for a PLC of your own: shmio-supervisor init -c FILE plc.ini FILE.db; {TAG_LISTS}")
    return 0


def _example(file: Path, left_out: list[str]) -> dict[Path, str]:
    """Return the files of the A50 cell with its emulated controller, by path.

    A section whose programs are not installed becomes a comment; its remedy is added to ``left_out``.
    """
    folder = resources.files("shmio.cli") / "a50"
    config, *others = ((folder / name).read_text(encoding="utf-8") for name in EXAMPLE)
    checks: dict[str, Callable[[], None]] = {"mqtt": check_installed, "web": partial(check_library, "web")}
    for section, check in checks.items():
        try:
            check()
        except ConfigError as error:
            config = comment_out(config, section)
            left_out.append(f"[{section}] is a comment for now: {error}")
    return {file: config} | {file.parent / name: text for name, text in zip(EXAMPLE[1:], others, strict=True)}


def comment_out(config: str, section: str) -> str:
    """Return a configuration in which the tables ``[section]`` and ``[[section.*]]`` are comments.

    Args:
        config: Text of a configuration with an empty line before each table.
        section: Name of the section.

    """
    tables = config.split("\n\n")
    for index, table in enumerate(tables):
        if table.lstrip("[").startswith((f"{section}]", f"{section}.")):
            tables[index] = "\n".join(f"# {line}" for line in table.splitlines())
    return "\n\n".join(tables) + ("" if tables[-1].endswith("\n") or not config.endswith("\n") else "\n")


def _refuse_present(path: Path) -> None:
    if os.path.lexists(path):
        raise ConfigError(
            f"{path} exists already and was not changed; choose another name by -c FILE, or remove the file"
        )


def _write(files: dict[Path, str]) -> None:
    """Write all files or none.

    Never change an existing file; an identical ``.db`` file or scene may exist.
    """
    for path, content in files.items():
        kept = path.suffix == ".db" or path.name in EXAMPLE[1:]
        if not (path.is_file() and kept and path.read_bytes() == content.encode()):
            _refuse_present(path)
    with ExitStack() as undone:
        for path, content in files.items():
            if not path.exists():
                create_file(path, content.encode())
                undone.callback(path.unlink, missing_ok=True)
        undone.pop_all()


class NewConfig(NamedTuple):
    """A first configuration, and what to tell the user about it."""

    text: str
    missing: dict[Path, list[str]]
    """Keys that the user must still fill in, by file: the configuration or the properties file."""
    warnings: list[str]
    """Warnings of the layout compiler, and about data blocks that cannot be used."""


def new_config(file: Path, files: Sequence[Path], name: str | None = None, *, emulated: bool = False) -> NewConfig:
    """Make a configuration for the files of a controller.

    Args:
        file: Where the configuration will be written.
        files: Source files of data blocks and tags, and at most one properties file.
        name: The data block to use; None for the block with the number in the properties file, or
            else for all blocks.
        emulated: True to add an emulated controller with these blocks.

    Raises:
        ConfigError: The files do not belong together, or are of other kinds.
        LayoutError: A source file cannot be compiled.

    """
    sources = [path for path in files if path.suffix.lower() in SOURCES]
    others = [path for path in files if path not in sources]
    for path in others:
        _refuse_table(path, file)
        _refuse_foreign(path)
    if not sources or len(others) > 1:
        raise ConfigError(
            f"init takes the sources of one controller ({', '.join(SOURCES)}) and at most one properties file such as "
            "plc.ini, or no file"
        )
    properties = {key: text for key, (text, _) in read_properties(others[0], "init").items()} if others else {}
    number = properties.get("dbNumber", "")
    program = read_program(sources)
    blocks, warnings = _compile(program, name, number)
    if not emulated and name is None and not number:  # else the user has chosen, and gets a warning
        blocks, warnings = _readable(blocks, warnings, file)
    paths = [_relative(path, file) for path in sources]
    layout = f"layout = {_toml(paths if len(paths) > 1 else paths[0])}"
    held = ", ".join(block.name for block in program.blocks) if len(program.blocks) > 1 else ""
    names = _source_names(blocks)
    missing: dict[Path, list[str]] = {}
    lines = ["[instance]", f"name = {_toml(vacant_name(_instance(blocks[0]), file))}", ""]
    addresses, emulators = _emulators(layout, blocks, len(program.blocks), number) if emulated else ([], [])
    for index, block in enumerate(blocks):
        if emulated:
            device, writable = _emulated(block, number, addresses[index]), '["**"]                     # all of it'
        else:
            device = []
            for key, comment in _unknown(block, properties):
                # All blocks share the properties file, so it cannot have the number of one of them.
                place = others[0] if others and (key == "host" or len(blocks) == 1) else file
                device += [comment] if place == file else []
                left = missing.setdefault(place, [])
                left += [key] if key not in left else []
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
        "# [recorder]                          # remove the # of both lines to record everything for shmio-dump",
        '# directory = "dumps"',
        "",
    ]
    return NewConfig("\n".join(lines), missing, warnings)


def _compile(program: Program, name: str | None, number: str) -> tuple[list[Layout], list[str]]:
    """Return the data blocks to use as sources, and warnings.

    If ``name`` is given, use only this block. Otherwise, use the block with ``number``; if
    ``number`` is empty, use all blocks that can be compiled.
    """
    held = ", ".join(block.name for block in program.blocks)
    if name is not None:
        wanted = [block.name for block in program.blocks if block.name.lower() == name.lower()]
        if not wanted:
            raise ConfigError(f"--block: {unknown('data block', name, (block.name for block in program.blocks))}")
    else:
        wanted = [block.name for block in program.blocks if str(block.number) == number]
    if not wanted and len(program.blocks) > 1 and number:
        raise ConfigError(f"no data block has the number {number} ({held}); choose one by --block NAME")
    if not wanted and len(program.blocks) > MAX_SOURCES:
        raise ConfigError(f"there are {len(program.blocks)} data blocks ({held}); choose one by --block NAME")
    if wanted or len(program.blocks) <= 1:
        compiled = program.compile(wanted or None)
        return list(compiled.layouts[:1]), summarize(compiled.warnings)
    found: list[Layout] = []
    warnings: list[str] = []
    refused: list[LayoutError] = []
    for block in program.blocks:
        try:
            compiled = program.compile((block.name,))
        except LayoutError as error:
            refused.append(error)
            continue
        warnings += summarize(compiled.warnings)
        found += compiled.layouts
    if not found:
        raise refused[0]
    return found, warnings + [f"left out: {why.diagnostics[0]}" for why in refused]


def _readable(blocks: Sequence[Layout], warnings: list[str], file: Path) -> tuple[list[Layout], list[str]]:
    """Return the blocks that the connector s7 can read, and the warnings, with those about the others.

    Raises:
        ConfigError: It can read none of them.

    """
    found = [block for block in blocks if not block.optimized]
    others = ", ".join(block.name for block in blocks if block.optimized)
    if not found:
        raise ConfigError(
            f"{others}: the connector s7 cannot read data blocks with optimized access; switch off 'Optimized block "
            "access' in the block's properties, compile and load it, and generate its source anew; or read it by OPC "
            f'UA: write a [[source]] with connector = "opcua" and nodes = "siemens" into {file}; '
            "--block NAME takes it as it is"
        )
    left_out = [f"left out: {others}, because the connector s7 cannot read optimized access"] if others else []
    return found, [*warnings, *left_out]


def _refuse_table(path: Path, file: Path) -> None:
    """Refuse a tag list or the URL of a server.

    Raises:
        ConfigError: ``path`` is one of these; the message says what to do with it.

    """
    text = str(path)
    if match := _URL.match(text):  # a path has lost one of the slashes
        url = f"{match[1]}://{text[match.end() :]}"
        raise ConfigError(
            f"{url}: init takes files, not URLs; shmio-supervisor browse {url} -o tags.toml writes a tag table "
            f"of what an OPC UA server offers; {_in_source(file, 'tags.toml')}"
        )
    suffix = path.suffix.lower()
    table, others = f"if this is a tag table, {_in_source(file, path.name)}", f"shmio-layout import {path} -o tags.toml"
    others = f"if it is an export of another tool, {others} makes a tag table of it"
    remedies = [text for text, kinds in ((table, TABLES), (others, LISTS)) if suffix in kinds]
    if remedies:
        raise ConfigError(f"{path}: this is not a source of data blocks, which init needs; {'; '.join(remedies)}")


def _in_source(file: Path, table: str) -> str:
    what = f'write layout = "{table}" and the connector of your device into a [[source]] of {file}'
    return f'{what} (over a data block: tags = "{table}" beside its layout)'


def _refuse_foreign(path: Path) -> None:
    """Refuse exports of TIA Portal that are not source files.

    Raises:
        ConfigError: The file is such an export.

    """
    with suppress(OSError), path.open("rb") as stream:  # unreadable files are reported with the others
        if what := foreign(path.name, stream.read(MAX_SOURCE_BYTES)):
            raise ConfigError(f"{path}: {what}")


def _source_names(blocks: Sequence[Layout]) -> list[str]:
    """Return a name for each source: ``cell`` for a single one, else made from the block's name."""
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


def _unknown(block: Layout, properties: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    """Yield each key about the real controller that has no value yet, and a comment line for it."""
    if "host" not in properties:
        yield "host", '# host = ""                           # needed: the address of your controller'
    if block.number is None and "dbNumber" not in properties:
        yield "dbNumber", "# dbNumber =                          # needed: the number of the data block"


def _number(block: Layout, number: str) -> int:
    return int(number) if _DB_NUMBER.fullmatch(number) else block.number or 1


def _emulated(block: Layout, number: str, address: Address) -> list[str]:
    """Return the lines of a source that give the address of its emulated controller."""
    return [
        f"host = {_toml(address.host):<31}# the emulator below; for a real controller: its address",
        f"port = {address.port:<31}# for a real controller: remove this line",
        f"dbNumber = {_number(block, number):<27}# for a real controller: the number of its data block",
    ]


def _emulators(layout: str, blocks: Sequence[Layout], count: int, number: str) -> tuple[list[Address], list[str]]:
    """Return the address of each block's emulator, and the lines of the emulators' sections.

    One emulator serves all blocks if possible.
    """
    together = len(blocks) == count > 1 and all(block.number is not None for block in blocks)
    ports = _free(S7_PORTS, 1 if together else len(blocks))
    if not together and len(ports) < len(blocks):
        raise ConfigError(
            f"{len(blocks)} data blocks need {len(blocks)} ports, but only {len(ports)} are free; "
            "choose one data block with --block NAME"
        )
    lines: list[str] = []
    for index, block in enumerate(blocks[: len(ports)]):
        key = [f"block = {_toml(block.name)}"] if count > 1 else []
        lines += [
            "[[emulator]]                          # a process that plays the controller; remove it for a real one",
            f"name = {_toml('plc' if index == 0 else f'plc-{index + 1}')}",
            'kind = "s7"',
            layout,
            *([] if together else [*key, f"dbNumber = {_number(block, number)}"]),
            f"listen = {_toml(str(ports[index]))}",
            "",
        ]
    return [ports[0]] * len(blocks) if together else ports, lines


def _instance(block: Layout) -> str:
    """Return a name for the instance, made from the name of its block."""
    plain = unicodedata.normalize("NFKD", unicodedata.normalize("NFC", block.name.lower()).translate(_UMLAUTS))
    letters = "".join(char for char in plain if not unicodedata.combining(char))
    return _NAME.sub("-", letters).strip("-_")[:40] or "cell"


def _addresses(roles: list[str]) -> list[str]:
    """Return the sections of the gRPC addresses, with the roles of unauthenticated clients."""
    others = "these are all roles" if len(roles) > 1 else "other roles: write, inject, control"
    comment = f"# what every user of this host may do here; {others}"
    lines = []
    for address in _free(GRPC_PORTS, 2):
        lines += ["[[grpc.address]]", f"listen = {_toml(str(address))}", f"roles = {_toml(roles)}  {comment}", ""]
    return lines


def _free(ports: range, count: int) -> list[Address]:
    """Return up to ``count`` free addresses on these ports, in the order of the ports."""
    free = (address for port in ports if not in_use(address := Address("127.0.0.1", port)))
    return list(islice(free, count)) or [Address("127.0.0.1", 0)]


def _relative(path: Path, file: Path) -> str:
    """Return a path as the configuration contains it.

    The path is relative if it is inside the configuration's folder.
    """
    absolute, folder = path.resolve(), file.resolve().parent
    return str(absolute.relative_to(folder)) if absolute.is_relative_to(folder) else str(absolute)


def _toml(value: str | list[str]) -> str:
    """Return a text, or a list of texts, as TOML. JSON's escapes are also valid in TOML."""
    return json.dumps(value, ensure_ascii=False)


def vacant_name(name: str, file: Path) -> str:
    """Return a name that is not in use: ``name``, ``name-2`` and so on.

    A name is in use if an instance or a configuration near ``file`` has it. ``file`` is where the
    new configuration will be written.
    """
    taken = {*instances(), *_configured(file)}
    numbered = (f"{name[: MAX_LENGTH - len(end)]}{end}" for end in (f"-{number}" for number in count(2)))
    return next(found for found in chain([name], numbered) if found not in taken)


def _configured(file: Path) -> Iterator[str]:
    """Yield the names of instances configured in this folder, its neighbours and its parent."""
    folder = file.resolve().parent
    found = chain(folder.glob("*.toml"), folder.parent.glob("*/supervisor.toml"), folder.parent.glob("*.toml"))
    for other in islice(found, MAX_FILES):
        with suppress(ConfigError, OSError, KeyError, TypeError):
            yield str(read_tables(other)["instance"]["name"])
