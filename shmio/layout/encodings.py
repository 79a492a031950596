"""Encodings of text in files and controllers, by the names that users give them.

Engineering tools of the time before Unicode write the code page of Windows of their PC.
"""

from __future__ import annotations

from typing import Final

from shmio.wording import unknown

ENCODINGS: Final = {
    "utf-8": "utf-8", "utf-16": "utf-16", "windows-1250": "cp1250", "windows-1251": "cp1251", "windows-1252": "cp1252",
    "windows-1253": "cp1253", "windows-1254": "cp1254", "windows-1255": "cp1255", "windows-1256": "cp1256",
    "windows-1257": "cp1257", "windows-1258": "cp1258", "gbk": "cp936", "gb18030": "gb18030", "big5": "cp950",
    "shift-jis": "cp932", "cp949": "cp949", "cp874": "cp874", "cp437": "cp437", "cp850": "cp850", "cp852": "cp852",
    "latin-1": "latin-1",
}  # fmt: skip
"""Python's codec of each encoding."""


def codec(name: str) -> str:
    """Return Python's codec of an encoding, given in upper or lower case.

    Raises:
        ValueError: shmio does not know the encoding; the message has the names that it knows.

    """
    found = ENCODINGS.get(name.lower().replace("_", "-"))
    if found is None:
        raise ValueError(unknown("encoding", name, ENCODINGS))
    return found
