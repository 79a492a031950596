"""``shmio-layout``: compiles source files of data blocks and prints registers with offsets."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Iterator, Sequence

from shmio.cli import layout_import
from shmio.cli.common import add_json, complete, dumps, run
from shmio.cli.layout_options import add_encoding, add_type_bytes, read_source
from shmio.errors import ConfigError, LayoutError
from shmio.layout.compiler import Program
from shmio.layout.encodings import UTF_16, WINDOWS_1252, canonical
from shmio.layout.image import initial_value_warnings
from shmio.layout.model import Layout, Register
from shmio.version import __version__
from shmio.wording import counted, printable, unknown

_HEADINGS = ("offset", "size", "type", "path", "over", "initial", "comment")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``shmio-layout``. Return its exit status: 0 for success, 1 for a failure, 2 for wrong usage."""
    given = sys.argv[1:] if arguments is None else arguments
    if given[:1] == ["import"]:
        return layout_import.main(given[1:])
    parser = _parser()
    complete(parser)
    options = parser.parse_intermixed_args(arguments)
    return run(parser.prog, lambda: _compile(options), options)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="shmio-layout",
        description="Compile the data blocks of a source exported by TIA Portal or STEP 7 and print each register: "
        "path, type, byte offset, bit, size. 'shmio-layout import FILE' converts a tag list "
        "into a tag table; see its --help.",
    )
    parser.add_argument("file", metavar="FILE", help="the source with the data blocks (.db, .awl, .scl, .s7dcl)")
    parser.add_argument(
        "types",
        metavar="SOURCE",
        nargs="*",
        help="further sources, with the PLC data types, function blocks and constants that FILE uses, and tag tables "
        "over its data blocks",
    )
    parser.add_argument("--block", metavar="NAME", help="only this data block; ignore errors in others")
    add_type_bytes(parser)
    add_encoding(parser)
    parser.add_argument(
        "--by-name",
        action="store_true",
        help='compile for reading by OPC UA with nodes = "siemens": no type needs a size, and offsets have no meaning',
    )
    add_json(parser, "print JSON: one object, or a list for several blocks")
    parser.add_argument("--version", action="version", version=f"shmio {__version__}")
    return parser


def _compile(options: argparse.Namespace) -> int:
    block, sizes = options.block, dict(options.type_bytes)
    encoding = "" if options.encoding in (None, UTF_16) else canonical(options.encoding)
    program = Program([read_source(name, options.encoding) for name in (options.file, *options.types)])
    if block is not None and block.lower() not in {one.name.lower() for one in program.blocks}:
        program.compile(())  # reports damaged sources first
        raise ConfigError(f"--block: {unknown('data block', block, (one.name for one in program.blocks))}")
    try:
        compiled = program.compile(None if block is None else (block,), sizes, by_name=options.by_name)
    except LayoutError as error:
        _complain(one for one in error.diagnostics if one.severity == "warning")  # the error's text has the errors
        raise
    _complain(compiled.warnings)
    _complain(f"warning: --type-bytes: no member has the type {name!r}" for name in compiled.unused)
    for layout in compiled.layouts:
        _complain(_unread(layout.with_encoding(encoding or WINDOWS_1252)))
    layouts = [one.with_encoding(encoding) if encoding else one for one in compiled.layouts]
    _print(layouts, as_json=options.json)
    return 0


def _complain(lines: Iterable[object]) -> None:
    for line in lines:
        print(printable(str(line)), file=sys.stderr)


def _unread(layout: Layout) -> Iterator[str]:
    """Yield a warning for each initial value that shmio cannot read.

    An emulated PLC starts without these values.
    """
    for text in initial_value_warnings(layout):
        yield f"{layout.name}: warning: {text}"


def _print(layouts: Sequence[Layout], *, as_json: bool) -> None:
    if as_json:
        described = [layout.describe() for layout in layouts]
        print(dumps(described[0] if len(described) == 1 else described, indent=2))
        return
    for position, layout in enumerate(layouts):
        if position:
            print()
        for line in _table(layout):
            print(printable(line))


def _table(layout: Layout) -> list[str]:
    number = f", DB{layout.number}" if layout.number is not None else ""
    access = "optimized access" if layout.optimized else "standard access"
    count = len(layout.registers)
    title = f"{layout.name}{number}: {layout.size} bytes, {counted(count, 'register')}, {access}"
    rows = [_HEADINGS, *(_row(register) for register in layout.registers)]
    used = [i for i in range(len(_HEADINGS)) if i < 4 or any(row[i] for row in rows[1:])]
    widths = {i: max(len(row[i]) for row in rows) for i in used}
    lines = ["  ".join(row[i].rjust(widths[i]) if i < 2 else row[i].ljust(widths[i]) for i in used) for row in rows]
    return [title, *(line.rstrip() for line in lines)]


def _row(register: Register) -> tuple[str, ...]:
    place = str(register.offset) if register.bit is None else f"{register.offset}.{register.bit}"
    bounds = ", ".join(f"{low}..{high}" for low, high in register.dims)
    kind = f"ARRAY[{bounds}] OF {register.type}" if register.dims else register.type
    return (
        place,
        str(register.size),
        kind,
        register.path,
        register.over,
        _short(register.initial or ""),
        register.comment,
    )


def _short(text: str) -> str:
    text = " ".join(text.split())
    return text if len(text) <= 40 else f"{text[:39]}…"


if __name__ == "__main__":
    sys.exit(main())
