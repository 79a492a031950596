from __future__ import annotations

import asyncio
import json
import socket
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import pytest

from shmio.endpoints.web import cells
from shmio.fabric.connection import Access, connect
from shmio.fabric.registry import CellEntry, Registry, SourceEntry
from shmio.segment import Segment
from shmio.testing.ports import reserved_port
from shmio.version import __version__
from tests.nats_server import Link, NatsServer, nats_server
from tests.unit.endpoints.web.harness import TIMEOUT_S
from tests.unit.endpoints.web.tabs.test_injections import pushed
from tests.unit.endpoints.web.test_page import SECRETS, TOKEN, pages, said

NEAR, FAR = "plant1.line3.a50", "plant1.line3.b60"
HOSTILE = '<img src=x onerror="alert(1)">'


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cells, "INTERVAL_S", 0.05)


@pytest.fixture
def monitor() -> Iterator[int]:
    """The port at which the server says who is connected."""
    with reserved_port() as address:
        yield address.port


@pytest.fixture
def server(tmp_path: Path, monitor: int) -> Iterator[NatsServer]:
    with nats_server(tmp_path / "nats", http=f"127.0.0.1:{monitor}") as server:
        yield server


def fabric(server: NatsServer) -> dict[str, Any]:
    return {"servers": [server.url]}


def register(server: NatsServer, *entries: CellEntry) -> None:
    async def work() -> None:
        client = await connect(Access((server.url,)), "test", patient=False)
        registry = await Registry.open(client)
        for one in entries:
            await registry.claim(one)
        await client.close()

    asyncio.run(work())


def entry(cell: str, host: str = "far", instance: str = "b60", quality: str = "good", **more: Any) -> CellEntry:
    source = SourceEntry("cell", "00", 1, 1, 1, quality, "" if quality == "good" else "the PLC is off")
    given = {"version": __version__, "state": "running"} | more
    return CellEntry(cell, host, instance, epoch="0", started_utc_ns=1, renewed_utc_ns=2, sources=(source,), **given)


def connections(monitor: int) -> int:
    with urllib.request.urlopen(f"http://127.0.0.1:{monitor}/connz", timeout=10) as answer:
        return sum(one["name"].startswith("shmio page") for one in json.load(answer)["connections"])


def test_tab_is_absent_without_a_fabric(segment: Segment) -> None:
    with pages(segment) as served, served.open() as browser:
        assert "cells" not in json.loads(served.request("GET", "/session")[2])["tabs"]
        assert "unknown call" in said(browser, "cells.follow")["error"]


def test_page_lists_all_cells_and_says_how_to_open_each(segment: Segment, server: NatsServer) -> None:
    own = socket.gethostname()
    register(
        server,
        entry(NEAR, own, segment.instance, web="http://127.0.0.1:8080"),
        entry(FAR, quality="bad", version="0.1", web="http://10.76.0.9:8080"),
        entry("plant1.line3.c70", web="http://127.0.0.1:8080"),
        entry("plant1.line3.d80", own, "d80", web="http://127.0.0.1:8081"),
    )
    with pages(segment, fabric=fabric(server)) as served, served.open() as browser:
        assert "cells" in json.loads(served.request("GET", "/session")[2])["tabs"]
        said(browser, "cells.follow")
        found = pushed(browser, "cells")
        assert (found["problem"], found["more"], found["version"]) == ("", False, __version__)
        near, far, hidden, local = found["cells"]
        assert (near["cell"], near["state"], near["qualities"], near["notes"]) == (NEAR, "running", {"good": 1}, [])
        assert (near["url"], near["why"]) == ("", "this page")
        assert (far["host"], far["instance"], far["version"], far["url"]) == (
            "far",
            "b60",
            "0.1",
            "http://10.76.0.9:8080/",
        )
        assert far["qualities"] == {"bad": 1}
        assert "the PLC is off" in far["notes"][1]
        assert hidden["url"] == ""
        assert "only on the host far" in hidden["why"]
        assert local["url"] == "http://127.0.0.1:8081/"
        register(server, entry("plant1.line3.e90"))
        while len(pushed(browser, "cells")["cells"]) < 5:
            pass


def test_pages_share_one_connection_that_ends_with_the_last(segment: Segment, server: NatsServer, monitor: int) -> None:
    register(server, entry(NEAR))
    with pages(segment, fabric=fabric(server)) as served, ExitStack() as stack:
        first, second = (stack.enter_context(served.open()) for _ in range(2))
        said(first, "overview.follow")
        assert connections(monitor) == 0  # no page shows the cells
        for browser in (first, second):
            said(browser, "cells.follow")
            assert pushed(browser, "cells")["cells"]
        assert connections(monitor) == 1
        said(first, "cells.leave")
        assert pushed(second, "cells")["cells"]
        assert connections(monitor) == 1
        second.close()
        while connections(monitor):
            pass
        register(server, entry(FAR))
        said(first, "cells.follow")
        assert [one["cell"] for one in pushed(first, "cells")["cells"]] == [NEAR, FAR]  # not what was read earlier


def test_user_who_returns_to_the_tab_need_not_wait_for_the_next_reading(
    segment: Segment, server: NatsServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cells, "INTERVAL_S", 10.0 * TIMEOUT_S)
    register(server, entry(NEAR))
    with pages(segment, fabric=fabric(server)) as served, served.open() as browser:
        for _ in range(2):
            said(browser, "cells.follow")
            assert pushed(browser, "cells")["cells"]
            said(browser, "cells.leave")


def test_lost_server_is_named_and_the_list_comes_back(segment: Segment, server: NatsServer) -> None:
    register(server, entry(NEAR))
    with pages(segment, fabric=fabric(server)) as served, served.open() as browser:
        said(browser, "cells.follow")
        assert pushed(browser, "cells")["cells"]
        server.stop()
        while f"{server.url}: no NATS server can be reached" not in (found := pushed(browser, "cells"))["problem"]:
            pass
        assert [one["cell"] for one in found["cells"]] == [NEAR]  # the last known ones
        assert found["old_s"] > 0
        server.start()
        while pushed(browser, "cells")["problem"]:
            pass
        server.stop()
        said(browser, "cells.leave")
        said(browser, "cells.follow")
        while not (found := pushed(browser, "cells"))["problem"] or found["cells"]:
            pass
        assert found["old_s"] is None


def test_dead_link_is_named(segment: Segment, server: NatsServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cells, "ANSWER_S", 0.5)
    link = Link(server.port)
    with closing(link), pages(segment, fabric={"servers": [link.url]}) as served, served.open() as browser:
        said(browser, "cells.follow")
        assert not pushed(browser, "cells")["problem"]
        link.cut()
        while not (problem := pushed(browser, "cells")["problem"]):
            pass
        assert problem == f"{link.url}: the server does not answer"
        link.heal()
        while pushed(browser, "cells")["problem"]:
            pass


def test_hostile_entries_are_shortened_text(
    segment: Segment, server: NatsServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    hostile = HOSTILE + "\x1b\u202e" + 100_000 * "x"
    register(
        server, entry("x.y.z", hostile, hostile, hostile, version=hostile, state=hostile, web=f"javascript:{hostile}")
    )
    with pages(segment, fabric=fabric(server)) as served, served.open() as browser:
        said(browser, "cells.follow")
        (found,) = pushed(browser, "cells")["cells"]
        assert found["url"] == ""
        assert found["qualities"] == {"bad": 1}
        assert found["host"].startswith(HOSTILE)
        assert found["host"].isprintable()
        assert len(json.dumps(found)) < 10 * cells.MAX_TEXT
        monkeypatch.setattr(cells, "MAX_CELLS", 1)
        register(server, entry("x.y.zz"))
        while not (found := pushed(browser, "cells"))["more"]:
            pass
        assert len(found["cells"]) == 1


def test_cells_need_the_role_read(segment: Segment, server: NatsServer) -> None:
    with pages(segment, SECRETS, (), fabric=fabric(server)) as served:
        with pytest.raises(Exception, match="403"):
            served.open()
        with served.open(served.sign_in(TOKEN)) as browser:
            said(browser, "cells.follow")
            assert pushed(browser, "cells")["cells"] == []
