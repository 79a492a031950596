"""Options that ``shmio-layout`` and ``shmio-layout import`` share."""

from __future__ import annotations

import argparse
from pathlib import Path

from shmio.layout.compiler import Source
from shmio.layout.encodings import codec, encoding_of_file
from shmio.layout.model import MAX_BLOCK_BYTES
from shmio.layout.source.lexer import MAX_SOURCE_BYTES


def add_encoding(parser: argparse.ArgumentParser) -> None:
    """Add ``--encoding``."""
    parser.add_argument(
        "--encoding",
        metavar="NAME",
        type=_encoding,
        default=None,
        help="the encoding of texts in the controller, and in files that are not UTF-8, such as gbk; default: "
        "Windows-1252, for files with a warning",
    )


def add_type_bytes(parser: argparse.ArgumentParser) -> None:
    """Add ``--type-bytes``."""
    parser.add_argument(
        "--type-bytes",
        metavar="TYPE=BYTES",
        type=_size,
        action="append",
        default=[],
        help="the size of a type whose members are not known; shmio treats its values as bytes without meaning",
    )


def read_source(name: str, encoding: str | None, limit: int = MAX_SOURCE_BYTES) -> Source:
    """Read a file. If it is too large, read just enough that the compiler refuses it."""
    with Path(name).open("rb") as file:
        data = file.read(limit + 4)
    return Source(name, data, encoding_of_file(data, encoding or ""))


def _encoding(text: str) -> str:
    try:
        codec(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return text


def _size(text: str) -> tuple[str, int]:
    name, _, number = text.rpartition("=")
    size = int(number) if number.isascii() and number.isdecimal() and len(number) < 8 else 0
    if not name or not 1 <= size <= MAX_BLOCK_BYTES:
        raise argparse.ArgumentTypeError(f"{text!r}: expected a type and its bytes, such as TON_TIME=16")
    return name.strip('"'), size
