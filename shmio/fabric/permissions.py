"""What each kind of user may do at the NATS servers of the fabric.

A server answers a request to whatever subject the request names, without asking whether its sender
may publish there. So a user may send only such requests of JetStream whose answers are JSON, which
no reader takes for a message of a cell. Those that hand out stored messages unchanged, by direct
access or by consumers, would let a user publish in the name of others.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from shmio.fabric.connection import INBOX, OWN_INBOX, inbox_prefix
from shmio.fabric.names import ROOT, CellName
from shmio.fabric.registry import BUCKETS, CELLS, LAYOUTS

_ANY = f"{ROOT}.*.*.*"


class Permissions(NamedTuple):
    """The subjects to which a user may publish, and those that it may subscribe to, but for some of each."""

    publish: tuple[str, ...]
    subscribe: tuple[str, ...]
    publish_not: tuple[str, ...] = ()
    subscribe_not: tuple[str, ...] = ()

    def section(self) -> dict[str, dict[str, tuple[str, ...]]]:
        """Return the section of the user in the configuration of a server."""
        publish, subscribe = {"allow": self.publish}, {"allow": self.subscribe}
        return {
            "publish": publish | ({"deny": self.publish_not} if self.publish_not else {}),
            "subscribe": subscribe | ({"deny": self.subscribe_not} if self.subscribe_not else {}),
        }


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
    return Permissions((*_REGISTRY, f"{_ANY}.*.missing"), _read(inbox_prefix(key)))


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
    publish = (*_own(cell), *_SHARED, f"$JS.API.STREAM.INFO.{stream}")
    return Permissions(publish, (*_read(inbox_prefix(key)), *_asked(cell)))


def others_permissions(own: CellName | None, cells: Sequence[CellName]) -> Permissions:
    """Return what clients without credentials may do at the server that an instance runs.

    They may do what a viewer may, and what the cells may that the instance allows.

    Args:
        own: The instance's cell; None if it has none. Nobody else publishes in its name.
        cells: The allowed cells. A part of a name may be ``*``.

    """
    publish = [*_REGISTRY, f"{_ANY}.*.missing"]
    subscribe = [*_read(INBOX)]
    for cell in cells:
        publish += [*_own(cell), *_SHARED, "$JS.API.STREAM.INFO.*"]
        subscribe += _asked(cell)
    refused = () if own is None else _own(own)
    return Permissions(tuple(dict.fromkeys(publish)), tuple(dict.fromkeys(subscribe)), refused, (f"{OWN_INBOX}.>",))


_SHARED = (
    f"$KV.{LAYOUTS}.*",
    *_REGISTRY,
    f"{_ANY}.*.missing",
    f"{INBOX}.>",  # answers to requests; nobody can subscribe to the inbox of a user with credentials
)
"""What each cell may publish to."""


def _own(cell: CellName) -> tuple[str, ...]:
    """Return the subjects to which only this cell may publish."""
    name = str(cell)
    return cell.live("*"), cell.late("*"), cell.status, f"$KV.{CELLS}.{name}", f"{_ANY}.*.command.{name}"


def _asked(cell: CellName) -> tuple[str, ...]:
    """Return the subjects on which others ask a cell."""
    return cell.missing("*"), cell.command_subjects


def _read(inbox: str) -> tuple[str, ...]:
    return f"{_ANY}.*.live", f"{_ANY}.*.late", f"{_ANY}.status", f"{inbox}.>"
