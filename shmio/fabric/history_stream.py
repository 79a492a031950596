"""Creates the stream in which the servers keep what a cell publishes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from shmio.config.model import FabricHistory
from shmio.fabric.connection import INSTALL
from shmio.fabric.names import CellName
from shmio.libraries import library

if TYPE_CHECKING:
    from nats.aio.client import Client

DUPLICATES_S: Final = 600.0
"""Time in s for which the servers recognise a message that comes twice."""
_LIMITS: Final = "subjects", "max_age", "max_bytes", "num_replicas"


async def create_history(client: Client, cell: CellName, settings: FabricHistory) -> None:
    """Create the stream of a cell; if it exists with other limits, change them.

    On servers that know their users, only the administrator may do that. A cell may look at its stream,
    so this function changes nothing that is as it should be.

    Raises:
        nats.js.errors.Error: The servers do not create or change the stream.
        nats.errors.TimeoutError: A server does not answer: it does so if the user may not do that.

    """
    api, errors = library("nats.js.api", INSTALL), library("nats.js.errors", INSTALL)
    age_s = settings.keep_days * 86_400
    config = api.StreamConfig(
        name=cell.history,
        description=f"shmio: history of {cell}",
        subjects=[cell.live("*"), cell.late("*")],
        max_age=age_s,
        max_bytes=round(settings.keep_mb * 1e6),
        storage=api.StorageType.FILE,
        num_replicas=settings.replicas,
        duplicate_window=min(DUPLICATES_S, age_s),
        allow_direct=True,
    )
    stream = client.jetstream()
    try:
        present: Any = (await stream.stream_info(cell.history)).config
    except errors.NotFoundError:
        await stream.add_stream(config)
        return
    if any(getattr(present, name) != getattr(config, name) for name in _LIMITS):
        await stream.update_stream(config)
