"""Phrases that messages share, so that all parts of shmio report a fault in the same words."""

from __future__ import annotations

import errno
import math
from collections.abc import Iterable, Sequence
from typing import Final

MAX_HINTED: Final = 100
"""Maximum length in characters of an unknown word for which a similar word is suggested."""
MAX_WORD: Final = 80
MAX_NAMES: Final = 30
"""Maximum number of valid words that a message lists."""
MAX_PATHS: Final = 3
"""Maximum number of paths that a message about them lists."""


def printable(text: str) -> str:
    """Return text as one line, without characters that would move a terminal's cursor."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def brief(value: object) -> str:
    """Return a value as a short text for a message; for a huge integer, the number of its bytes."""
    if isinstance(value, int) and not -(1 << 128) < value < 1 << 128:
        return f"an integer of {math.ceil(value.bit_length() / 8)} bytes"
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:59]}…"


def counted(count: int, noun: str) -> str:
    """Return a number with its noun in singular or plural, such as ``1 node`` or ``7 nodes``."""
    return f"{count} {noun}{'s' * (count != 1)}"


def near(word: str, names: Iterable[str]) -> list[str]:
    """Return a list of the one name most similar to ``word``, ignoring case; empty if no name is similar."""
    import difflib  # noqa: PLC0415  takes 1 ms, and most processes report no such fault

    folded = {name.lower(): name for name in names}
    found = difflib.get_close_matches(word.lower(), folded, 1) if len(word) <= MAX_HINTED else []
    return [folded[found[0]]] if found else []


def did_you_mean(names: Sequence[str]) -> str:
    """Return ``did you mean 'a', 'b' or 'c'?``; empty if there are no names."""
    *first, last = map(repr, names) if names else [""]
    return f"did you mean {', '.join(first)}{' or ' if first else ''}{last}?" if names else ""


def listed(names: Iterable[str]) -> str:
    """Return ``valid: a, b, c`` with at most ``MAX_NAMES`` names; ``there are none`` if there are no names."""
    known = list(names)
    if not known:
        return "there are none"
    return f"valid: {', '.join(known[:MAX_NAMES])}{', …' if len(known) > MAX_NAMES else ''}"


def unknown(what: str, word: object, names: Iterable[str], of: str = "") -> str:
    """Return ``unknown WHAT 'word'; did you mean 'name'?``; if no name is similar, list the valid names instead.

    Args:
        what: The kind of thing, such as ``source``.
        word: The word that the user wrote.
        names: All valid names.
        of: What has these names, such as ``model lift``; then the text is ``unknown WHAT 'word' of
            OF; …``. Empty: the message says this already.

    """
    known = list(names)
    text = str(word)
    shown = repr(text if len(text) <= MAX_WORD else f"{text[: MAX_WORD - 1]}…")
    return f"unknown {what} {shown}{f' of {of}' if of else ''}; {did_you_mean(near(text, known)) or listed(known)}"


def already_named(name: str, first: str) -> str:
    """Return the message about a name that two sections have; ``first`` is the key of the first section."""
    return f"{name!r} is already the name of {first}; choose another name"


def not_writable(paths: Sequence[str], where: str = "the configuration") -> str:
    """Return the message about registers that commands may not write; ``where`` is what has their source."""
    shown = f"{', '.join(paths[:MAX_PATHS])}{', …' if len(paths) > MAX_PATHS else ''}"
    are, them = ("is", "it") if len(paths) == 1 else ("are", "them")
    return f"{shown} {are} not writable; name {them} in the source's `writable` in {where}"


EXISTS: Final = "this file exists already; choose another name, or remove the file"
IN_USE: Final = "another program uses this address (ss -ltnp shows which), or this host does not have it"
NOT_TOML: Final = "a tag table is TOML; choose a name that ends in .toml"
EMPTY: Final = "the recording is empty"
PLAIN_REMEDY: Final = "give certificate and key, or write insecure = true in the same section"
"""The remedy for plain text, for sections that have their own ``certificate`` and ``key``."""


_NOT_LISTENING: Final = {
    errno.EADDRINUSE: "; another program, which ss -ltnp shows, has this port: end it, or choose another port",
    errno.EADDRNOTAVAIL: "; choose an address of this host, which ip address shows",
    errno.EACCES: "; choose a port from 1024 on, or allow this program the lower ones (CAP_NET_BIND_SERVICE)",
}


def cannot_listen(address: object, error: OSError) -> str:
    """Return the message about an address at which this process cannot listen, with the remedy."""
    return f"cannot listen on {address}: {error.strerror or error}{_NOT_LISTENING.get(error.errno or 0, '')}"


def larger_than(most_bytes: int) -> str:
    """Return the message about a file that is too large."""
    return f"the file is larger than {most_bytes} bytes, which is the maximum"


def plain_text(address: object, remedy: str) -> str:
    """Return the message about an address that other hosts can reach without encryption, with the remedy."""
    return f"other hosts can reach {address} in plain text; {remedy}"


def name_one(what: str, names: Iterable[str]) -> str:
    """Return the message for a user who must name one of several things (``what``), or has none to name."""
    known = list(names)
    return (
        f"there are several {what}s; name one of them: {', '.join(known[:MAX_NAMES])}"
        if known
        else f"there is no {what}"
    )
