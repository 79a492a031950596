"""``shmio-layout import``: converts another tool's tag list into a tag table."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from shmio.cli.common import run
from shmio.cli.layout_options import add_encoding, add_type_bytes, read_source
from shmio.files import create_file
from shmio.layout.foreign import FORMATS
from shmio.layout.importing.found import ImportingError
from shmio.layout.importing.importer import MAX_BYTES, import_tags
from shmio.wording import EXISTS, NOT_TOML, printable


def main(arguments: Sequence[str]) -> int:
    """Run ``shmio-layout import``. Return its exit status: 0 for success, 1 for a failure, 2 for wrong usage."""
    parser = parser_of_import()
    options = parser.parse_args(arguments)
    return run(parser.prog, lambda: _import(options), options)


def parser_of_import() -> argparse.ArgumentParser:
    """Return the parser of ``shmio-layout import``."""
    parser = argparse.ArgumentParser(
        prog="shmio-layout import",
        description=f"Convert a tag list into a tag table, and report what was left out. Imports {FORMATS}.",
    )
    parser.add_argument("file", metavar="FILE", type=Path, help="the list that the vendor's tool has exported")
    parser.add_argument(
        "further",
        metavar="SOURCE",
        nargs="*",
        help="for XML of data blocks: further files, with the PLC data types, function blocks and constants that they "
        "use (.xml, .udt, .scl, .s7dcl)",
    )
    parser.add_argument(
        "-o", "--output", metavar="TABLE.toml", type=Path, help="the new tag table; default: standard output"
    )
    parser.add_argument(
        "--writable",
        action="store_true",
        help="allow commands to write what the vendor's tool lets other programs write",
    )
    add_encoding(parser)
    add_type_bytes(parser)
    parser.add_argument(
        "--by-name",
        action="store_true",
        help='leave out the addresses of a data block, to read it by OPC UA with nodes = "siemens"',
    )
    return parser


def _import(options: argparse.Namespace) -> int:
    file: Path = options.file
    output: Path | None = options.output
    if output is not None and output.suffix != ".toml":
        raise ImportingError(f"{output}: {NOT_TOML}")
    with file.open("rb") as stream:
        data = stream.read(MAX_BYTES + 1)
    further = [read_source(name, options.encoding, MAX_BYTES) for name in options.further]
    try:
        found = import_tags(
            data,
            str(file),
            further=further,
            encoding=options.encoding or "",
            type_bytes=dict(options.type_bytes),
            by_name=options.by_name,
        )
    except ImportingError as error:
        raise ImportingError(f"{file}: {error}") from None
    for line in found.report(writable=options.writable):
        print(printable(line), file=sys.stderr)
    if not found.tags:
        raise ImportingError(f"{file}: the file has nothing to import")
    table = found.to_toml(", ".join(Path(name).name for name in (file, *options.further)), writable=options.writable)
    if output is None:
        print(table, end="")
        return 0
    try:
        create_file(output, table.encode())
    except FileExistsError:
        raise ImportingError(f"{output}: {EXISTS}") from None
    return 0
