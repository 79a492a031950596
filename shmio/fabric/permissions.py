"""What each kind of user may do at the NATS servers of the fabric.

A server answers a request to whatever subject the request names, without asking whether its sender
may publish there. So a user may send only such requests of JetStream whose answers are JSON, which
no reader takes for a message of a cell. Those that hand out stored messages unchanged, by direct
access or by consumers, would let a user publish in the name of others.
"""

from __future__ import annotations

from typing import NamedTuple

from shmio.fabric.connection import inbox_prefix
from shmio.fabric.names import ROOT, CellName
from shmio.fabric.registry import BUCKETS, CELLS, LAYOUTS

_ANY = f"{ROOT}.*.*.*"


class Permissions(NamedTuple):
    """The subjects to which a user may publish, but for some, and those that it may subscribe to."""

    publish: tuple[str, ...]
    subscribe: tuple[str, ...]
    publish_not: tuple[str, ...] = ()


EVERYTHING = Permissions((">",), (">",))
"""For the administrator, who creates what the servers keep."""
FARM_USER = Permissions((">",), (">",), tuple(f"$JS.API.STREAM.*.KV_{bucket}" for bucket in BUCKETS))
"""For the users of a farm's account: a command that looks for cells there would create an empty registry."""
_REGISTRY = tuple(
    f"$JS.API.{request}.KV_{bucket}" for bucket in BUCKETS for request in ("STREAM.INFO", "STREAM.MSG.GET")
)


def viewer_permissions(key: str) -> Permissions:
    """Return what a viewer may do: read all cells, also through mirrors, and write nothing.

    Args:
        key: The viewer's public NKey.

    """
    return Permissions((*_REGISTRY, f"{_ANY}.*.missing"), _read(key))


def history_reader_permissions(key: str, streams: tuple[str, ...]) -> Permissions:
    """Return what a viewer may do who also reads and archives the histories of cells.

    Args:
        key: The user's public NKey.
        streams: Names of the streams with the histories.

    """
    requests = (
        "STREAM.INFO.{}",
        "STREAM.MSG.GET.{}",
        "CONSUMER.CREATE.{}.>",
        "CONSUMER.INFO.{}.*",
        "CONSUMER.MSG.NEXT.{}.*",
        "CONSUMER.DELETE.{}.*",
    )
    more = ("$JS.API.STREAM.NAMES", *(f"$JS.ACK.{stream}.>" for stream in streams))
    more += tuple(f"$JS.API.{request.format(stream)}" for stream in streams for request in requests)
    viewer = viewer_permissions(key)
    return Permissions(viewer.publish + more, viewer.subscribe)


def cell_permissions(cell: CellName, key: str, stream: str) -> Permissions:
    """Return what a cell may do: publish its own sources, mirror others, and send commands in its own name.

    Args:
        cell: Name of the cell.
        key: The cell's public NKey.
        stream: Name of the stream with the cell's history.

    """
    publish = (
        cell.live("*"),
        cell.late("*"),
        cell.status,
        f"$KV.{CELLS}.{cell}",
        f"$KV.{LAYOUTS}.*",
        *_REGISTRY,
        f"$JS.API.STREAM.INFO.{stream}",
        f"{_ANY}.*.missing",
        f"{_ANY}.*.command.{cell}",
        "_INBOX.>",  # answers to requests; nobody can subscribe to another user's inbox
    )
    return Permissions(publish, (*_read(key), cell.missing("*"), f"{cell.subject}.*.command.*.*.*"))


def _read(key: str) -> tuple[str, ...]:
    return f"{_ANY}.*.live", f"{_ANY}.*.late", f"{_ANY}.status", f"{inbox_prefix(key)}.>"
