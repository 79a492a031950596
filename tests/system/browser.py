"""A browser for tests of the web page: real Chromium. Such tests share it, and each has a context of its own."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from shmio.testing.cell import CONFIG, Cell

CHROMIUM = shutil.which("chromium")
PATIENCE_MS = 30_000
SOFTWARE_GL = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
"""Options of Chromium for the cell in 3D, without a graphics card. They make every page slower."""
AXIS = "cell/Robot_800/Axs1_Pos"
ALERT = '[[alert]]\nname = "seven"\nwhen = "cell/Outputs/500 = 7"\nseverity = "critical"\n'
HOSTILE = '<img src=x onerror="document.title=1"><script>document.title=1</script>'
"""Comment of a register and line of a log."""


def start_cell(make_cell: Callable[..., Cell], address: str, scene: str = "") -> Cell:
    """Start a cell that serves the page, with a recorder and an alert."""
    config = CONFIG.replace("timeout = 1000", 'timeout = 1000\nwritable = ["Outputs"]')
    more = 'scene = "scene.toml"\n' if scene else ""
    cell = make_cell(config=f'{config}[web]\nlisten = "{address}"\n{more}[recorder]\ndirectory = "dumps"\n{ALERT}')
    (cell.folder / "scene.toml").write_text(scene)
    layout = cell.folder / "db201.db"
    layout.write_text(layout.read_text().replace("Axs1_Pos : Real;", f"Axs1_Pos : Real;  // {HOSTILE}"))
    cell.up()
    return cell


@contextmanager
def opened_browser(*options: str) -> Iterator[Any]:
    """Start Chromium with these options."""
    playwright: Any = pytest.importorskip("playwright.sync_api")
    playwright.expect.set_options(timeout=PATIENCE_MS)
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", *options])
        yield browser
        browser.close()


@contextmanager
def opened_page(browser: Any, address: str, **context_options: Any) -> Iterator[Any]:
    """Open a cell's page in a new context. The browser must report no error."""
    errors: list[str] = []
    context = browser.new_context(**{"viewport": {"width": 1280, "height": 800}, **context_options})
    page = context.new_page()
    page.set_default_timeout(PATIENCE_MS)
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(f"http://{address}/")
    yield page
    assert not page.locator("img, main script").count()
    context.close()
    assert not errors


def keep(page: Any, name: str) -> None:
    """Keep a screenshot in the folder that SHMIO_SCREENSHOTS names, if it does."""
    if folder := os.environ.get("SHMIO_SCREENSHOTS"):
        page.screenshot(path=Path(folder) / f"{name}.png")


def open_tab(page: Any, name: str) -> None:
    page.get_by_role("tab", name=name).click()


def reading(cell: Cell, path: str) -> tuple[Any, str]:
    found = json.loads(cell.output("shmio", "get", "--json", path))[path]
    return found["value"], found["provenance"]
