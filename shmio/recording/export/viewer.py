"""Export as MCAP with values as JSON, for general viewers such as Foxglove and PlotJuggler."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterator, Sequence
from typing import IO, Any, Final, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt
from mcap.writer import Writer

from shmio.layout.model import Register
from shmio.recording.columns import Columns, heading
from shmio.recording.dump import Dump
from shmio.recording.names import Chosen
from shmio.recording.pieces import pieces
from shmio.recording.reading.blocks import DumpBlock
from shmio.segment.explain import Explainer, kind_of, object_of
from shmio.version import __version__

FRAME: Final = "frame"
HEAD: Final = {"number": "integer", "cycle": "integer", "quality": "integer", "provenance": "integer"}
"""What each frame tells of itself, under FRAME."""
_TYPES: Final = {"b": "boolean", "i": "integer", "u": "integer", "f": "number", "m": "integer"}
_EVENT: Final = {
    "kind": "string", "text": "string", "quality": "string", "number": "integer", "frame": "integer",
    "cycle": "integer", "by": "string", "direction": "string", "paths": "array", "values": "object",
    "laid": "object", "injection": "integer", "command": "integer", "item": "integer", "items": "integer",
    "offset": "integer", "mask": "integer", "size": "integer", "data": "string",
}  # fmt: skip


class _Row(NamedTuple):
    log_ns: int
    channel: int
    publish_ns: int
    data: bytes


def export_mcap(
    dump: Dump,
    chosen: Chosen,
    stream: IO[bytes],
    from_ns: int,
    to_ns: int,
    *,
    raw: bool,
    progress: Callable[[int], None],
) -> int:
    """Write a message for each frame to the topic ``/<source>``, for each event to ``/<source>/events``.

    Args:
        dump: The recording.
        chosen: The registers to export, by block.
        stream: The new file.
        from_ns: Start of the range.
        to_ns: End of the range.
        raw: Whether to export what the source delivered, without injections.
        progress: Called with the ns of the recording that are done.

    Returns:
        The number of messages.
    """
    writer = Writer(stream)
    writer.start("", f"shmio {__version__}")
    sources = list(dict.fromkeys(block.source for block in chosen))
    streams = [_frames(dump, source, chosen, writer, from_ns, to_ns, raw=raw) for source in sources]
    streams += [_events(dump, source, writer, from_ns, to_ns) for source in sources]
    count = 0
    for row in heapq.merge(*streams, key=lambda row: row.log_ns):
        writer.add_message(row.channel, row.log_ns, row.data, row.publish_ns)
        progress(row.log_ns - dump.begin_ns)
        count += 1
    writer.finish()
    return count


def _frames(
    dump: Dump, source: str, chosen: Chosen, writer: Writer, from_ns: int, to_ns: int, *, raw: bool
) -> Iterator[_Row]:
    channels: dict[DumpBlock, int] = {}
    for block, columns in pieces(dump, source, chosen, from_ns, to_ns, raw=raw):
        tree = _tree(columns.registers, source)
        if block not in channels:
            schema = {FRAME: {"type": "object", "properties": {name: {"type": kind} for name, kind in HEAD.items()}}}
            schema |= _schema(tree, columns)
            channels[block] = _channel(writer, f"/{source}", f"{source} {block.layout.name}", schema)
        heads = zip(*(getattr(columns, name).tolist() for name in HEAD), strict=True)
        values = zip(*(_plain(columns[register.path]) for register in columns.registers), strict=True)
        rows = zip(columns.time_ns.tolist(), columns.source_ns.tolist(), heads, values, strict=True)
        for log_ns, source_ns, head, row in rows:
            message = {FRAME: dict(zip(HEAD, head, strict=True))}
            if source_ns:  # else it never had any values
                message |= _filled(tree, row)
            yield _Row(log_ns, channels[block], source_ns if source_ns > 0 else log_ns, msgspec.json.encode(message))


def _events(dump: Dump, source: str, writer: Writer, from_ns: int, to_ns: int) -> Iterator[_Row]:
    channel = 0
    explainers: dict[DumpBlock, Explainer] = {}
    for log_ns, block, event in dump.events(source, from_ns, to_ns):
        schema = {name: _property(kind) for name, kind in _EVENT.items()}
        channel = channel or _channel(writer, f"/{source}/events", "event", schema)
        if block is None:
            continue
        explained = explainers.setdefault(block, Explainer(source, block.layout)).explain(event)
        told = {"kind": kind_of(event), "quality": str(event.quality), "number": event.number}
        about = object_of(event, explained)
        about["laid"] = about["laid"] or {}
        told_in_numbers = {"frame": event.frame, "cycle": event.cycle}
        yield _Row(log_ns, channel, log_ns, msgspec.json.encode(told | told_in_numbers | about))


def _property(kind: str) -> dict[str, Any]:
    return {"type": kind, "items": {"type": "string"}} if kind == "array" else {"type": kind}


def _channel(writer: Writer, topic: str, name: str, properties: dict[str, Any]) -> int:
    text = msgspec.json.encode({"title": name, "type": "object", "properties": properties})
    return writer.register_channel(topic, "json", writer.register_schema(name, "jsonschema", text))


def _tree(registers: Sequence[Register], source: str) -> dict[str, Any]:
    """Return a tree of the registers by path segments; its leaves are indices of registers.

    A register with the name of a field of the frame has its source before it.
    """
    tree: dict[str, Any] = {}
    for place, register in enumerate(registers):
        first, *others = register.path.split("/")
        *above, name = heading(source, first, (FRAME,)), *others
        node = tree
        for segment in above:
            below = node.setdefault(segment, {})
            if not isinstance(below, dict):  # a register has the name of a structure
                node, name = tree, register.path
                break
            node = below
        node[name if name not in node else register.path] = place
    return tree


def _filled(tree: dict[str, Any], row: Sequence[Any]) -> dict[str, Any]:
    return {name: _filled(below, row) if isinstance(below, dict) else row[below] for name, below in tree.items()}


def _schema(tree: dict[str, Any], columns: Columns) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, below in tree.items():
        if isinstance(below, dict):
            found[name] = {"type": "object", "properties": _schema(below, columns)}
            continue
        values = columns[columns.registers[below].path]
        kind: dict[str, Any] = {"type": _TYPES.get(values.dtype.kind, "string")}
        for _ in values.shape[1:]:
            kind = {"type": "array", "items": kind}
        found[name] = kind
    return found


def _plain(values: npt.NDArray[Any]) -> list[Any]:
    """Convert values for JSON: durations to numbers, dates to text, invalid or infinite ones to null."""
    kind = values.dtype.kind
    found: Any = values
    if kind == "f" and not np.isfinite(values).all():
        return [_finite(value) for value in values.tolist()]
    if kind == "V":
        return [_hex(value) for value in values]
    if kind in "mM":
        found = (values.astype(np.int64) if kind == "m" else np.datetime_as_string(values)).astype(object)
        found[np.isnat(values)] = None
    return list(found.tolist())


def _finite(value: Any) -> Any:
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return value if math.isfinite(value) else None


def _hex(value: Any) -> Any:
    return [_hex(item) for item in value] if getattr(value, "ndim", 0) else bytes(value).hex()
