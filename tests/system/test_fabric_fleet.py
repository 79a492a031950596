"""``shmio fabric``: the commands that show all cells, against a real server."""

from __future__ import annotations

import asyncio
import json
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from shmio.cli.user import main
from shmio.fabric.connection import Access, connect
from shmio.fabric.messages import Header, encode
from shmio.fabric.names import CellName
from shmio.fabric.registry import CellEntry, Registry, SourceEntry
from shmio.layout.model import Layout, Register
from shmio.segment import Frame, Provenance, Quality
from shmio.version import __version__
from tests.nats_server import NatsServer, nats_server

LAYOUT = Layout(
    "DB1", 1, 4, False, (Register("a", "INT", (), 0, None, 2, 1), Register("b/c", "INT", (), 2, None, 2, 1))
)
NEAR, FAR, EMPTY = "plant1.line3.a50", "plant1.line3.b60", "plant1.line3.c70"


@pytest.fixture
def server(tmp_path: Path) -> Iterator[NatsServer]:
    with nats_server(tmp_path / "nats") as server:
        yield server


def entry(cell: str, **more: Any) -> CellEntry:
    told: dict[str, Any] = {"version": __version__, "state": "running", "quality": "good", "reason": ""} | more
    source = SourceEntry("cell", LAYOUT.hash.hex(), 20_000_000, 500_000_000, 7, told["quality"], told["reason"], 2)
    return CellEntry(
        cell, "near", "a50", told["version"], "0", told["state"], 1, 2, sources=told.get("sources", (source,))
    )


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
    assert "QUALITY" in out
    assert run(server, "status", FAR) == 1  # stopped
    register(server, entry(EMPTY, sources=()))
    capsys.readouterr()
    assert run(server, "status", EMPTY) == 0
    assert "QUALITY" not in capsys.readouterr().out
    assert run(server, "status", "plant1.line3.a5") == 1
    assert f"did you mean '{NEAR}'" in capsys.readouterr().err
    assert run(server, "status", "a50") == 1
    assert "plant.line.cell" in capsys.readouterr().err


def test_an_unreachable_server_is_named(server: NatsServer, capsys: pytest.CaptureFixture[str]) -> None:
    server.stop()
    assert run(server, "cells", "--json") == 1
    assert f"{server.url}: no NATS server can be reached" in json.loads(capsys.readouterr().out)["error"]
    assert run(server, "cells") == 1
    assert len(capsys.readouterr().err.splitlines()) == 1


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


def frame(number: int, a: int, c: int, quality: Quality = Quality.GOOD, effective: bytes | None = None) -> Frame:
    now_ns = time.time_ns()
    return Frame(
        number, number, number, number, now_ns, 1, quality, Provenance.LIVE, 0, 0, "" if quality else "off",
        struct.pack(">hh", a, c), effective,
    )  # fmt: skip


def message(number: int, *frames: Frame, made_ns: int | None = None) -> bytes:
    made_ns = time.time_ns() if made_ns is None else made_ns
    return bytes(encode(Header(0, 7, number, LAYOUT.hash[:8], made_ns), frames))


@contextmanager
def publishing(server: NatsServer, cell: str, messages: Callable[[int], bytes | None]) -> Iterator[None]:
    """Publish live messages 1, 2, … of a cell's source, until the block ends; None publishes nothing."""
    ended = threading.Event()

    async def publish() -> None:
        client = await connect(Access((server.url,)), "uplink", patient=False)
        number = 0
        while not ended.is_set():
            number += 1
            if (data := messages(number)) is not None:
                await client.publish(CellName.parse(cell).live("cell"), data)
                await client.flush()
            await asyncio.sleep(0.02)
        await client.close()

    thread = threading.Thread(target=lambda: asyncio.run(publish()))
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def test_watch_prints_changes_of_any_cell(server: NatsServer, capsys: pytest.CaptureFixture[str]) -> None:
    register(server, entry(NEAR), entry(FAR))
    with (
        publishing(server, NEAR, lambda number: message(number, frame(number, number // 10, 5))),
        publishing(server, FAR, lambda number: message(number, frame(number, 1, 7))),
    ):
        assert run(server, "watch", "plant1.*.*/cell/b/c", f"{NEAR}/cell/a", "--json", "-n", "6") == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    values = [(one["path"], one["value"]) for one in lines]
    assert values.count((f"{NEAR}/cell/b/c", 5)) == values.count((f"{FAR}/cell/b/c", 7)) == 1, (
        "only changes are printed"
    )
    counts = [value for path, value in values if path == f"{NEAR}/cell/a"]
    assert counts == list(range(counts[0], counts[0] + 4))
    assert all(one["quality"] == "good" for one in lines)


def test_watch_shows_bad_values_and_silent_sources(server: NatsServer, capsys: pytest.CaptureFixture[str]) -> None:
    register(server, entry(NEAR))

    def some(number: int) -> bytes | None:
        quality = Quality.BAD if number == 5 else Quality.GOOD
        effective = struct.pack(">hh", 9, 0) if number == 7 else None
        return message(number, frame(number, 1, 0, quality, effective)) if number >= 3 and number < 20 else None

    with publishing(server, NEAR, some):
        assert run(server, "watch", f"{NEAR}/cell/a", "-n", "6") == 0
    lines = capsys.readouterr().out.splitlines()
    shown = [line.split(f"{NEAR}/cell/a")[1].split() for line in lines]
    assert [words[:2] for words in shown[:5]] == [["1"], ["1", "bad:"], ["1"], ["9", "(injected)"], ["1"]]
    assert "stale: no message for" in lines[5]


def test_watch_survives_hostile_messages(server: NatsServer, capsys: pytest.CaptureFixture[str]) -> None:
    register(server, entry(NEAR))
    short = frame(1, 1, 1)._replace(raw=b"x")

    def some(number: int) -> bytes:
        good = message(number, frame(number, number, 0))
        return (b"junk", good[:-3], message(number, short), bytes(200), good)[number % 5]

    with publishing(server, NEAR, some):
        assert run(server, "watch", f"{NEAR}/cell/a", "-n", "3") == 0
    out = capsys.readouterr()
    assert len(out.out.splitlines()) == 3
    assert len(out.err.splitlines()) == 1, "a faulty source is named once"


def test_watch_names_unknown_cells_and_registers(server: NatsServer, capsys: pytest.CaptureFixture[str]) -> None:
    register(server, entry(NEAR))
    for pattern, words in (
        ("plant2.*.*/cell/a", "plant2.*.*: the fabric has no such cell"),
        (f"{NEAR}/cell/nothing", f"{NEAR}: cell/nothing"),
        ("a50/cell/a", "plant.line.cell/source/register"),
        (NEAR, "plant.line.cell/source/register"),
    ):
        assert run(server, "watch", pattern) == 1
        assert words in capsys.readouterr().err


def test_top_counts_frames_bytes_and_missing_messages(server: NatsServer, capsys: pytest.CaptureFixture[str]) -> None:
    register(server, entry(NEAR), entry(FAR, state="stopped"))

    def some(number: int) -> bytes | None:
        if number % 10 == 0:
            return None  # a message that does not come
        late_ns = time.time_ns() - 3_000_000_000
        return message(number, frame(number, 1, 1), frame(number, 2, 2), made_ns=late_ns)

    with publishing(server, NEAR, some):
        assert run(server, "top", "--every", "0.5", "-n", "2", "--json") == 0
        assert run(server, "top", "--every", "0.3", "-n", "1") == 0
    out = capsys.readouterr().out.splitlines()
    found = [json.loads(line) for line in out if line.startswith("{")]
    near, far = found[2:4]
    assert (near["source"], far["source"]) == (f"{NEAR}/cell", f"{FAR}/cell")
    assert near["frames_per_s"] > 10
    assert near["kb_per_s"] > 0
    assert near["lag_ms"] >= 3000
    assert near["lost"] >= 1
    assert (far["frames_per_s"], far["quality"], far["reason"]) == (0, "bad", "the cell is stopped")
    assert "1 running, 1 stopped" in "\n".join(out)
