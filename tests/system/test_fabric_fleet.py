"""``shmio fabric``: the commands that show all cells, against a real server."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from shmio.cli.user import main
from shmio.fabric.connection import Access, connect
from shmio.fabric.registry import CellEntry, Registry, SourceEntry
from shmio.layout.model import Layout, Register
from shmio.version import __version__
from tests.nats_server import NatsServer, nats_server

LAYOUT = Layout(
    "DB1", 1, 4, False, (Register("a", "INT", (), 0, None, 2, 1), Register("b/c", "INT", (), 2, None, 2, 1))
)
NEAR, FAR = "plant1.line3.a50", "plant1.line3.b60"


@pytest.fixture
def server(tmp_path: Path) -> Iterator[NatsServer]:
    with nats_server(tmp_path / "nats") as server:
        yield server


def entry(cell: str, **more: Any) -> CellEntry:
    told: dict[str, Any] = {"version": __version__, "state": "running", "quality": "good", "reason": ""} | more
    source = SourceEntry("cell", LAYOUT.hash.hex(), 20_000_000, 500_000_000, 7, told["quality"], told["reason"], 2)
    return CellEntry(cell, "near", "a50", told["version"], "0", told["state"], 1, 2, sources=(source,))


def register(server: NatsServer, *entries: CellEntry) -> None:
    async def work() -> None:
        client = await connect(Access((server.url,)), "test", patient=False)
        registry = await Registry.open(client)
        await registry.put_layout(LAYOUT)
        for one in entries:
            await registry.claim(one)
        await client.close()

    asyncio.run(work())


def run(server: NatsServer, *words: str) -> int:
    return main(["fabric", words[0], "--server", server.url, *words[1:]])


def test_cells_are_listed_with_what_is_wrong(server: NatsServer, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(server, "cells") == 0
    assert "no cells yet" in capsys.readouterr().out
    register(server, entry(NEAR), entry(FAR, version="0.1", quality="bad", reason="the PLC is off"))
    assert run(server, "cells") == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[:2] for line in lines[1:]] == [[NEAR, "running"], [FAR, "running"]]
    assert "version 0.1" in lines[2]
    assert "cell is bad (the PLC is off)" in lines[2]
    assert run(server, "cells", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert [one["cell"] for one in found] == [NEAR, FAR]
    assert found[1]["notes"]


def test_status_shows_sources_and_names_similar_cells(server: NatsServer, capsys: pytest.CaptureFixture[str]) -> None:
    register(server, entry(NEAR), entry(FAR, state="stopped"))
    assert run(server, "status", NEAR) == 0
    out = capsys.readouterr().out
    assert "instance a50 on near" in out
    assert "20 ms" in out
    assert run(server, "status", FAR) == 1  # stopped
    assert run(server, "status", "plant1.line3.a5") == 1
    assert f"did you mean '{NEAR}'" in capsys.readouterr().err
    assert run(server, "status", "a50") == 1
    assert "plant.line.cell" in capsys.readouterr().err


def test_an_unreachable_server_is_named(server: NatsServer, capsys: pytest.CaptureFixture[str]) -> None:
    server.stop()
    assert run(server, "cells", "--json") == 1
    assert f"{server.url}: no NATS server can be reached" in json.loads(capsys.readouterr().out)["error"]


def test_the_configuration_names_the_server(
    server: NatsServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "supervisor.toml"
    file.write_text('[instance]\nname = "x"\n')
    assert main(["fabric", "cells"]) == 1
    assert "name a server with --server" in capsys.readouterr().err
    file.write_text(f'[instance]\nname = "x"\n[fabric]\nserver = "{server.url}"\n')
    assert main(["fabric", "cells"]) == 0
    assert main(["fabric", "cells", "--credentials", "x.seed"]) == 1
    assert "--credentials: this option needs --server" in capsys.readouterr().err
