"""An answer made short enough for its client."""

from __future__ import annotations

from typing import Final

import msgspec

LINE_CHARS: Final = 2000
_MORE: Final = {
    "warnings": "… and {} more warnings: shmio-supervisor check prints them",
    "done": "… and {} more: shmio-supervisor logs supervisor -n 500 has them",
    "problems": "… and {} more: shmio-supervisor logs supervisor -n 500 has them",
}
"""What stands for the lines left out, by their key; the first are left out first.

``kept`` is not among them: 200 processes at most, with names of at most 40 characters, always have room.
"""


def cut(line: str) -> str:
    """A line of at most ``LINE_CHARS`` characters."""
    return line if len(line) <= LINE_CHARS else line[: LINE_CHARS - 1] + "…"


def cut_lines(text: str, most_chars: int) -> str:
    """A text of several lines with each of them cut, and the last ones left out and counted if there are too many."""
    lines = text.split("\n")
    kept: list[str] = []
    for line in map(cut, lines):
        most_chars -= len(line) + 1
        if most_chars < 0:
            return "\n".join([*kept, f"{len(lines) - len(kept)} more lines"])
        kept.append(line)
    return "\n".join(kept)


def shorten(answer: dict[str, object], most_bytes: int) -> dict[str, object]:
    """The answer with its lines cut, and the last ones of each kind left out and counted until it fits as JSON."""
    short = dict(answer)
    told = {key: [cut(line) for line in lines] for key in _MORE if isinstance(lines := answer.get(key), list)}
    short.update(told)
    for key, lines in told.items():
        excess = len(msgspec.json.encode(short)) - most_bytes
        if excess <= 0:
            break
        if lines:
            short[key] = _first(lines, excess, _MORE[key])
    return short


def _first(lines: list[str], excess: int, more: str) -> list[str]:
    """The first lines, ``excess`` bytes less of them, or none."""
    excess += len(msgspec.json.encode(more)) + 8  # the number, and a comma
    count = len(lines)
    while count and excess > 0:
        count -= 1
        excess -= len(msgspec.json.encode(lines[count])) + 1
    return [*lines[:count], more.format(len(lines) - count)]
