"""Servers that refuse an uplink or a mirror: the reason is shown, and the attempts go on."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from shmio.connectors.fabric.link import Link
from shmio.fabric.connection import Access
from shmio.fabric.names import CellName
from shmio.libraries import library
from shmio.segment import Segment
from tests.nats_server import NatsServer, nats_server
from tests.unit.endpoints.fabric.harness import CELL, in_loop, publish, until, uplink


class Users:
    """Two users, of which a server knows the first one."""

    def __init__(self, folder: Path) -> None:
        self.known, self.unknown = folder / "known.seed", folder / "unknown.seed"
        nkeys = library("nkeys", "test")
        self._keys: dict[Path, str] = {}
        for file, byte in ((self.known, b"k"), (self.unknown, b"u")):
            seed = nkeys.encode_seed(byte * 32, nkeys.PREFIX_BYTE_USER)
            file.write_bytes(seed)
            file.chmod(0o600)
            self._keys[file] = nkeys.from_seed(bytearray(seed)).public_key.decode()

    def authorization(self, *files: Path) -> dict[str, Any]:
        """Return the server's section that lets some users connect."""
        return {"users": [{"nkey": self._keys[file]} for file in files]}


@pytest.fixture
def users(tmp_path: Path) -> Users:
    return Users(tmp_path)


@pytest.fixture
def guarded(tmp_path: Path, users: Users) -> Iterator[NatsServer]:
    with nats_server(tmp_path / "nats", authorization=users.authorization(users.known)) as server:
        yield server


def attempts(server: NatsServer) -> int:
    return server.log().count("authentication error")


@in_loop
async def test_an_uplink_names_the_refused_file_and_keeps_trying(
    segment: Segment, guarded: NatsServer, users: Users, caplog: pytest.LogCaptureFixture
) -> None:
    """The server does not know the user, then it does, then it removes it, then it knows it again."""
    caplog.set_level(logging.INFO, "shmio.fabric")
    both = users.authorization(users.known, users.unknown)
    async with uplink(segment, guarded.url, credentials=str(users.unknown)) as found:
        for refused in (1, 2):
            tried = attempts(guarded)
            await until(lambda: attempts(guarded) >= tried + 3)  # noqa: B023
            assert f"{guarded.url}: the server does not know the credentials in {users.unknown}" in found.problem
            publish(segment.writer("cell"), refused)
            guarded.reload(authorization=both)
            await until(lambda: found.publisher.up and not found.backlog.waiting)
            assert found.problem == ""
            if refused == 1:
                guarded.reload(authorization=users.authorization(users.known))
                await until(lambda: not found.publisher.up)
    lines = [record.getMessage() for record in caplog.records if "does not know the credentials" in record.getMessage()]
    assert len(lines) <= 3, lines


@in_loop
async def test_an_uplink_names_the_seed_of_another_cell(
    segment: Segment, guarded: NatsServer, users: Users, caplog: pytest.LogCaptureFixture
) -> None:
    """The registry exists, and the user may publish neither to it nor the cell's subjects; then it may."""
    may = {"deny": ["shmio.plant1.>", "$KV.shmio_cells.plant1.>"]}
    section = users.authorization(users.known, users.unknown)
    section["users"][0]["permissions"] = {"publish": may}
    guarded.reload(authorization=section)
    async with uplink(segment, guarded.url, credentials=str(users.known)) as found:
        await until(lambda: f"{users.known} may not publish as {CELL}; use the seed of this cell" in found.problem)
        assert f"may not publish as {CELL}; use the seed" in caplog.text
        guarded.reload(authorization=users.authorization(users.known))
        await until(lambda: found.publisher.up)
        assert found.problem == ""


@in_loop
async def test_an_uplink_without_credentials_learns_which_key_it_needs(segment: Segment, guarded: NatsServer) -> None:
    async with uplink(segment, guarded.url) as found:
        await until(lambda: "name the file with this host's seed in fabric.credentials" in found.problem)


def test_the_link_of_a_mirror_tells_why_it_is_refused(guarded: NatsServer, users: Users) -> None:
    access = Access((guarded.url,), credentials=str(users.unknown))
    link = Link(access, CellName.parse(CELL), "cell", "mirror", None, lambda _: None, lambda _: None)
    link.start()
    try:
        asyncio.run(until(lambda: str(users.unknown) in link.problem))
        assert not link.connected
        guarded.reload(authorization=users.authorization(users.unknown))
        asyncio.run(until(lambda: link.connected))
    finally:
        link.close()


@in_loop
async def test_an_uplink_says_that_a_server_has_no_jetstream(segment: Segment, tmp_path: Path) -> None:
    with nats_server(tmp_path / "nats", jetstream=None) as server:
        async with uplink(segment, server.url) as found:
            await until(lambda: "has no JetStream; start it with -js" in found.problem)
            assert "does not answer" not in found.problem
