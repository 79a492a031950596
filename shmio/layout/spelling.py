"""Translate paths typed in TIA Portal's spelling: ``"Axes"[2]."Vel"``, ``Grid[1,*]``.

Member names may themselves contain dots, brackets and quotes. Text that already names something
in shmio's spelling therefore keeps that meaning.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

from shmio.errors import PathError
from shmio.layout.model import Layout
from shmio.layout.topic import MAX_TOPIC, encode_segment, find, parse_topic
from shmio.layout.values.write import chosen

_SIGNS = re.compile(r'[."\[]')
_TOKEN = re.compile(
    r'(?P<part>\.%[XBWDxbwd][0-9]{1,3}(?=$|/))|(?P<gap>[./])|"(?P<quoted>(?:[^"]|"")+)"|\[(?P<index>[^\[\]]+)\]'
    r'|(?P<name>[^."/\[\]]+)'
)
_INDEX = re.compile(r"-?[0-9]+(?:\.\.-?[0-9]+)?|\*")


def may_be_tia_spelling(text: str) -> bool:
    """Return whether a text has a character that is typical of TIA Portal's spelling."""
    return _SIGNS.search(text) is not None


def block_path(text: str, layout: Layout) -> str:
    """Return a path or pattern within a block in shmio's spelling.

    Text that names nothing in the block is returned unchanged.
    """
    if not may_be_tia_spelling(text) or _names(layout, text):
        return text
    path = _translated(text)
    first, _, rest = path.partition("/")
    options = (path, rest) if _is_block(first, layout) else (path,)
    return next((option for option in options if option and _names(layout, option)), text)


def topic_path(text: str, layouts: Mapping[str, Layout], default: str | None) -> str:
    """Return a topic in shmio's spelling: a path, which may also name its source and a direction.

    Paths of TIA Portal begin with the name of the data block, which stands for its source. Text
    that names nothing is returned unchanged.
    """
    if not may_be_tia_spelling(text) or _is_topic(text, layouts, default):
        return text
    path = _translated(text)
    first, _, rest = path.partition("/")
    blocks = (source for source, layout in layouts.items() if _is_block(first, layout))
    options = (path, *(f"{source}/{rest}" for source in blocks if rest))
    return next((option for option in options if option and _is_topic(option, layouts, default)), text)


def _is_topic(text: str, layouts: Mapping[str, Layout], default: str | None) -> bool:
    try:
        topic = parse_topic(text, layouts, default)
    except PathError:
        return False
    layout = layouts.get(topic.source)
    return layout is not None and (not topic.path or _names(layout, topic.path))


def _names(layout: Layout, path: str) -> bool:
    """Return whether a path or a pattern names something in a block."""
    try:
        if "*" in path:
            return any(True for _ in chosen(layout, path))
        if not layout.members(path):
            find(layout, path)
    except PathError:
        return False
    return True


def _is_block(name: str, layout: Layout) -> bool:
    return name == encode_segment(layout.name) or (layout.number is not None and name == f"DB{layout.number}")


def _escaped(name: str) -> str:
    """Encode the names ``in`` and ``out``; return any other name unchanged, because it may be encoded already."""
    return encode_segment(name) if name in ("in", "out") else name


def _translated(text: str) -> str:
    """Return the text in shmio's spelling, or an empty string if it is not in TIA Portal's."""
    if len(text) > MAX_TOPIC or "://" in text:
        return ""
    segments, at, joined = list[str](), 0, True  # joined: a name must follow
    while at < len(text):
        token = _TOKEN.match(text, at)
        kind = token.lastgroup if token else None
        if token is None or joined != (kind in ("quoted", "name")):
            return ""
        if kind == "quoted":
            segments.append(encode_segment(token["quoted"].replace('""', '"')))
        elif kind == "name":
            suffix = token.end() == len(text) and text[:at].endswith("/")  # /in or /out
            segments.append(token["name"] if suffix else _escaped(token["name"]))
        elif kind == "index":
            indices = [index.strip() for index in token["index"].split(",")]
            if not all(map(_INDEX.fullmatch, indices)):
                return ""
            segments += indices
        elif kind == "part":
            segments[-1] += token["part"].upper()
        joined, at = kind == "gap", token.end()
    return "" if joined else "/".join(segments)
