"""``shmio snapshot``: saves the state of an instance in virtual time, and restores it."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator
from typing import Any, Final

import msgspec

from shmio.cli.common import dumps
from shmio.model.cell import Cell
from shmio.model.snapshot import SnapshotInfo
from shmio.times import local_text
from shmio.wording import printable

_ACTIONS: Final = {
    "save": "NAME: save the present state; a snapshot of this name is replaced",
    "restore": "NAME: continue from that state; time may go back",
    "list": "show all snapshots",
    "delete": "NAME: delete that snapshot",
}


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``snapshot``."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    lines = "\n".join(f"  {action:<8} {text}" for action, text in _ACTIONS.items())
    parser.description = f"{parser.description}\n\nACTION is one of\n{lines}"
    parser.add_argument("action", choices=_ACTIONS, metavar="ACTION")
    parser.add_argument("name", nargs="?", metavar="NAME")
    parser.add_argument(
        "--partial", action="store_true", help="with save: leave out what cannot be saved, and say what it is"
    )
    parser.set_defaults(refuse=parser.error)


def execute(cell: Cell, options: argparse.Namespace) -> int:
    """Save, restore, list or delete snapshots, and print the snapshots concerned.

    Raises:
        SnapshotError: The snapshot cannot be saved, restored or deleted.
        TimeError: The clock is in real time, or another program controls it.
    """
    action, name = options.action, options.name
    if (name is None) != (action == "list"):
        options.refuse(f"{action} needs a NAME" if name is None else "list takes no NAME")
    if options.partial and action != "save":
        options.refuse("--partial is only for save")
    match action:
        case "save":
            found = [cell.save_snapshot(name, partial=options.partial)]
        case "restore":
            found = [cell.restore_snapshot(name)]
        case "delete":
            cell.delete_snapshot(name)
            found = []
        case _:
            found = cell.snapshots()
    if options.json:
        print(dumps([_plain(one) for one in found]))
    else:
        for line in _lines(found):
            print(printable(line))
    return 0


def _plain(one: SnapshotInfo) -> dict[str, Any]:
    return msgspec.structs.asdict(one)


def _lines(found: Iterable[SnapshotInfo]) -> Iterator[str]:
    for one in found:
        if one.problem:
            yield f"{one.name}: {one.problem}"
            continue
        saved = local_text(one.saved_s, "seconds")
        yield f"{one.name}: {one.time_ns / 1e9:.3f} s, step {one.step}, saved {saved}, {one.size_bytes / 1e6:.2f} MB"
        for process, why in one.left_out.items():
            yield f"  without {process}: {why}"
