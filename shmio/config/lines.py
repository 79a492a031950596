"""Find the line of each key of a TOML text, and keys that are too long for the parser."""

from __future__ import annotations

import re
from typing import Final

MAX_KEY: Final = 1_000
"""Maximum characters of a key, all dotted parts together."""
MAX_PARTS: Final = 64
"""Maximum dotted parts of a key: the parser's time grows with their square."""
_TOKEN: Final = re.compile(
    r"""\#[^\n]*|\"\"\"(?:\\.|[^\\])*?(?:\"{3,5}|\Z)|'''.*?(?:'{3,5}|\Z)|"(?:\\.|[^"\\\n])*"?|'[^'\n]*'?"""
    r"""|\[\[|\]\]|[\[\]{}=.,\n]|[^\s"'\#\[\]{}=.,]+""",
    re.DOTALL,
)
_OPENING, _CLOSING = frozenset(["[", "[[", "{"]), frozenset(["]", "]]", "}"])


def too_long(text: str, most: int = MAX_KEY) -> int:
    """Return the line of the first key with too many characters or parts, or 0."""
    if all(len(line) <= most and line.count(".") < MAX_PARTS for line in text.split("\n")):
        return 0
    return Lines(text, most).too_long


class Lines:
    """The line of each key by its name in messages, such as ``source[0].host``.

    One pass over the text finds all keys.
    """

    def __init__(self, text: str, most: int = MAX_KEY) -> None:
        self._most = most
        self._lines: dict[str, int] = {}
        self._counts: dict[str, int] = {}
        self.double: tuple[str, int, int] | None = None
        """The first duplicate key, and the lines of both occurrences."""
        self.too_long = 0
        """The line of the first key that is too long, where reading ends; 0 if there is none."""
        self._read(text)

    def of(self, key: str) -> int:
        """Return the line of a key, or of the innermost table around it that is found, or 0."""
        while key:
            if key in self._lines:
                return self._lines[key]
            key = key[: max(key.rfind("."), key.rfind("["), 0)]
        return 0

    def _read(self, text: str) -> None:
        line, counted, depth = 1, 0, 0
        table, start, header = "", True, ""
        parts: list[str] = []
        length = 0
        for match in _TOKEN.finditer(text):
            piece = match[0]
            if piece == "\n":
                start = start or depth <= 0
                parts, length = ([], 0) if depth <= 0 else (parts, length)
                depth = max(depth, 0)
                header = ""
                continue
            if piece.startswith("#"):
                continue
            first = piece[0]
            if start and depth == 0 and first == "[" and not parts:
                header, start = piece, False
                continue
            if (piece == "=" or (header and first == "]")) and (length > self._most or len(parts) > MAX_PARTS):
                self.too_long = line + text.count("\n", counted, match.start())
                return
            if piece == "=" or (header and first == "]"):
                if depth == 0 and parts and (start or header):
                    line += text.count("\n", counted, match.start())
                    counted = match.start()
                    if header:
                        table = self._table(parts, line, several=header == "[[")
                    else:
                        self._note(self._resolve(parts, table), line)
                header, start, parts, length = "", False, [], 0
            elif first in "[{":
                depth += len(piece)
                parts, length = [], 0
            elif first in "]}":
                depth = max(depth - len(piece), 0)
                parts, length = [], 0
            elif first == ",":
                parts, length = [], 0
            elif first != ".":
                if length <= self._most:
                    parts.append(_bare(piece))
                length += len(piece) + 1

    def _table(self, parts: list[str], line: int, *, several: bool) -> str:
        if several:
            name = self._resolve(parts[:-1], "", parts[-1])
            count = self._counts[name] = self._counts.get(name, 0) + 1
            table = f"{name}[{count - 1}]"
            self._lines.setdefault(name, line)
        else:
            table = self._resolve(parts, "")
        self._note(table, line)
        return table

    def _resolve(self, parts: list[str], table: str, last: str | None = None) -> str:
        """Return the key of these parts; of several tables with one name, the last one."""
        key = table
        for part in parts:
            key = f"{key}.{part}" if key else part
            if key in self._counts:
                key = f"{key}[{self._counts[key] - 1}]"
        if last is None:
            return key
        return f"{key}.{last}" if key else last

    def _note(self, key: str, line: int) -> None:
        first = self._lines.setdefault(key, line)
        if first != line and self.double is None:
            self.double = key, first, line


def _bare(token: str) -> str:
    if token[0] in "\"'":
        return token.strip(token[0])
    return token
