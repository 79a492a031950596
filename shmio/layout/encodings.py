"""The encodings of texts in files and registers, by the names that users give them.

In registers, every sequence of bytes is a text, and comes back from it.

A code page leaves bytes without a character, and multi-byte encodings have sequences that are none.
shmio reads such a byte as a stand-in, and writes the stand-in as that byte:

- a byte 80-9F of a single-byte encoding as U+0080-U+009F, as the Encoding Standard of WHATWG does for
  Windows-1252;
- any other byte 80-FF as U+F780-U+F7FF, as its encoding x-user-defined does;
- half a surrogate pair in UTF-16 as U+10F800-U+10FFFF.

Characters that a text really has in these ranges are read as stand-ins of each of their bytes.
"""

from __future__ import annotations

import codecs
import re
from abc import ABC, abstractmethod
from functools import lru_cache
from typing import Final

from shmio.wording import unknown

ISO_8859_1: Final = "iso-8859-1"
WINDOWS_1252: Final = "windows-1252"
"""The encoding of texts in Siemens' controllers, if the engineering tool ran on a Western Windows."""

_SINGLE: Final = {
    ISO_8859_1: "latin-1",
    **{f"iso-8859-{part}": f"iso8859-{part}" for part in (2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 13, 14, 15, 16)},
    **{f"windows-{page}": f"cp{page}" for page in (874, *range(1250, 1259))},
    **{f"cp{page}": f"cp{page}" for page in (437, 850, 852, 855, 866)},
    "koi8-r": "koi8-r",
}
_MULTI: Final = {
    "utf-8": "utf-8",
    "gbk": "gbk",
    "gb18030": "gb18030",
    "big5": "cp950",
    "shift-jis": "cp932",
    "cp949": "cp949",
}
_WIDER: Final = {"gb2312": "gbk", "big5": "big5", "euc_kr": "cp949", "shift_jis": "shift-jis", "cp950": "big5"}
"""Python's names of further encodings, with the name of the wider one that Windows uses in their place."""
NAMES: Final = tuple(dict.fromkeys((WINDOWS_1252, "gbk", "cp949", "utf-8", *_SINGLE, *_MULTI)))
_BY_CODEC: Final = {codecs.lookup(codec).name: name for name, codec in (*_SINGLE.items(), *_MULTI.items())} | _WIDER

UTF_16: Final = "utf-16"
"""An encoding that only files can have."""

_FIRST_LATIN = 0xA0
_STAND_INS = 0xF700  # plus a byte 80-FF
_STAND_IN = re.compile("([\uf780-\uf7ff])")
_MOST_BYTES = 4  # of a character
_SURROGATES, _END_OF_SURROGATES = 0xD800, 0xE000
UNIT_STAND_INS: Final = 0x10F800  # plus a unit, from _SURROGATES on
_UNIT_STAND_IN = re.compile("[\U0010f800-\U0010ffff]")


def canonical(name: str) -> str:
    """Return the name of an encoding as layouts contain it, such as ``windows-1252`` for ``cp1252``.

    Raises:
        ValueError: There is no such encoding, or no register can have it.

    """
    wanted = name.strip().lower()
    if wanted in NAMES:
        return wanted
    try:
        return _BY_CODEC[codecs.lookup(wanted).name]
    except (LookupError, ValueError, UnicodeError):
        raise ValueError(unknown("encoding", name, dict.fromkeys((*NAMES, *_WIDER)))) from None


def codec(name: str) -> str:
    """Return Python's codec for the texts of a file, given the name of an encoding.

    Raises:
        ValueError: shmio does not know the encoding; the message has the names that it knows.

    """
    if name.lower() == UTF_16:
        return UTF_16
    return (_SINGLE | _MULTI)[canonical(name)]


def encoding_of_file(data: bytes, given: str) -> str:
    """Return the encoding of a source file whose controller has the encoding ``given``; "" if it is UTF-8.

    Many people keep exports in UTF-8, whatever the controller has.
    """
    try:
        data.decode()
    except UnicodeDecodeError:
        return given
    return ""


class TextEncoding(ABC):
    """An encoding whose texts come back from their bytes, and whose bytes from their texts.

    Attributes:
        name: The name for messages.
        points: For a single-byte encoding, the 256 characters of its bytes; else empty.

    """

    name: str
    points = ""

    @abstractmethod
    def decode(self, data: bytes) -> str:
        """Return the text that bytes mean."""

    @abstractmethod
    def encode(self, text: str) -> bytes:
        """Return the bytes of a text; raise UnicodeEncodeError if the encoding lacks a character."""

    def missing(self, text: str) -> int:
        """Return the index of the first character that the encoding lacks; the length if it lacks none."""
        for at, character in enumerate(text):
            try:
                self.encode(character)
            except UnicodeEncodeError:
                return at
        return len(text)


class _SingleByte(TextEncoding):
    def __init__(self, name: str, codec: str) -> None:
        self.name = name
        self.points = "".join(_character(codec, byte) for byte in range(256))
        self._bytes = codecs.charmap_build(self.points)

    def decode(self, data: bytes) -> str:
        return codecs.charmap_decode(data, "strict", self.points)[0]

    def encode(self, text: str) -> bytes:
        return codecs.charmap_encode(text, "strict", self._bytes)[0]


class _MultiByte(TextEncoding):
    """Python's codec, and stand-ins for what it does not decode, or not encode to the same bytes again."""

    def __init__(self, name: str, codec: str) -> None:
        self.name, self._codec = name, codec

    def decode(self, data: bytes) -> str:
        try:
            text = data.decode(self._codec)
            if data.isascii() or self.encode(text) == data:
                return text
        except UnicodeError:
            pass
        found, at = [], 0
        while at < len(data):
            character = self._character(data, at)
            found.append(character or chr(_STAND_INS + data[at]))
            at += len(character.encode(self._codec)) if character else 1
        return "".join(found)

    def _character(self, data: bytes, at: int) -> str:
        """Return the character that begins at a byte; empty if there is none that encodes to the same bytes."""
        for size in range(1, _MOST_BYTES + 1):
            part = data[at : at + size]
            try:
                character = part.decode(self._codec)
                if len(character) == 1 and not _STAND_IN.match(character) and character.encode(self._codec) == part:
                    return character
            except UnicodeError:
                pass
        return ""

    def encode(self, text: str) -> bytes:
        if not _STAND_IN.search(text):
            return text.encode(self._codec)
        parts = _STAND_IN.split(text)  # every second one is a stand-in
        return b"".join(
            bytes((ord(part) - _STAND_INS,)) if place & 1 else part.encode(self._codec)
            for place, part in enumerate(parts)
        )


class _Utf16(TextEncoding):
    name = "UTF-16"

    def __init__(self, codec: str) -> None:
        self._codec = codec

    def decode(self, data: bytes) -> str:
        try:
            text = data.decode(self._codec)
            if not _UNIT_STAND_IN.search(text):
                return text
        except UnicodeDecodeError:
            pass
        whole = data[: len(data) & ~1].decode(self._codec, "surrogatepass")
        return "".join(map(_units_in_place, whole))

    def encode(self, text: str) -> bytes:
        if not _UNIT_STAND_IN.search(text):
            return text.encode(self._codec)
        order = "big" if self._codec.endswith("be") else "little"
        return b"".join(
            (ord(one) - UNIT_STAND_INS + _SURROGATES).to_bytes(2, order)  # type: ignore[arg-type]
            if _UNIT_STAND_IN.match(one)
            else one.encode(self._codec)
            for one in text
        )


def _units_in_place(character: str) -> str:
    """Return a character, or the stand-ins of its surrogates: of one alone, or of both of a stand-in."""
    point = ord(character)
    if _SURROGATES <= point < _END_OF_SURROGATES:
        return chr(point - _SURROGATES + UNIT_STAND_INS)
    if point < UNIT_STAND_INS:
        return character
    high, low = _SURROGATES + (point - 0x10000 >> 10), 0xDC00 + (point & 0x3FF)
    return "".join(chr(unit - _SURROGATES + UNIT_STAND_INS) for unit in (high, low))


def _character(codec: str, byte: int) -> str:
    """Return the character of a byte in a single-byte encoding, or its stand-in."""
    try:
        return bytes((byte,)).decode(codec)
    except UnicodeDecodeError:
        return chr(byte if byte < _FIRST_LATIN else _STAND_INS + byte)


@lru_cache
def text_encoding(name: str) -> TextEncoding:
    """Return an encoding by its canonical name; the empty name is ISO 8859-1. Also ``utf-16-be``, ``utf-16-le``."""
    if name.startswith("utf-16"):
        return _Utf16(name)
    name = name or ISO_8859_1
    return _SingleByte(name, _SINGLE[name]) if name in _SINGLE else _MultiByte(name, _MULTI[name])
