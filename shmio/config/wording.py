"""What msgspec and tomllib find wrong, in the words of the file's user."""

from __future__ import annotations

import re
from collections.abc import Mapping
from tomllib import TOMLDecodeError
from typing import Any, get_args

from msgspec import ValidationError

from shmio.config.model import (
    NAME_PATTERN,
    NAME_RULE,
    ClockName,
    DistributionName,
    OperationName,
    ReplayedInjections,
)
from shmio.config.mqttmodel import BrokerName, PayloadName

MAX_LINE = 80
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
"""Keys that take one of a few words."""
_TYPES = {
    "int": "a whole number",
    "float": "a number",
    "str": "text",
    "bool": "true or false",
    "array": "a list in [ ]",
    "object": "a table",
}


def explain(error: ValidationError, key: str = "") -> str:
    """``key: what is wrong``. ``key``: of what was converted, when it is not a whole table."""
    text, _, at = str(error).partition(" - at `$")
    path = f"{key}{at.rstrip('`')}".lstrip(".")
    missing = re.search(r"missing required field `([^`]*)`", text)
    if missing:
        return f"{path}.{missing[1]}: this key is needed".lstrip(".")
    if repr(NAME_PATTERN) in text:
        text = f"expected a name: {NAME_RULE}"
    elif unknown := re.fullmatch(r"Invalid enum value ('.*')", text):
        words = get_args(_WORDS[path.rpartition(".")[2]])
        text = f"{unknown[1]} is none; there are: {', '.join(words)}"
    elif text.endswith("of length >= 1"):
        text = "must not be empty"
    text = re.sub(r"`([a-z]+(?: \| [a-z]+)*)`", _types, text)
    text = text[:1].lower() + text[1:]
    return f"{path}: {text}" if path else text


def _types(match: re.Match[str]) -> str:
    return " or ".join(_TYPES.get(name, name) for name in match[1].split(" | ") if name != "null")


def explain_toml(error: Exception, text: str) -> str:
    """The parser's message, the line it is about, and what to write instead where that is a frequent slip."""
    if isinstance(error, ValueError) and not isinstance(error, TOMLDecodeError):  # int() takes no more of them
        return "a number in it has too many digits"
    place = _PLACE.search(str(error))
    if place is None:
        return str(error)
    lines = text.replace("\r\n", "\n").split("\n")
    line, column = lines[int(place[1]) - 1], int(place[2]) - 1
    shown = line.strip()[:MAX_LINE]
    return f"{error}: {shown}{_slip(str(error), line, column)}" if shown else str(error)


def _slip(message: str, line: str, column: int) -> str:
    if message.startswith("Illegal character '\\n'"):
        return "; a quote is missing at its end"
    word = next((word[0] for word in _BARE.finditer(line) if word.start() <= column < word.end()), "").strip("“”")
    if message.startswith("Expected '='") or not _TEXT.fullmatch(word):
        return ""
    if word.lower() in ("true", "false"):
        return f"; write {word.lower()}"
    return f'; text is written in quotes: "{word[:MAX_LINE]}"'


def named(message: str, tables: Mapping[str, Any]) -> str:
    """The message, with the name of the source, emulator or injection that its key tells by number."""
    key = re.match(r"(source|emulator|injection)\[(\d+)\](?!\.name:)", message)
    if key is None:
        return message
    try:
        name = tables[key[1]][int(key[2])]["name"]
    except (LookupError, TypeError):
        return message
    return f'{message} ({key[1]} "{name}")' if isinstance(name, str) else message
