"""The page of one cell shows all cells of the fabric, and opens the pages of others in a browser."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from shmio.fabric.connection import Access, connect
from shmio.fabric.registry import CellEntry, Registry
from shmio.testing.cell import CONFIG, Cell
from shmio.testing.ports import reserved_port
from shmio.version import __version__
from tests.nats_server import nats_server
from tests.system.browser import CHROMIUM, HOSTILE, keep, open_tab, opened_browser, opened_page

pytest.importorskip("uvicorn")
expect: Any = pytest.importorskip("playwright.sync_api").expect
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")


def register(url: str, *entries: CellEntry) -> None:
    async def work() -> None:
        client = await connect(Access((url,)), "test", patient=False)
        registry = await Registry.open(client)
        for one in entries:
            await registry.claim(one)
        await client.close()

    asyncio.run(work())


def test_user_sees_all_cells_and_opens_one(make_cell: Callable[..., Cell], tmp_path: Path) -> None:
    with nats_server(tmp_path / "nats") as server, reserved_port() as address:
        fabric = f'[fabric]\nserver = "{server.url}"\ncell = "plant1.line3.a50"\n'
        cell = make_cell(config=f'{CONFIG}[web]\nlisten = "{address}"\n{fabric}')
        cell.up()
        page_url = f"http://{address}"
        register(
            server.url,
            CellEntry("plant1.line3.b60", socket.gethostname(), "b60", "0.1", "0", "running", 1, 2, page_url),
            CellEntry("x.y.z", HOSTILE, HOSTILE, __version__, "0", HOSTILE, 1, 2, f"javascript:{HOSTILE}"),
        )
        with opened_browser() as browser, opened_page(browser, str(address)) as page:
            open_tab(page, "Cells")
            rows = page.locator("#cells tbody tr")
            expect(rows).to_have_count(3)
            expect(rows.nth(0)).to_contain_text("this page")
            expect(rows.nth(0)).to_contain_text("1 good")
            expect(rows.nth(1).get_by_text("0.1", exact=True)).to_have_class("uncertain")
            expect(rows.nth(2)).to_contain_text(HOSTILE)
            expect(page.locator("#cells a")).to_have_count(1)
            keep(page, "page-cells")
            link = rows.nth(1).get_by_role("link")
            with page.expect_popup() as opened:
                link.click()
            expect(opened.value.get_by_role("tab", name="Cells")).to_be_visible()
            assert opened.value.evaluate("window.opener") is None
            link.focus()
            server.stop()
            expect(page.locator(".cells .problem")).to_contain_text("no NATS server can be reached")
            expect(page.locator(".cells .problem")).to_contain_text("old")
            expect(rows).to_have_count(3)
            expect(link).to_be_focused()  # an update leaves the link
