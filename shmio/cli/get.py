"""``shmio get``: values as of now."""

from __future__ import annotations

import argparse

from shmio.cli.readings import as_json, as_line, choose, topic_path
from shmio.cli.run import dumps
from shmio.segment import Frame
from shmio.segment.attach import Attachment
from shmio.segment.view import reading

HELP = "Print the present values of registers, with quality and age."


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the verb's own arguments."""
    parser.add_argument("patterns", nargs="+", metavar="PATH", help="path, array element, structure or glob")


def execute(cell: Attachment, options: argparse.Namespace) -> int:
    """Print all values of one source from one frame."""
    chosen = choose(cell, options.patterns)
    frames: dict[str, Frame | None] = {}
    for block, _ in chosen:
        if block.source not in frames:
            frames[block.source] = block.latest()
    found = [(topic_path(b, r), reading(b, r, frames[b.source]), r) for b, r in chosen]
    if options.json:
        print(dumps({path: as_json(now, register) for path, now, register in found}))
        return 0
    width = max(len(path) for path, _, _ in found)
    for path, now, register in found:
        print(as_line(path, now, register, width))
    return 0
