"""The layout of a mirror: from the registry, or from a file."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from pathlib import Path

import pytest

from shmio.errors import ConfigError
from shmio.fabric.connection import Access, connect
from shmio.fabric.registry import CellEntry, Registry, SourceEntry
from shmio.plan.prepare import prepare
from shmio.plan.processes import Plan
from shmio.segment import BlockSpec
from tests.nats_server import NatsServer, nats_server
from tests.unit.plan.test_fabric import BLOCK, SOURCE

NEAR = "plant1.line3.near"
MIRROR = (
    '[instance]\nname = "far"\nlog_dir = "logs"\n[fabric]\nserver = "{}"\ncell = "plant1.line3.far"\n'
    '[[source]]\nname = "cell"\nconnector = "fabric"\ncell = "{}"\n'
)
FILE = 'layout = "x.db"\n'


@pytest.fixture
def owner(tmp_path: Path) -> BlockSpec:
    """The block of the owner, which has a layout from a file."""
    (tmp_path / "cell.db").write_text(BLOCK)
    (tmp_path / "owner.toml").write_text(SOURCE + "period_ms = 40\n")
    (block,) = prepare(tmp_path / "owner.toml").plan.blocks
    return block


@pytest.fixture
def server(tmp_path: Path, owner: BlockSpec) -> Iterator[NatsServer]:
    with nats_server(tmp_path / "nats") as server:
        offer(server, owner)
        yield server


def offer(server: NatsServer, owner: BlockSpec) -> None:
    """Tell the registry that the cell ``NEAR`` has this source."""

    async def claim() -> None:
        client = await connect(Access((server.url,)), "test", patient=False)
        registry = await Registry.open(client)
        await registry.put_layout(owner.layout)
        source = SourceEntry(owner.source, owner.layout.hash.hex(), owner.period_ns, owner.stale_ns, 1)
        await registry.claim(CellEntry(NEAR, "host1", "near", "0.1", "1", "running", 1, 2, "", (source,)))
        await client.close()

    asyncio.run(claim())


def plan(folder: Path, url: str, layout: str = "", cell: str = NEAR) -> Plan:
    (folder / "x.db").write_text(layout or BLOCK)
    (folder / "far.toml").write_text(MIRROR.format(url, cell) + (FILE if layout else ""))
    return prepare(folder / "far.toml").plan


def test_a_file_has_the_layout_with_and_without_a_server(tmp_path: Path, owner: BlockSpec, server: NatsServer) -> None:
    found = plan(tmp_path, server.url, BLOCK)
    assert [(one.layout.hash, one.period_ns) for one in found.blocks] == [(owner.layout.hash, owner.period_ns)]
    assert found.warnings == ()
    (warning,) = plan(tmp_path, server.url, BLOCK, "plant1.line3.neer").warnings
    assert "did you mean 'plant1.line3.near'" in warning
    server.stop()
    (tmp_path / "logs/cell.mirrored.json").unlink()
    found = plan(tmp_path, server.url, BLOCK)
    assert [one.layout.hash for one in found.blocks] == [owner.layout.hash]
    assert "no NATS server can be reached" in found.warnings[0]
    with pytest.raises(ConfigError, match=r"source\[0\]\.cell: the layout of .* is not known yet: .*server"):
        plan(tmp_path, server.url)


def test_another_layout_than_the_owners_is_refused(tmp_path: Path, server: NatsServer) -> None:
    other = BLOCK.replace("Level : Real", "Level : DInt")
    with pytest.raises(
        ConfigError, match=rf"source\[0\]\.layout: {NEAR}/cell has another layout; use the owner's file"
    ):
        plan(tmp_path, server.url, other)


def test_the_owner_knows_the_encoding_of_its_texts(tmp_path: Path, server: NatsServer, owner: BlockSpec) -> None:
    """Also an owner of a version that stored no encodings; a key of the mirror counts."""
    text = BLOCK.replace("Level : Real", "Level : String[2]")
    (tmp_path / "cell.db").write_text(text)
    for more, wanted in {'encoding = "gbk"\n': "gbk", 'encoding = "iso-8859-1"\n': ""}.items():
        (tmp_path / "owner.toml").write_text(SOURCE + more)
        (owner,) = prepare(tmp_path / "owner.toml").plan.blocks
        offer(server, owner)
        (mirror,) = plan(tmp_path, server.url, text).blocks
        assert wanted in {one.encoding for one in mirror.layout.registers}
        assert mirror.layout.hash == owner.layout.hash
    (tmp_path / "far.toml").write_text((tmp_path / "far.toml").read_text() + 'encoding = "cp949"\n')
    with pytest.raises(ConfigError, match="has another layout"):
        prepare(tmp_path / "far.toml")


def test_the_owners_table_makes_nothing_writable_here(tmp_path: Path, server: NatsServer) -> None:
    table = '[registers]\nlamp = { type = "BOOL", writable = true }\nspeed = { type = "REAL", writable = true }\n'
    (tmp_path / "belt.toml").write_text(table)
    (tmp_path / "owner.toml").write_text(
        '[instance]\nname = "near"\n[[source]]\nname = "belt"\nconnector = "memory"\ntags = "belt.toml"\n'
    )
    (owner,) = prepare(tmp_path / "owner.toml").plan.blocks
    assert owner.attributes.writable == ("lamp", "speed")
    offer(server, owner)
    for own, writable in (("", ()), ('writable = ["speed"]\n', ("speed",)), ('layout = "belt.toml"\n', ())):
        (tmp_path / "far.toml").write_text(MIRROR.format(server.url, NEAR).replace('"cell"', '"belt"', 1) + own)
        (mirror,) = prepare(tmp_path / "far.toml").plan.blocks
        assert (mirror.layout.hash, mirror.attributes.writable) == (owner.layout.hash, writable), own


def test_a_malformed_and_an_absent_cell_are_named_with_their_key(tmp_path: Path, server: NatsServer) -> None:
    file = tmp_path / "far.toml"
    for cell, words in (
        ("a50", r"far\.toml:10: source\[0\]\.cell: .*a50"),
        ("plant1.line3.absent", r"far\.toml:10: source\[0\]\.cell: .*start that cell first"),
    ):
        file.write_text(MIRROR.format(server.url, cell))
        with pytest.raises(ConfigError, match=words):
            prepare(file)


@pytest.mark.parametrize("keys", [{"jetstream": None}, {"authorization": {"user": "a", "password": "b"}}])
def test_a_server_that_refuses_is_not_taken_for_one_that_does_not_run(
    tmp_path: Path, owner: BlockSpec, keys: dict[str, object]
) -> None:
    words = r"has no JetStream; start it with -js|fabric\.credentials"
    with nats_server(tmp_path / "nats", **keys) as server, pytest.raises(ConfigError, match=words):
        plan(tmp_path, server.url)
