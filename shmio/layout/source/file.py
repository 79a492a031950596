"""Decode the bytes of a source file.

TIA Portal writes UTF-8 with a byte order mark, STEP 7 classic uses the Windows code page of its PC,
and some editors write UTF-16 with a mark. Files without a mark are read in the encoding that the user
names. If the user names none, they are read as UTF-8 or, if they are not in UTF-8, as Windows-1252.
"""

from __future__ import annotations

import codecs
import re
from dataclasses import dataclass
from typing import Final

from shmio.layout.encodings import UTF_16, codec

_MARKS = ((codecs.BOM_UTF16_LE, "utf-16-le"), (codecs.BOM_UTF16_BE, "utf-16-be"))
_PROBED_BYTES: Final = 1 << 16
_HIGH: Final = re.compile(rb"[\x80-\xff]+")
_NEWLINE = re.compile(r"\r\n|\r|\n")
_AS_WINDOWS = (
    "the file is not UTF-8, so shmio reads it as Windows-1252, which is not sure: letters with accents and of "
    'other scripts may be wrong in names and comments; name the encoding (encoding = "gbk", --encoding gbk), or '
    "save it as UTF-8"
)
EASTERN: Final = (
    "the file is not UTF-8, and looks like Chinese or Korean text in GBK or CP949; name its encoding, such as "
    'encoding = "gbk" in the configuration or --encoding gbk of shmio-layout, or save it as UTF-8'
)


@dataclass(frozen=True, slots=True)
class Decoded:
    """The text of a source.

    ``problem`` is a warning (an error if ``fatal``) about the bytes at ``line`` and ``column``;
    empty if there is none. ``eastern`` is true if the bytes are almost surely Chinese or Korean text,
    which was decoded as Windows-1252.
    """

    text: str
    problem: str = ""
    line: int = 1
    column: int = 1
    fatal: bool = False
    eastern: bool = False


def decode(data: bytes, encoding: str = "") -> Decoded:
    """Decode a source: by its byte order mark, or else as UTF-8, or else as ``encoding``.

    Text in another encoding is practically never valid UTF-8. If ``encoding`` is empty, it is
    Windows-1252, which is a guess. Otherwise it is one of :data:`shmio.layout.encodings.NAMES` or
    UTF-16.
    """
    for mark, name in _MARKS:
        if data.startswith(mark):
            problem = (
                f"the file has the byte order mark of {name.upper()}, but other bytes follow; export the source again"
            )
            return _exactly(data[len(mark) :], name, problem)
    data = data.removeprefix(codecs.BOM_UTF8)
    given = codec(encoding) if encoding else ""
    try:
        return Decoded(data.decode(UTF_16 if given == UTF_16 else "utf-8"))
    except UnicodeDecodeError as error:
        line, column = _place(data[: error.start].decode("utf-8", "replace"))
    if given:
        return _exactly(
            data, given, f"the bytes here are not {encoding}; name the encoding in which the file was saved"
        )
    try:
        text = data.decode("cp1252")
    except UnicodeDecodeError:
        text = data.decode("latin-1")  # because five bytes have no character in Windows-1252
    return Decoded(text, _AS_WINDOWS, line, column, eastern=_is_eastern(data))


def _exactly(data: bytes, encoding: str, problem: str) -> Decoded:
    """Decode bytes; ``problem`` is the error if they are not in the encoding."""
    try:
        return Decoded(data.decode(encoding))
    except UnicodeDecodeError as error:
        line, column = _place(data[: error.start].decode(encoding, "replace"))
    return Decoded("", problem, line, column, fatal=True)


def _is_eastern(data: bytes) -> bool:
    """Return whether all bytes above 7F are pairs of GBK or EUC-KR, most of them of the common characters.

    A letter with an accent in the text of a Western code page stands alone or beside one other.
    """
    head = data[:_PROBED_BYTES]
    runs = _HIGH.findall(head[: head.rfind(b"\n") + 1] if len(head) < len(data) else head)
    pairs = [run[at : at + 2] for run in runs for at in range(0, len(run), 2)]
    common = sum(0xB0 <= pair[0] <= 0xD7 and pair[-1] >= 0xA1 for pair in pairs)
    return len(pairs) > 1 and all(len(run) % 2 == 0 for run in runs) and common * 5 >= len(pairs) * 4


def _place(before: str) -> tuple[int, int]:
    lines = _NEWLINE.split(before)
    return len(lines), len(lines[-1]) + 1
