"""The URL of a cell's history, which can stand in the place of a recording's file."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple
from urllib.parse import urlsplit

from shmio.config.fabric import server_address
from shmio.config.masking import mask_line
from shmio.errors import ConfigError, RecordingError
from shmio.fabric.names import CellName

if TYPE_CHECKING:
    from shmio.fabric.connection import Access


class Place(NamedTuple):
    """Where a cell's history is: the servers, and the cell."""

    access: Access
    cell: CellName


def is_place(text: str) -> bool:
    """Return whether a text names a cell's history, and not a file."""
    return text.startswith(("nats://", "tls://"))


def parse_place(text: str) -> tuple[str, CellName]:
    """Return the server's URL and the cell of ``nats://HOST:PORT/plant.line.cell``.

    Raises:
        RecordingError: The text is not such a URL.

    """
    shown = mask_line(text)
    try:
        parts = urlsplit(text)
        server = f"{parts.scheme}://{parts.netloc}"
        server_address(shown, server, "with --credentials, or in fabric.credentials")
        return server, CellName.parse(parts.path.strip("/"))
    except (ConfigError, ValueError) as error:
        raise RecordingError(f"{shown}: {str(error).removeprefix(f'{shown}: ')}") from None
