"""The reference of the ``.proto`` files: services, messages and enumerations, with the comments of the files."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

TITLES: Final = {
    "shmio_v1": "shmio.v1",
    "simlog_v1": "SimlogAPI v1",
    "simlog_v2": "SimlogAPI v2",
    "simserver": "SimServerAPI",
}
"""The files that the page of the wire describes."""
_OPEN: Final = re.compile(r"^(service|message|enum|oneof) (\w+) \{")
_RPC: Final = re.compile(r"^rpc (\w+)\s*\((stream )?([\w.]+)\)\s*returns\s*\((stream )?([\w.]+)\)")
_FIELD: Final = re.compile(r"^((?:repeated |optional )?(?:map<[^>]+>|[\w.]+)) (\w+) = (\d+)")
_VALUE: Final = re.compile(r"^(\w+) = (-?\d+);")


class Row(NamedTuple):
    """A call, field or value, with its comment."""

    cells: tuple[str, ...]
    comment: str


class Block(NamedTuple):
    """A service, message or enumeration, with its comment."""

    kind: str
    name: str
    comment: str
    rows: list[Row]


HEADINGS: Final = {
    "service": ("call", "request", "response"),
    "message": ("number", "field", "type"),
    "enum": ("number", "value"),
}


def pages(folder: Path) -> dict[str, tuple[str, str]]:
    """Return title and text of a page for each file, by its path."""
    return {
        f"reference/generated/proto-{stem}.md": (title, _page(folder / f"{stem}.proto", title))
        for stem, title in TITLES.items()
    }


def _page(file: Path, title: str) -> str:
    text = file.read_text()
    package = re.search(r"^package (\S+);", text, re.MULTILINE)
    if package is None:
        raise ValueError(f"{file} has no package")
    parts = [f"# Messages of {title}\n\nPackage `{package[1]}`, file `proto/{file.name}`.\n"]
    for block in _blocks(text):
        parts.append(f"## {block.kind} {block.name}\n\n{block.comment}\n")
        if block.rows:
            headings = HEADINGS[block.kind]
            parts.append("| " + " | ".join(headings) + " | |\n|" + "---|" * (len(headings) + 1))
            parts += ["| " + " | ".join((*row.cells, row.comment.replace("|", "\\|"))) + " |" for row in block.rows]
            parts.append("")
    return "\n".join(parts)


def _blocks(text: str) -> Iterator[Block]:
    """Yield the blocks of a file; those within another one have its name before theirs."""
    open_blocks: list[Block] = []
    choice, comment = "", list[str]()
    for line in map(str.strip, text.split("\n")):
        if line.startswith("//"):
            comment.append(line.removeprefix("//").strip())
            continue
        code, _, behind = (part.strip() for part in line.partition("//"))
        said = " ".join([*comment, behind] if behind else comment)
        if opened := _OPEN.match(code):
            if opened[1] == "oneof":
                choice = opened[2]
            else:
                outer = f"{open_blocks[-1].name}." if open_blocks else ""
                open_blocks.append(Block(opened[1], outer + opened[2], said if "----" not in said else "", []))
        if open_blocks and (row := _row(open_blocks[-1].kind, code, said, choice)):
            open_blocks[-1].rows.append(row)
        if code.endswith("}"):
            if choice:
                choice = ""
            elif open_blocks:
                yield open_blocks.pop()
        comment = []


def _row(kind: str, code: str, comment: str, choice: str) -> Row | None:
    if kind == "service" and (call := _RPC.match(code)):
        asked, answer = f"{call[2] or ''}{call[3]}", f"{call[4] or ''}{call[5]}"
        return Row((f"`{call[1]}`", f"`{asked}`", f"`{answer}`"), comment)
    if kind == "message" and (field := _FIELD.match(code)):
        said = f"one of *{choice}*. {comment}" if choice else comment
        return Row((field[3], f"`{field[2]}`", f"`{field[1]}`"), said)
    if kind == "enum" and (value := _VALUE.match(code)):
        return Row((value[2], f"`{value[1]}`"), comment)
    return None
