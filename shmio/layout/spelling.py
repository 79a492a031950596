"""Paths as TIA Portal writes them, for what people type: ``"Axes"[2]."Vel"``, ``Inputs[8].%X0``, ``Grid[1,*]``.

A name of ours may hold dots, brackets and quotes, too: text that names something as it is keeps that meaning.
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


def may_be_foreign(text: str) -> bool:
    """Whether text has any sign of TIA's spelling; else there is nothing to look for."""
    return _SIGNS.search(text) is not None


def block_path(text: str, layout: Layout) -> str:
    """Return a path or pattern within a block in our own spelling; text that names nothing there as it is."""
    if not may_be_foreign(text) or _names(layout, text):
        return text
    path = _translated(text)
    first, _, rest = path.partition("/")
    options = (path, rest) if _is_block(first, layout) else (path,)
    return next((option for option in options if option and _names(layout, option)), text)


def topic_path(text: str, layouts: Mapping[str, Layout], default: str | None) -> str:
    """The same for a path that may begin with its source, and end in ``/in`` or ``/out``.

    The data block's own name, with which TIA's paths begin, stands for the source that has it.
    """
    if not may_be_foreign(text) or _is_topic(text, layouts, default):
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
    """Whether a path or a pattern names something in a block."""
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
    """A name that may be percent-encoded by now."""
    return encode_segment(name) if name in ("in", "out") else name


def _translated(text: str) -> str:
    """The text in our spelling; empty if it is none of TIA's."""
    if len(text) > MAX_TOPIC or "://" in text:
        return ""
    segments, at, joined = list[str](), 0, True  # joined: a name is due
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
