"""Masks secrets in the text of a configuration, so that it can be shown to others.

The values of shmio's own keys are paths of files with secrets, or hashes of secrets. The value of a
key of another package's connector may be the secret itself. Therefore, whether a value is masked
depends on the name of its key. Secrets are also masked in the values of other keys: in URLs, after
options of commands such as ``--password``, after ``Bearer``, and in texts that look like a well-known
kind of token. In doubt, a value is masked.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Final

from shmio.config.toml_tokens import TOKEN

MASK: Final = "•••"
_WORDS: Final = frozenset({"pass", "pw", "pin", "auth"})
_PARTS: Final = re.compile(
    r"password|passwd|passphrase|passcode|pwd|secret|token|credential|authorization|bearer|sha256|psk"
)
_WHOLE: Final = frozenset({"webhook"})
"""Whole names of keys whose values may be secret; longer names that contain them are not meant.

The URL of a webhook often contains a secret.
"""
_NO_SECRETS: Final = frozenset({"tokens_in_plain_text"})
_PATH_SUFFIXES: Final = ("_file", "_path", "_dir")
_KEY_FILES: Final = re.compile(r"""["']?[^"']*\.(?:pem|key|der|crt|p8)["']?""", re.IGNORECASE)
"""Matches the path of a key file, which is not masked if it is the value of the key ``key``."""
_WORD: Final = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+")
_USER: Final = re.compile(r"(?<=://)[^\s/\"']*(?=@)")
_LOGIN: Final = re.compile(r"(?<![\w.+:/-])[\w.+-]{1,256}+:[^\s/\"'@]{1,256}+(?=@)")
"""Matches a name with a password before a host, without the scheme of a URL."""
_SHAPES: Final = re.compile(
    r"(?<![A-Za-z0-9_-])(?:gh[oprsu]_[A-Za-z0-9]{16,}|github_pat_\w{16,}|glpat-[\w-]{16,}|xox[a-z]-[\w-]{10,}"
    r"|sk-[\w-]{16,}|A[KS]IA[0-9A-Z]{16}|eyJ[\w-]{8,}\.[\w-]{8,}(?:\.[\w-]*)?)"
)
"""Matches tokens of GitHub, GitLab, Slack and other services, and JSON web tokens."""
_WEB_URL: Final = re.compile(r"(?<![A-Za-z])(?:https?|wss?)://[^\s\"']+", re.IGNORECASE)
_URL_PARTS: Final = re.compile(r"(?<=/)[^/?#]+")
_UUID: Final = re.compile(r"[0-9a-f]{8}(?:-[0-9a-f]{4}){3}-[0-9a-f]{12}", re.IGNORECASE)
_RUN: Final = re.compile(r"[A-Za-z0-9]{16,}")
_OPTION: Final = re.compile(r"(?<![\w-])--?([A-Za-z][\w-]*)\s+(?=[^\s-])")
_WHOLE_OPTION: Final = re.compile(r"--?([A-Za-z][\w-]*)")
_SCHEME: Final = re.compile(r"(?<![\w-])(?:Bearer|Basic)\s+(?=[\w.~+/=-]{8})", re.IGNORECASE)
_ASSIGNED: Final = re.compile(r"(?<![A-Za-z0-9_-])([A-Za-z0-9_-]++)[\"']?\s*+(?:=(?!=)|:(?!//))\s*(?=\S)")
_EQUATED: Final = re.compile(r"(?<![A-Za-z0-9_-])([A-Za-z0-9_-]++)[\"']?\s*+=(?!=)\s*(?=\S)")
_MIN_QUOTED: Final = 4
"""Minimum number of characters that a secret must have to be masked wherever a message quotes it."""
_BEFORE_EQUALS: Final = re.compile(r"[ \t]*=")
_OWN_TABLES: Final = frozenset({("grpc", "token")})
"""Tables that are masked key by key, and not as a whole although their names suggest a secret."""


def is_secret(key: str) -> bool:
    """Return whether the value of a key with this name may be a secret.

    The name does not include the table. The result is True for the name ``key``, although the value
    may be the path of a key file; the caller may then check the value.
    """
    folded = key.lower()
    if folded in _NO_SECRETS or folded.replace("-", "_").endswith(_PATH_SUFFIXES):
        return False
    joined = re.sub(r"[^a-z0-9]", "", folded)
    words = {word.lower() for word in _WORD.findall(key)}
    return bool(folded in _WHOLE or _PARTS.search(joined) or words & _WORDS or joined.endswith("key"))


def mask_value(key: str, value: Any) -> Any:
    """Return a value of a parsed configuration with its secrets masked.

    Args:
        key: Name of the value's key.
        value: The value: a text, a number, a list or a table.

    """
    if value is None or isinstance(value, bool):
        return value
    if isinstance(value, dict):
        if is_secret(key):
            return MASK if value else value
        return {name: mask_value(name, item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        items = list(value)
        return [
            MASK if isinstance(item, str) and is_secret_option(before) else mask_value(key, item)
            for item, before in zip(items, ("", *items), strict=False)
        ]
    if is_secret(key) and not _is_key_file(key, str(value)):
        return MASK
    return mask_line(value) if isinstance(value, str) else value


def mask_line(line: str, assigned: re.Pattern[str] = _ASSIGNED) -> str:
    """Return a line with its secrets masked: parts of URLs, tokens, and what follows a secret key or option.

    Args:
        line: The line.
        assigned: Matches a key and the sign that separates it from its value.

    """
    line = _SHAPES.sub(MASK, _LOGIN.sub(MASK, _USER.sub(MASK, line)))
    line = _WEB_URL.sub(lambda url: _URL_PARTS.sub(_mask_url_part, url[0]), line)
    for pattern in (assigned, _OPTION):
        for match in pattern.finditer(line):
            if is_secret(match[1]) and not _is_key_file(match[1], line[match.end() :].strip()):
                line = line[: match.end()] + MASK
                break
    if (scheme := _SCHEME.search(line)) is not None:
        line = line[: scheme.end()] + MASK
    return line


def _mask_url_part(part: re.Match[str]) -> str:
    """Mask a part of a URL's path that has a UUID, or at least 16 letters and digits in a row, as in webhooks."""
    runs = _RUN.findall(part[0])
    if _UUID.search(part[0]) or any(not run.isalpha() and not run.isdigit() for run in runs):
        return MASK
    return part[0]


def is_secret_option(item: Any) -> bool:
    """Return whether an item of a list is an option, such as ``--password``, so that the next item is a secret."""
    match = _WHOLE_OPTION.fullmatch(item) if isinstance(item, str) else None
    return match is not None and is_secret(match[1])


@dataclass(frozen=True)
class Masked:
    """The text of a configuration without its secrets."""

    text: str
    """The text, with as many lines as the original."""
    _secrets: list[str] = field(default_factory=list)

    def hide(self, message: str) -> str:
        """Return a message in which secrets of the original text are masked."""
        for secret in self._secrets:
            message = message.replace(secret, MASK)
        return mask_line(message, _EQUATED)  # in messages, a colon follows the faulty key


def mask(text: str) -> Masked:
    """Mask the secrets in the text of a TOML file, which may have faults.

    In comments, what follows a secret key and ``=`` or ``:`` is masked, as in ``# password = …``.
    """
    masker = _Masker(text)
    parts: list[str] = []
    end = 0
    for begin, stop, shown in masker.replaced():
        parts += (text[end:begin], shown)
        end = stop
    lines = {line.strip() for secret in masker.secrets for line in secret.split("\n")}
    quoted = sorted((line for line in lines if len(line) >= _MIN_QUOTED), key=len, reverse=True)
    return Masked("".join([*parts, text[end:]]), [line for line in quoted if line not in ("true", "false")])


class _Masker:
    """Finds the secrets among the tokens of a TOML text."""

    def __init__(self, text: str) -> None:
        self._text = text
        self._parts: list[str] = []
        """The parts of the key that is being read."""
        self._depth = 0
        """Depth of brackets in a value."""
        self._hidden: int | None = None
        """Depth of brackets at which the current secret value began; None outside secret values."""
        self._awaited = False
        """True between a secret key and its value. The value may be in the next line, although TOML forbids that."""
        self._plain_key = False
        """True if the current value belongs to a key with the name ``key``; its value is shown if it is a path."""
        self._table_hidden = False
        self._header = False
        self._start = True
        self._option = False
        """True after an option of a command, such as ``"--password"``, in a list. The secret follows it."""
        self.secrets: set[str] = set()
        """The secret values found so far."""

    def replaced(self) -> Iterable[tuple[int, int, str]]:
        """Yield the start, the end and the replacement of each part of the text to mask."""
        for match in TOKEN.finditer(self._text):
            piece = match[0]
            if piece == "\n":
                self._end_line()
            elif piece[0] == "#":
                if (shown := mask_line(piece)) != piece:
                    yield match.start(), match.end(), shown
            elif self._option and self._depth and piece[0] in "\"'":
                self._option = False
                self.secrets.add(piece.strip("\"'"))
                yield match.start(), match.end(), self._covered(piece)
            elif self._hidden is not None and self._is_value(match) and not self._shows_path(piece):
                self.secrets.add(piece.strip("\"'"))
                self._awaited = False
                yield match.start(), match.end(), self._covered(piece)
            else:
                if (shown := _mask_lines(piece)) != piece:
                    yield match.start(), match.end(), shown
                self._follow(piece)

    def _end_line(self) -> None:
        self._parts = []
        self._header = False
        if self._depth == 0:
            self._hidden = self._hidden if self._awaited else None
            self._start = True

    def _follow(self, piece: str) -> None:
        first = piece[0]
        self._option = (self._option and first == ",") or (self._depth > 0 and is_secret_option(piece.strip("\"'")))
        if self._start and first == "[":
            self._header, self._start, self._parts = True, False, []
            self._hidden, self._awaited = None, False
        elif self._header and first == "]":
            self._table_hidden = tuple(self._parts) not in _OWN_TABLES and any(map(is_secret, self._parts))
            self._header, self._parts = False, []
        elif first == "=":
            self._begin_value()
        elif first in "[{":
            self._awaited = False
            self._depth += len(piece)
            self._parts = []
        elif first in "]}":
            self._depth = max(self._depth - len(piece), 0)
            self._parts = []
            if self._hidden is not None and self._depth < self._hidden:
                self._hidden = None
        elif first == ",":
            self._parts = []
            if self._hidden == self._depth:
                self._hidden = None
        elif first != ".":
            self._parts.append(piece.strip("\"'"))
            if self._start and piece.endswith(":") and is_secret(piece[:-1]):  # a colon by mistake for =
                self._hidden, self._awaited = self._depth, True
        self._start = False

    def _begin_value(self) -> None:
        if self._hidden is None and (self._table_hidden or any(map(is_secret, self._parts))):
            self._hidden, self._awaited = self._depth, True
            self._plain_key = not self._table_hidden and self._parts[-1:] == ["key"]
        self._parts = []

    def _is_value(self, match: re.Match[str]) -> bool:
        """Return whether a token is neither a bracket nor the key of an inline table."""
        return match[0][0] not in "[]{}=,." and _BEFORE_EQUALS.match(self._text, match.end()) is None

    def _shows_path(self, piece: str) -> bool:
        return self._plain_key and piece[0] in "\"'" and _KEY_FILES.fullmatch(piece) is not None

    @staticmethod
    def _covered(piece: str) -> str:
        """Return the replacement of a secret, which has as many lines as the secret."""
        lines = "\n" * piece.count("\n")
        return f'"{MASK}"{lines}' if piece[0] in "\"'" else MASK


def _mask_lines(piece: str) -> str:
    return "\n".join(map(mask_line, piece.split("\n")))


def _is_key_file(key: str, value: str) -> bool:
    return key.lower() == "key" and _KEY_FILES.fullmatch(value) is not None
