"""Reword errors of msgspec and tomllib for the configuration's author."""

from __future__ import annotations

import difflib
import re
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Iterable, Mapping
from tomllib import TOMLDecodeError
from typing import Any, get_args

from msgspec import ValidationError

from shmio.config.lines import Lines
from shmio.config.model import (
    NAME_PATTERN,
    NAME_RULE,
    BrokerName,
    ClockName,
    DistributionName,
    OperationName,
    PayloadName,
    ReplayedInjections,
)
from shmio.errors import ConfigError

MAX_LINE = 80
MAX_HINTED = 100
"""Longest word, in characters, for which a similar one is suggested."""
_QUOTES = "'"
_DOUBLE = ("Cannot overwrite", "Cannot declare", "Duplicate inline table key")
_ESCAPE = ("Unescaped", "Invalid hex", "Escaped character", "Illegal character")
_PLACE = re.compile(r"\(at line (\d+), column (\d+)\)\Z")
_BARE = re.compile(r"[^\s,=#\[\]{}\"']+")
_TEXT = re.compile(r"[^\W\d].*|.*[:/].*|\d+(?:\.\d+){2,}")  # a name, a path, an address
_WORDS = {
    "broker": BrokerName,
    "clock": ClockName,
    "distribution": DistributionName,
    "injections": ReplayedInjections,
    "operation": OperationName,
    "payload": PayloadName,
}
"""Keys whose value is one of a few words."""
_TYPES = {
    "int": "a whole number",
    "float": "a number",
    "str": "text",
    "bool": "true or false",
    "array": "a list in [ ]",
    "object": "a table",
}


def explain(error: ValidationError, key: str = "") -> str:
    """Return ``key: what is wrong``; ``key`` is needed if the converted value is no whole table."""
    text, _, at = str(error).partition(" - at `$")
    path = f"{key}{at.rstrip('`')}".lstrip(".")
    missing = re.search(r"missing required field `([^`]*)`", text)
    if missing:
        return f"{path}.{missing[1]}: this key is needed".lstrip(".")
    if repr(NAME_PATTERN) in text:
        text = f"expected a name: {NAME_RULE}"
    elif unknown := re.fullmatch(r"Invalid enum value ('.*')", text):
        words = get_args(_WORDS[path.rpartition(".")[2]])
        text = f"{unknown[1]} is unknown; valid: {', '.join(words)}{meant(unknown[1].strip(_QUOTES), words)}"
    elif text.endswith("of length >= 1"):
        text = "must not be empty"
    text = re.sub(r"`([a-z]+(?: \| [a-z]+)*)`", _types, text)
    text = text[:1].lower() + text[1:]
    return f"{path}: {text}" if path else text


def decode(data: bytes, place: str) -> str:
    """Return the text of a file; ``place`` names it. ConfigError unless it is UTF-8."""
    try:
        text = data.decode("utf-8-sig")  # some editors write a byte order mark
    except UnicodeDecodeError as error:
        utf16 = ", but UTF-16" if data.startswith((BOM_UTF16_LE, BOM_UTF16_BE)) else f" at byte {error.start}"
        raise ConfigError(f"{place}: not UTF-8{utf16}; save the file as UTF-8") from None
    if "\0" in text:
        raise ConfigError(f"{place}: zero bytes, as in UTF-16; save the file as UTF-8")
    return text


def near(word: str, names: Iterable[str]) -> list[str]:
    """Return a list with the most similar name, regardless of case, or an empty list."""
    folded = {name.lower(): name for name in names}
    found = difflib.get_close_matches(word.lower(), folded, 1) if len(word) <= MAX_HINTED else []
    return [folded[found[0]]] if found else []


def meant(word: str, names: Iterable[str]) -> str:
    """Return the suggestion to append to a message about an unknown word."""
    return "".join(f"; did you mean {name}?" for name in near(word, names))


def _types(match: re.Match[str]) -> str:
    return " or ".join(_TYPES.get(name, name) for name in match[1].split(" | ") if name != "null")


def explain_toml(error: Exception, text: str) -> str:
    """Return the parser's message with the line and, for frequent slips, the correction."""
    if isinstance(error, ValueError) and not isinstance(error, TOMLDecodeError):  # int() takes no more of them
        return "a number in it has too many digits"
    place = _PLACE.search(str(error))
    if place is None:
        return str(error)
    lines = text.replace("\r\n", "\n").split("\n")
    line, column = lines[int(place[1]) - 1], int(place[2]) - 1
    shown = line.strip()[:MAX_LINE]
    double = Lines(text).double
    if double and str(error).startswith(_DOUBLE):
        key, first, second = double
        return f"{error}: {key[:MAX_LINE]} is given twice, in lines {first} and {second}; keep one of them"
    return f"{error}: {shown}{_slip(str(error), line, column)}" if shown else str(error)


def _slip(message: str, line: str, column: int) -> str:
    if message.startswith("Illegal character '\\n'"):
        return "; a quote is missing at its end"
    if "\\" in line and message.startswith(_ESCAPE):
        return "; in double quotes a backslash has a special meaning: write a path in single quotes, 'C:\\cell.db'"
    word = next((word[0] for word in _BARE.finditer(line) if word.start() <= column < word.end()), "").strip("“”")
    if message.startswith("Expected '='") or not _TEXT.fullmatch(word):
        return ""
    if word.lower() in ("true", "false"):
        return f"; write {word.lower()}"
    return f'; text is written in quotes: "{word[:MAX_LINE]}"'


def named(message: str, tables: Mapping[str, Any]) -> str:
    """Append the name of the source, emulator or injection that a message's key gives by number."""
    key = re.match(r"(source|emulator|injection)\[(\d+)\](?!\.name:)", message)
    if key is None:
        return message
    try:
        name = tables[key[1]][int(key[2])]["name"]
    except (LookupError, TypeError):
        return message
    return f'{message} ({key[1]} "{name}")' if isinstance(name, str) else message
