"""The keys of a mirror, and the layout of the source that it reproduces."""

from __future__ import annotations

import asyncio
import base64
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import msgspec

from shmio.connectors.base import Mirrored
from shmio.errors import ConfigError, RemoteError
from shmio.fabric.connection import Access, call_once
from shmio.fabric.names import CellName
from shmio.fabric.registry import Registry
from shmio.files import replace_file
from shmio.layout.document import load_layout
from shmio.layout.model import Layout
from shmio.wording import unknown

if TYPE_CHECKING:
    from nats.aio.client import Client

Text = Annotated[str, msgspec.Meta(min_length=1)]
CACHE: Final = "{}.mirrored.json"
"""Name of the file, in the folder of the logs, that keeps what the registry said about a source."""


class Settings(msgspec.Struct, frozen=True):
    """The part of the configuration that a mirror's process needs.

    Attributes:
        access: The servers.
        cell: Name of this instance in the fabric; None if it has none.
        names: For each source of this instance that mirrors a source of the same cell, its name there.

    """

    access: Access
    cell: str | None = None
    names: dict[str, str] = {}

    @property
    def sender(self) -> CellName | None:
        """The name of this instance in the fabric; None if it has none."""
        return None if self.cell is None else CellName.parse(self.cell)


class Mirror(Mirrored):
    """``connector = "fabric"``: reproduces a source of another cell. Its owner carries out the writes."""

    class Options(msgspec.Struct, forbid_unknown_fields=True):
        """Keys of the source: the cell that owns it, and its name there, by default the name of this source."""

        cell: Text
        source: Text | None = None

    def __init__(self, options: Options, name: str) -> None:
        """Check the options.

        Args:
            options: The keys of the source.
            name: Name of this source.

        Raises:
            ConfigError: ``cell`` is not the name of a cell.

        """
        try:
            self.cell = CellName.parse(options.cell)
        except ConfigError as error:
            raise ConfigError(f"cell: {error}") from None
        self.source = options.source or name

    def __str__(self) -> str:
        return f"{self.cell}/{self.source}"


class Offer(msgspec.Struct, frozen=True):
    """What a cell offers of a source: its layout, its period and its stale age, both in ns."""

    layout: Layout
    period_ns: int
    stale_ns: int


class _Stored(msgspec.Struct):
    cell: str
    source: str
    period_ns: int
    stale_ns: int
    layout: str


def offered(mirror: Mirror, access: Access, file: Path) -> tuple[Offer, str]:
    """Return what the registry says about a source; if no server answers, what ``file`` has kept.

    The function keeps an answer of the registry in ``file``.

    Returns:
        The offer, and why it may be old; empty if it comes from the registry.

    Raises:
        ConfigError: The cell or the source is not in the registry, or no server answers and the
            file has nothing about it. The message begins with the configuration key.

    """
    try:
        offer = asyncio.run(call_once(access, lambda client: _look_up(mirror, client)))
    except RemoteError as error:
        kept = _read(mirror, file)
        if kept is None:
            raise ConfigError(
                f"cell: the layout of {mirror} is not known yet: {error}; the server and the cell must run first"
            ) from None
        return kept, str(error)
    _keep(mirror, offer, file)
    return offer, ""


async def _look_up(mirror: Mirror, client: Client) -> Offer:
    registry = await Registry.open(client)
    seen = await registry.find(mirror.cell)
    if seen is None:
        names = [other.entry.cell for other in await registry.cells()]
        what = unknown("cell", str(mirror.cell), names, "the fabric")
        remedy = "start that cell first: it tells the fabric its layout"
        raise ConfigError(f"cell: {what} (or {remedy})" if what.endswith("?") else f"cell: {what}; {remedy}")
    found = seen.entry.source(mirror.source)
    if found is None:
        names = [source.name for source in seen.entry.sources]
        raise ConfigError(f"source: {unknown('source', mirror.source, names, str(mirror.cell))}")
    return Offer(await registry.layout(found.layout), found.period_ns, found.stale_ns)


def _keep(mirror: Mirror, offer: Offer, file: Path) -> None:
    text = base64.b64encode(offer.layout.to_json()).decode()
    stored = _Stored(str(mirror.cell), mirror.source, offer.period_ns, offer.stale_ns, text)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        replace_file(file, msgspec.json.encode(stored), private=False)
    except OSError:
        return  # only a start without a server would need it


def _read(mirror: Mirror, file: Path) -> Offer | None:
    try:
        stored = msgspec.json.decode(file.read_bytes(), type=_Stored)
    except (OSError, msgspec.MsgspecError):
        return None
    if (stored.cell, stored.source) != (str(mirror.cell), mirror.source):
        return None
    try:
        return Offer(load_layout(base64.b64decode(stored.layout)), stored.period_ns, stored.stale_ns)
    except ValueError:
        return None
