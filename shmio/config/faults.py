"""Collects the faults of a configuration file, up to a limit, as messages with line numbers."""

from __future__ import annotations

import math
import re
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from tomllib import TOMLDecodeError
from types import UnionType
from typing import Annotated, Any, Final, Literal, Union, get_args, get_origin

from msgspec import Struct, ValidationError
from msgspec.structs import fields

from shmio.config.model import NAME_PATTERN, NAME_RULE
from shmio.config.toml_tokens import TOKEN
from shmio.errors import ConfigError, LayoutError
from shmio.wording import brief, unknown

_WITH_SECRETS: Final = frozenset({"account", "command"})
"""Keys whose values contain secrets if they are written as in other programs, such as ``name:password``."""
_FILE_SUFFIX: Final = re.compile(r"_(?:file|path|dir)$")
MAX_KEY: Final = 1_000
"""Maximum number of characters of a key, with all its dotted parts."""
MAX_PARTS: Final = 64
"""Maximum number of dotted parts of a key, because the parser's time grows with their square."""
MAX_LINE: Final = 80

MAX_SHOWN: Final = 1_000
MAX_CHARACTERS: Final = 500
"""Maximum number of characters of a message.

Without this limit, a message could quote a text as long as the whole file.
"""
_KEY: Final = re.compile(r"[A-Za-z0-9_-]+(?:\[[0-9]+\]|\.[A-Za-z0-9_-]+)*(?=[:\s])")
_PLACE: Final = re.compile(r"\b(source|emulator|injection|expect|alert)\[([0-9]+)\]")
_SOURCE: Final = re.compile(r"source\[([0-9]+)\]")
_QUOTES: Final = "'"
_DOUBLE: Final = ("Cannot overwrite", "Cannot declare", "Duplicate inline table key")
_ESCAPE: Final = ("Unescaped", "Invalid hex", "Escaped character", "Illegal character")
_POSITION: Final = re.compile(r"\(at line (\d+), column (\d+)\)\Z")
_IN_TOML: Final = re.compile(r"\(at line (\d{1,9}), column \d+\)")
_NUMBERED: Final = re.compile(r"(\d{1,9}): ")
_BARE: Final = re.compile(r"[^\s,=#\[\]{}\"']+")
_TEXT: Final = re.compile(r"[^\W\d].*|.*[:/].*|\d+(?:\.\d+){2,}")  # a name, a path or an address
_TYPES: Final = {
    "int": "a whole number",
    "float": "a number",
    "str": "text",
    "bool": "true or false",
    "array": "a list in [ ]",
    "object": "a table",
}


def too_long(text: str, most: int = MAX_KEY) -> int:
    """Return the line of the first key with more than ``most`` characters, or too many parts; 0 if there is none."""
    if all(len(line) <= most and line.count(".") < MAX_PARTS for line in text.split("\n")):
        return 0
    return Lines(text, most).too_long


class Lines:
    """The line of each key in a TOML text. Keys have the names that messages use, such as ``source[0].host``."""

    def __init__(self, text: str, most: int = MAX_KEY) -> None:
        self._most = most
        self._lines: dict[str, int] = {}
        self._counts: dict[str, int] = {}
        self.double: tuple[str, int, int] | None = None
        """The first key that is given twice, with both lines; None if there is none."""
        self.too_long = 0
        """The line of the first key that is too long; reading ends there. 0 if there is none."""
        self._read(text)

    def of(self, key: str) -> int:
        """Return the line of a key.

        If the text does not have the key, return the line of the innermost table around it that the
        text has; 0 if there is none.
        """
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
        for match in TOKEN.finditer(text):
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
        """Return the full name of a key in ``table``, with the index of the latest table where a name repeats.

        ``last`` is a further part of the name, which gets no index.
        """
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


def but_found(key: str, value: Any) -> str:
    """Return ``, found VALUE`` for the end of a message about a value; empty if the value may be a secret.

    The value is wrong, so it may be a secret where the name of a file with the secret, or a table, is expected.
    """
    from shmio.config.masking import is_secret, mask_value  # noqa: PLC0415  compiles many patterns, for messages only

    names = re.findall(r"[A-Za-z0-9_-]+", re.sub(r"^grpc\.token\[\d+\]\.|\[[^\]]*\]", "", key))
    if any(name in _WITH_SECRETS or is_secret(_FILE_SUFFIX.sub("", name)) for name in names):
        return ""
    return f", found {str(value).lower() if isinstance(value, bool) else brief(mask_value('', value))}"


def _inner(value: Any, path: str) -> Any:
    """Return the value at a path of msgspec within another, such as ``.name[2]``; None if the path is not exact."""
    for name, index in re.findall(r"\.([^.\[]+)|\[([^\]]*)\]", path):
        if name and isinstance(value, dict):
            value = value.get(name)
        elif index.isdigit() and isinstance(value, list | tuple) and int(index) < len(value):
            value = value[int(index)]
        else:
            return None
    return value


def explain(error: ValidationError, key: str, kind: Any, value: Any) -> str:
    """Return an error of msgspec as a message ``key: what is wrong``, with the wrong value.

    Args:
        error: The error.
        key: The key of the value that msgspec could not convert; empty for a whole file or table.
        kind: The type to which the value should have been converted.
        value: That value.

    """
    text, _, at = str(error).partition(" - at `$")
    path = f"{key}{at.rstrip('`')}".lstrip(".")
    missing = re.search(r"missing required field `([^`]*)`", text)
    if missing:
        return f"{path}.{missing[1]}: this key is needed".lstrip(".")
    if repr(NAME_PATTERN) in text:
        text = f"expected a name: {NAME_RULE}"
    elif word := re.fullmatch(r"Invalid enum value '(.*)'", text):
        name = path.rpartition(".")[2].partition("[")[0]
        text = unknown(name, word[1], _words(kind, at.rstrip("`")))
    elif field := re.search(r"unknown field `([^`]*)`", text):
        text = f"unknown key {field[1]!r}"
        if not at and isinstance(kind, type) and issubclass(kind, Struct):
            text = unknown("key", field[1], (one.encode_name for one in fields(kind)))
    elif text.endswith("of length >= 1"):
        text = "must not be empty"
    text = re.sub(r"`([a-z]+(?: \| [a-z]+)*)`", _types, text)
    text = text[:1].lower() + text[1:]
    wrong = _inner(value, at.rstrip("`")) if text.startswith("expected ") else None
    if wrong is not None and (shown := but_found(path, wrong)):
        text = text.partition(", got ")[0] + shown
    return f"{path}: {text}" if path else text


def _words(kind: Any, at: str) -> Iterator[str]:
    """Yield the words that a type allows at a place in its values, such as ``.name[...]``."""
    origin, parts = get_origin(kind), get_args(kind)
    if origin is Literal and not at:
        yield from map(str, parts)
    elif origin in (Union, UnionType):
        for one in parts:
            yield from _words(one, at)
    elif origin is Annotated:
        yield from _words(parts[0], at)
    elif origin in (list, dict) and at.startswith("["):
        yield from _words(parts[-1], at.partition("]")[2])
    elif isinstance(kind, type) and issubclass(kind, Struct) and at.startswith("."):
        name = re.split(r"[.[]", at[1:])[0]
        for field in fields(kind):
            if field.encode_name == name:
                yield from _words(field.type, at[1 + len(name) :])


def _types(match: re.Match[str]) -> str:
    return " or ".join(_TYPES.get(name, name) for name in match[1].split(" | ") if name != "null")


def decode(data: bytes, place: str) -> str:
    """Decode the contents of a file, whose name in messages is ``place``.

    Raises:
        ConfigError: The contents are not UTF-8, or have zero bytes.

    """
    try:
        text = data.decode("utf-8-sig")  # some editors write a byte order mark
    except UnicodeDecodeError as error:
        utf16 = ", but UTF-16" if data.startswith((BOM_UTF16_LE, BOM_UTF16_BE)) else f" at byte {error.start}"
        raise ConfigError(f"{place}: the file is not UTF-8{utf16}; save it as UTF-8") from None
    if "\0" in text:
        raise ConfigError(f"{place}: the file contains zero bytes, as UTF-16 does; save it as UTF-8")
    return text


def explain_toml(error: Exception, text: str) -> str:
    """Return the TOML parser's message, the text of the faulty line and, for frequent mistakes, the remedy."""
    if isinstance(error, ValueError) and not isinstance(error, TOMLDecodeError):  # int() refuses so many digits
        return "a number has too many digits"
    if isinstance(error, RecursionError):
        return "tables and lists are nested too deeply"
    place = _POSITION.search(str(error))
    if place is None:
        return str(error)
    lines = text.replace("\r\n", "\n").split("\n")
    line, column = lines[int(place[1]) - 1], int(place[2]) - 1
    from shmio.config.masking import mask_line  # noqa: PLC0415  compiles many patterns, for this message only

    if (masked := mask_line(line)) != line:
        return f"{error}: {masked.strip()[:MAX_LINE]}"
    shown = line.strip()[:MAX_LINE]
    double = Lines(text).double
    if double and str(error).startswith(_DOUBLE):
        key, first, second = double
        return f"{error}: {key[:MAX_LINE]} is given twice, in lines {first} and {second}; remove one of them"
    return f"{error}: {shown}{_slip(str(error), line, column)}" if shown else str(error)


def _slip(message: str, line: str, column: int) -> str:
    if message.startswith("Illegal character '\\n'"):
        return "; the closing quote is missing"
    if "\\" in line and message.startswith(_ESCAPE):
        return "; in double quotes a backslash has a special meaning, so write a path in single quotes, 'C:\\cell.db'"
    word = next((word[0] for word in _BARE.finditer(line) if word.start() <= column < word.end()), "").strip("“”")
    if message.startswith("Expected '='") or not _TEXT.fullmatch(word):
        return ""
    if word.lower() in ("true", "false"):
        return f"; write {word.lower()}"
    return f'; write text in quotes: "{word[:MAX_LINE]}"'


def named(message: str, tables: Mapping[str, Any]) -> str:
    """Add to a message the name of the source, emulator, injection, expectation or alert whose number it has."""
    key = re.match(r"(source|emulator|injection|expect|alert)\[(\d+)\](?!\.name:)", message)
    if key is None:
        return message
    try:
        name = tables[key[1]][int(key[2])]["name"]
    except (LookupError, TypeError):
        return message
    suffix = f' ({key[1]} "{name}")'
    return message + suffix if isinstance(name, str) and not message.endswith(suffix) else message


def locate(message: str, file: str, lines: Lines) -> tuple[int, str]:
    """Return the number of the line of ``file`` that a message is about, and the message without the file's name.

    The number is 0 if the message is about the whole file. If the message is about another file,
    return 0 and the unchanged message.

    Args:
        message: A message of :class:`Faults`.
        file: Path of the file, as in the message.
        lines: The lines of the file's keys.

    """
    if not message.startswith(f"{file}:"):
        return 0, message
    text = message.removeprefix(f"{file}:").strip()
    if numbered := _NUMBERED.match(text):
        return int(numbered[1]), text[numbered.end() :]
    if place := _IN_TOML.search(text):
        return int(place[1]), text
    key = _KEY.match(text.removeprefix("warning: "))
    return lines.of(key[0]) if key else 0, text


class Faults:
    """Collects the faults of one file as messages with the file, the line and the faulty key."""

    def __init__(self, file: Path, tables: Mapping[str, Any], text: str = "") -> None:
        self._file = file
        self._tables = tables
        self._text = text
        self._found: dict[str, float] = {}
        self._elsewhere: dict[str, str] = {}
        self._warnings: list[str] = []
        self._layout: LayoutError | None = None
        self._sources: float = math.inf
        """Number of sources that the file has; the others are those of a recording."""
        self.count = 0
        self.places: Mapping[str, Sequence[int]] = {}
        """For each kind of section, the indices in the file of the sections that passed the first check.

        The later checks number only these sections; :meth:`add` replaces their numbers by these indices.
        """

    @cached_property
    def _lines(self) -> Lines:
        return Lines(self._text)

    def __bool__(self) -> bool:
        return self.count > 0

    @property
    def full(self) -> bool:
        """True if further faults will only be counted; callers can then skip expensive checks."""
        return self.count >= MAX_SHOWN

    def add(self, message: str) -> None:
        """Add a fault with the message ``key: what is wrong``."""
        if self.full:
            self.count += 1
            return
        where, text, line = self._located(named(_PLACE.sub(self._place, message), self._tables))
        self._note(f"{where}: {text}", line)

    def located(self, message: str) -> str:
        """Return a message ``key: what is wrong`` with the file, the line and the name of the section."""
        where, text, _ = self._located(named(message, self._tables))
        return f"{where}: {text}"

    def _located(self, message: str) -> tuple[str, str, int]:
        """Return the file with the line of the key that a message begins with, the message, and its line in this file.

        The line is 0 if the message is about the whole file.
        """
        text = _shortened(message)
        key = _KEY.match(text)
        source = _SOURCE.match(text)
        line = self._lines.of(key[0]) if key and not (source and int(source[1]) >= self._sources) else 0
        own = text.partition(":")[0]
        if own in self._elsewhere:
            table, _, _ = own.partition(".")
            return self._elsewhere[own], text.removeprefix(f"{table}."), line
        return f"{self._file}{f':{line}' if line else ''}", text, line

    def lies_in(self, file: str, table: str, lines: Mapping[str, int]) -> None:
        """Remember that some keys of a table come from another file, so that messages name that file.

        Args:
            file: The other file, relative to the folder of the configuration.
            table: The table that has the keys.
            lines: The line of each of these keys in ``file``.

        """
        for name, line in lines.items():
            self._elsewhere[f"{table}.{name}"] = f"{self._file.parent / file}:{line}"

    def play(self, sources: Sequence[str]) -> None:
        """Expect messages about the sources of a recording, which take the place of those of the file.

        Args:
            sources: The names of the recording's sources, as later messages number them.

        """
        own = [str(table.get("name")) for table in self._tables.get("source", ())]
        self._sources = len(own)
        order = [*own, *(name for name in sources if name not in own)]
        self._tables = {**self._tables, "source": [{"name": name} for name in order]}
        self.places = {"source": [order.index(name) for name in sources]}

    def _note(self, message: str, line: float) -> None:
        """Record a fault at this line of the file, unless it is already recorded."""
        if message not in self._found:
            self._found[message] = line
            self.count += 1

    def include(self, other: Faults) -> None:
        """Add the faults and warnings of another file; they are shown after those of this file."""
        for message in sorted(other._found, key=other._found.__getitem__):
            self._note(message, math.inf)
        self._warnings += other._warnings

    def warn(self, message: str) -> None:
        """Add a warning with the message ``key: what is unusual``; it is shown after the faults."""
        self._warnings.append(self.warning(message))

    def warning(self, message: str) -> str:
        """Return a warning with its file and line; ``message`` is ``key: what is unusual``."""
        where, text, _ = self._located(_PLACE.sub(self._place, message))
        return f"{where}: warning: {text}"

    def _place(self, match: re.Match[str]) -> str:
        places, index = self.places.get(match[1], ()), int(match[2])
        return f"{match[1]}[{places[index] if index < len(places) else index}]"

    @contextmanager
    def catching(self) -> Iterator[None]:
        """Return a context manager that adds a ConfigError or LayoutError from its ``with`` block as a fault."""
        try:
            yield
        except ConfigError as error:
            self.add(str(error))
        except LayoutError as error:
            self._layout = error
            for line in str(error).splitlines():
                self._note(line, math.inf)  # a fault of another file is shown after those of this file

    def raise_any(self) -> None:
        """Raise the collected faults, if there are any.

        Raises:
            ConfigError: There are faults; the message has a line for each fault and warning.
            LayoutError: All faults come from one layout.

        """
        if not self.count:
            return
        if self._layout is not None and not self._warnings and [*self._found] == str(self._layout).splitlines():
            raise self._layout
        more = self.count - MAX_SHOWN
        ordered = sorted(self._found, key=self._found.__getitem__)
        rest = [f"{self._file}: there are {more} more faults"] if more > 0 else []
        raise ConfigError("\n".join([*ordered, *rest, *self._warnings]))


def _shortened(message: str) -> str:
    """Return a message, with its middle cut out if it is too long."""
    if len(message) <= MAX_CHARACTERS:
        return message
    return f"{message[: MAX_CHARACTERS // 2]} … {message[-MAX_CHARACTERS // 2 :]}"
