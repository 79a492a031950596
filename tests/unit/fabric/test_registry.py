"""The registry of the fabric, on a real server: claims of a cell's name, and layouts."""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path

import msgspec
import pytest
import zstandard

from shmio.errors import ConflictError, RemoteError
from shmio.fabric import registry as module
from shmio.fabric.connection import Access, connect
from shmio.fabric.registry import LAYOUTS, MAX_LAYOUT_BYTES, CellEntry, Registry, SourceEntry
from shmio.layout.model import Layout, Register
from tests.nats_server import nats_server

ENTRY = CellEntry("plant1.line3.a50", "host1", "a50", "0.1", "1", "running", 1, 2)
LAYOUT = Layout("DB1", 1, 2, False, (Register("count", "INT", (), 0, None, 2, 1),))

Run = Callable[[Callable[[Registry], Awaitable[None]]], None]


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    folder: Path = tmp_path_factory.mktemp("nats")
    with nats_server(folder) as server:
        yield server.url


@pytest.fixture
def run(url: str) -> Run:
    def run(work: Callable[[Registry], Awaitable[None]]) -> None:
        async def connected() -> None:
            client = await connect(Access((url,)), "test", patient=False)
            try:
                await work(await Registry.open(client))
            finally:
                await client.close()

        asyncio.run(connected())

    return run


def named(name: str, **other: str) -> CellEntry:
    return msgspec.structs.replace(ENTRY, cell=f"plant1.line3.{name}", **other)


def test_a_second_living_cell_of_the_same_name_is_refused_naming_both_hosts(run: Run) -> None:
    async def work(registry: Registry) -> None:
        first = named("twice")
        revision = await registry.claim(first)
        with pytest.raises(ConflictError, match=r"(?s)host1.*host2"):
            await registry.claim(named("twice", host="host2"))
        one = named("thrice", machine="11")
        await registry.claim(one)
        with pytest.raises(ConflictError, match=r"(?s)host1.*host1"):
            await registry.claim(named("thrice", machine="22"))
        await registry.claim(one)
        await registry.renew(first, revision)

    run(work)


def test_the_same_instance_claims_its_name_again(run: Run) -> None:
    async def work(registry: Registry) -> None:
        await registry.claim(named("again"))
        await registry.claim(named("again", epoch="2"))
        seen = await registry.find("plant1.line3.again")
        assert seen is not None
        assert (seen.entry.epoch, seen.alive) == ("2", True)

    run(work)


def test_a_stopped_or_dead_cell_gives_its_name_away_and_then_cannot_renew(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def work(registry: Registry) -> None:
        await registry.claim(named("stopped", state="stopped"))
        await registry.claim(named("stopped", host="host2"))
        revision = await registry.claim(named("dead"))
        with monkeypatch.context() as patch:
            patch.setattr(module, "DEAD_S", 0.0)
            await registry.claim(named("dead", host="host2"))
        with pytest.raises(ConflictError, match="host2"):
            await registry.renew(named("dead"), revision)

    run(work)


def test_a_layout_is_stored_once_and_read_again(run: Run) -> None:
    async def work(registry: Registry) -> None:
        await registry.put_layout(LAYOUT)
        await registry.put_layout(LAYOUT)
        found = await registry.layout(LAYOUT.hash.hex())
        assert (found.hash, found.registers) == (LAYOUT.hash, LAYOUT.registers)
        with pytest.raises(RemoteError, match="no layout"):
            await registry.layout("00" * 32)

    run(work)


def _bomb() -> bytes:
    """Return few bytes that say that they are larger than any layout."""
    packer = zstandard.ZstdCompressor().compressobj(size=MAX_LAYOUT_BYTES + (1 << 20))
    zeros = bytes(1 << 20)
    parts = [packer.compress(zeros) for _ in range(MAX_LAYOUT_BYTES // len(zeros) + 1)]
    return b"".join([*parts, packer.flush()])


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"no zstandard", "damaged"),
        (zstandard.compress(b"{}"), "hash"),
        (_bomb(), "bytes"),
    ],
)
def test_damaged_layouts_are_refused(run: Run, url: str, data: bytes, why: str) -> None:
    digest = hashlib.sha256(data).hexdigest()

    async def work(registry: Registry) -> None:
        client = await connect(Access((url,)), "forger", patient=False)
        try:
            await (await client.jetstream().key_value(LAYOUTS)).create(digest, data)
        finally:
            await client.close()
        with pytest.raises(RemoteError, match=why):
            await registry.layout(digest)

    run(work)


def test_a_source_of_an_uplink_that_numbers_nothing_has_no_number() -> None:
    entry = {"name": "cell", "layout": "00", "period_ns": 1, "stale_ns": 2, "stream": 7}
    assert msgspec.convert(entry, SourceEntry).number is None
    with pytest.raises(msgspec.ValidationError, match="number"):
        msgspec.convert(entry | {"number": -1}, SourceEntry)
