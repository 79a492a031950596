"""The registry of the fabric: which cells exist, who owns them, and the layouts of their sources.

It is a key-value bucket of JetStream. An uplink claims the name of its cell, and renews the entry
each ``RENEW_S``. An entry that is older than ``DEAD_S`` belongs to a cell that is down.
"""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import Sequence
from datetime import datetime
from typing import TYPE_CHECKING, Annotated, Any, Final

import msgspec
import zstandard

from shmio.errors import ConflictError, RemoteError
from shmio.fabric.names import CellName
from shmio.layout.document import load_layout
from shmio.layout.model import Layout
from shmio.libraries import library

if TYPE_CHECKING:
    from nats.aio.client import Client
    from nats.js.kv import KeyValue

CELLS: Final = "shmio_cells"
"""Bucket of the cells."""
LAYOUTS: Final = "shmio_layouts"
"""Bucket of the layouts, by their hash."""
BUCKETS: Final = (CELLS, LAYOUTS)
RENEW_S: Final = 2.0
DEAD_S: Final = 10.0
MAX_LAYOUT_BYTES: Final = 64 << 20
MAX_BUCKET_BYTES: Final = 256 << 20
"""Maximum size of a bucket, so that cells cannot fill the disk of the servers."""
MAX_REQUESTS: Final = 256
"""Maximum number of entries that are requested at the same time."""
TIMEOUT_S: Final = 5.0
ELECTION: Final = "if they are a cluster, they may be electing a leader, for which most of them must run"
"""What may be the case if servers do not answer, although they refuse nothing."""
_NO_LEADER: Final = (10008, 10009)
"""Error codes of JetStream: it is not available for the moment, and a peer is not there."""
_NO_CLUSTER: Final = 10074
"""Error code of JetStream: a single server keeps no replicas."""
_INSTALL: Final = "pip install 'shmio[fabric]'"


class SourceEntry(msgspec.Struct, frozen=True):
    """A source that a cell offers.

    Attributes:
        name: Name of the source.
        layout: Hash of the layout of its frames, in hexadecimal digits.
        period_ns: Time between two cycles, in ns.
        stale_ns: Age in ns at which a frame becomes bad.
        stream: Number of the uplink's numbering of its messages.
        quality: Present quality: good, uncertain or bad.
        reason: Why the quality is not good.
        registers: Number of registers.
        number: Number of the newest message in the stream; None if the uplink does not tell it.

    """

    name: str
    layout: str
    period_ns: int
    stale_ns: int
    stream: int
    quality: str = "bad"
    reason: str = ""
    registers: int = 0
    number: Annotated[int, msgspec.Meta(ge=0)] | None = None


class CellEntry(msgspec.Struct, frozen=True):
    """A cell in the registry.

    Attributes:
        cell: Name of the cell.
        host: Name of the host on which it runs.
        instance: Name of the instance.
        version: Version of shmio.
        epoch: Number of this start of the instance.
        state: State of the instance, such as running or degraded.
        started_utc_ns: Time of the start, UTC in ns since 1970.
        renewed_utc_ns: Time of the last renewal on the owner's clock, UTC in ns since 1970.
        web: Address of the cell's web page; empty if it has none.
        sources: The sources that the cell offers.
        note: What is wrong with the instance and its processes; empty if nothing is.
        machine: A text that tells hosts of the same name apart; empty if it is unknown.

    """

    cell: str
    host: str
    instance: str
    version: str
    epoch: str
    state: str
    started_utc_ns: int
    renewed_utc_ns: int
    web: str = ""
    sources: tuple[SourceEntry, ...] = ()
    note: str = ""
    machine: str = ""

    def source(self, name: str) -> SourceEntry | None:
        """Return the source of this name; None if the cell does not offer it."""
        return next((source for source in self.sources if source.name == name), None)


def on_same_host(one: CellEntry, other: CellEntry) -> bool:
    """Return whether two cells run on the same host, as far as known."""
    return one.host == other.host and (one.machine == other.machine or not (one.machine and other.machine))


class Seen(msgspec.Struct, frozen=True):
    """A cell as the registry has it. ``age_s`` is the time since its last renewal, by the server's clock."""

    entry: CellEntry
    age_s: float
    revision: int

    @property
    def alive(self) -> bool:
        """True if the cell has renewed its entry in time."""
        return self.age_s < DEAD_S


class Registry:
    """Reads and writes the registry through a connection."""

    def __init__(self, client: Client, cells: KeyValue, layouts: KeyValue) -> None:
        """Use :meth:`open` instead."""
        self._client = client
        self._cells = cells
        self._layouts = layouts

    @classmethod
    async def open(cls, client: Client, *, replicas: int = 1) -> Registry:
        """Open the registry, and create its buckets if they are missing.

        Args:
            client: The connection.
            replicas: Number of servers that store new buckets; a single server stores them alone.

        Raises:
            RemoteError: The server has no JetStream, or refuses access.

        """
        return cls(client, await _bucket(client, CELLS, replicas), await _bucket(client, LAYOUTS, replicas))

    async def spread(self, replicas: int) -> None:
        """Let at least this number of servers store the registry.

        Raises:
            RemoteError: The servers do not do so. The registry works as before.

        """
        errors, stream = library("nats.errors", _INSTALL), self._client.jetstream()
        for bucket in BUCKETS:
            try:
                config = (await stream.stream_info(f"KV_{bucket}")).config
                present = config.num_replicas or 1
                if present < replicas:
                    config.num_replicas = replicas
                    await stream.update_stream(config)
            except errors.Error as error:
                why = "this user may not change it" if was_refused(self._client) else _description(error)
                raise RemoteError(f"the registry is not kept by {replicas} servers: {why}") from None

    async def missing_layouts(self, digests: Sequence[bytes]) -> list[bytes]:
        """Return which of some layouts the registry does not have, by their hashes."""
        return [digest for digest in digests if not (await self._keys(LAYOUTS, digest.hex()))[0]]

    async def claim(self, entry: CellEntry) -> int:
        """Claim the name of a cell; return the revision of its entry for :meth:`renew`.

        Raises:
            ConflictError: Another instance that is alive has this name; the message names both hosts.

        """
        errors = library("nats.js.errors", _INSTALL)
        for _ in range(5):
            seen = await self.find(entry.cell)
            data = msgspec.json.encode(entry)
            try:
                if seen is None:
                    return await self._cells.create(entry.cell, data)
                other = seen.entry
                own = on_same_host(other, entry) and other.instance == entry.instance
                if seen.alive and not own and other.state != "stopped":
                    raise ConflictError(
                        f"the fabric already has a cell {entry.cell}: instance {other.instance} on host {other.host}, "
                        f"renewed {seen.age_s:.0f} s ago; this is instance {entry.instance} on host {entry.host}; "
                        "give one of them another fabric.cell"
                    )
                return await self._cells.update(entry.cell, data, last=seen.revision)
            except errors.KeyWrongLastSequenceError:
                continue  # another instance was faster: look again
        raise ConflictError(f"several instances claim the cell {entry.cell} at the same time; stop all but one")

    async def renew(self, entry: CellEntry, revision: int) -> int:
        """Renew the entry of a cell; return its new revision.

        Raises:
            ConflictError: Another instance has claimed the name since.

        """
        errors = library("nats.js.errors", _INSTALL)
        try:
            return await self._cells.update(entry.cell, msgspec.json.encode(entry), last=revision)
        except errors.KeyWrongLastSequenceError:
            return await self.claim(entry)

    async def find(self, cell: CellName | str) -> Seen | None:
        """Return a cell's entry; None if the registry does not have it."""
        _, now = await self._keys(CELLS, str(cell))
        return await self._find(str(cell), now)

    async def cells(self, most: int | None = None) -> list[Seen]:
        """Return all cells, in the order of their names; with ``most``, at most so many."""
        keys, now = await self._keys(CELLS)
        keys = keys[:most]
        found: list[Seen] = []
        for at in range(0, len(keys), MAX_REQUESTS):
            some = await asyncio.gather(*(self._find(key, now) for key in keys[at : at + MAX_REQUESTS]))
            found += [seen for seen in some if seen is not None]
        return found

    async def _find(self, key: str, now: float) -> Seen | None:
        """Return the entry with a key; ``now`` is the server's time."""
        errors = library("nats.js.errors", _INSTALL)
        try:
            message = await self._client.jetstream().get_msg(f"KV_{CELLS}", subject=f"$KV.{CELLS}.{key}")
            entry = msgspec.json.decode(message.data or b"", type=CellEntry)
        except (errors.NotFoundError, msgspec.MsgspecError):
            return None  # removed, or not from shmio
        if entry.cell != key or message.seq is None:
            return None
        age_s = 0.0 if message.time is None else max(0.0, now - message.time.timestamp())
        return Seen(entry, age_s, message.seq)

    async def _keys(self, bucket: str, pattern: str = ">") -> tuple[list[str], float]:
        """Return the keys of a bucket, sorted, and the server's time: the clocks of the hosts may differ.

        The library lists keys by a consumer. A user who may create consumers may let the server send
        what is stored to any subject, so the users of the fabric may not.

        Raises:
            nats.js.errors.Error: The server has no such bucket, or cannot tell at present.
            RemoteError: The answer is not valid.

        """
        start = f"$KV.{bucket}."
        request = msgspec.json.encode({"subjects_filter": start + pattern})
        answer = await self._client.request(f"$JS.API.STREAM.INFO.KV_{bucket}", request, timeout=TIMEOUT_S)
        try:
            info = msgspec.json.decode(answer.data, type=_StreamInfo)
            if info.error is not None:
                raise library("nats.js.errors", _INSTALL).APIError.from_error(info.error)
            now = datetime.fromisoformat(info.ts).timestamp()
        except (ValueError, TypeError) as error:  # a MsgspecError is a ValueError
            raise RemoteError(f"the server's answer about the bucket {bucket} is not valid: {error}") from None
        return sorted(subject.removeprefix(start) for subject in info.state.subjects or ()), now

    async def put_layout(self, layout: Layout) -> None:
        """Store a layout, unless the registry has it already."""
        errors = library("nats.js.errors", _INSTALL)
        try:
            await self._layouts.create(layout.hash.hex(), zstandard.compress(layout.to_json()))
        except errors.KeyWrongLastSequenceError:
            return

    async def layout_like(self, head: bytes) -> Layout:
        """Return the layout whose hash begins with these bytes.

        Raises:
            RemoteError: The registry does not have it, or it is damaged.

        """
        keys, _ = await self._keys(LAYOUTS)
        return await self.layout(next((key for key in keys if key.startswith(head.hex())), head.hex()))

    async def layout(self, digest: str) -> Layout:
        """Return the layout with a hash.

        Raises:
            RemoteError: The registry does not have it, or it is damaged.

        """
        errors = library("nats.js.errors", _INSTALL)
        try:
            found = await self._layouts.get(digest)
        except errors.KeyNotFoundError:
            raise RemoteError(f"the fabric has no layout {digest[:16]}; restart the cell that offers it") from None
        try:
            data = _unpack(found.value or b"")
        except zstandard.ZstdError as error:
            raise RemoteError(f"the layout {digest[:16]} in the fabric is damaged: {error}") from None
        if hashlib.sha256(data).hexdigest() != digest:
            raise RemoteError(f"the layout {digest[:16]} in the fabric is damaged: its hash is wrong")
        return load_layout(data)


class _StreamState(msgspec.Struct):
    subjects: dict[str, int] | None = None


def _unpack(packed: bytes) -> bytes:
    """Return the uncompressed bytes of a layout, at most ``MAX_LAYOUT_BYTES``.

    Raises:
        ZstdError: The data are damaged or too large.

    """
    size = zstandard.get_frame_parameters(packed).content_size
    if size not in (zstandard.CONTENTSIZE_UNKNOWN, zstandard.CONTENTSIZE_ERROR) and size > MAX_LAYOUT_BYTES:
        raise zstandard.ZstdError(f"it has {size} bytes")  # the library's limit does not apply to a size in the frame
    return zstandard.ZstdDecompressor().decompress(packed, max_output_size=MAX_LAYOUT_BYTES)


class _StreamInfo(msgspec.Struct):
    ts: str = ""
    state: _StreamState = msgspec.field(default_factory=_StreamState)
    error: dict[str, Any] | None = None


async def _bucket(client: Client, name: str, replicas: int) -> KeyValue:
    errors = library("nats.js.errors", _INSTALL)
    nats_errors = library("nats.errors", _INSTALL)
    stream = client.jetstream()
    try:
        try:
            return await stream.key_value(name)
        except errors.BucketNotFoundError:
            await _create(client, name, replicas)
            return await stream.key_value(name)
    except (errors.APIError, nats_errors.TimeoutError, nats_errors.NoRespondersError) as error:
        if is_away(error):
            raise RemoteError(f"the NATS servers do not answer about the bucket {name}; {ELECTION}") from None
        if isinstance(error, errors.ServiceUnavailableError | nats_errors.NoRespondersError):
            raise RemoteError(
                "the NATS server has no JetStream; start it with -js, or set jetstream in its file"
            ) from None
        if isinstance(error, nats_errors.TimeoutError) and not was_refused(client):
            raise RemoteError(f"the NATS servers do not answer about the bucket {name}; {ELECTION}") from None
        raise RemoteError(
            f"the NATS server does not give access to its bucket {name}: {error}; if shmio fabric server-config made "
            "its configuration, run shmio fabric prepare once with the administrator's seed"
        ) from None


def was_refused(client: Client) -> bool:
    """Return whether the server has refused something to this client."""
    return bool(getattr(client, "refused", ""))


def _description(error: Exception) -> str:
    return str(getattr(error, "description", None) or error or type(error).__name__)


def is_away(error: Exception) -> bool:
    """Return whether an error of JetStream means that the servers of a cluster have no leader at present."""
    return getattr(error, "err_code", None) in _NO_LEADER


async def _create(client: Client, name: str, replicas: int) -> None:
    """Create a bucket. A layout is stored once: nobody can replace it.

    Roll-ups are not allowed: by them, a cell that may write only its own key could remove all others.
    """
    api = library("nats.js.api", _INSTALL)
    config = api.StreamConfig(
        name=f"KV_{name}",
        subjects=[f"$KV.{name}.>"],
        discard=api.DiscardPolicy.NEW,
        discard_new_per_subject=name == LAYOUTS,
        max_msgs_per_subject=1,
        allow_rollup_hdrs=False,
        deny_delete=True,
        num_replicas=replicas,
        max_bytes=MAX_BUCKET_BYTES,
    )
    try:
        await client.jetstream().add_stream(config)
    except library("nats.js.errors", _INSTALL).APIError as error:
        if replicas == 1 or error.err_code != _NO_CLUSTER:
            raise
        config.num_replicas = 1
        await client.jetstream().add_stream(config)
