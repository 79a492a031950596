"""Makes the pictures of the web page for the documentation: ``python -m tests.system.screenshots FOLDER``."""

from __future__ import annotations

import re
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from playwright.sync_api import expect, sync_playwright

import shmio
from shmio.testing.cell import Cell, until
from shmio.testing.ports import reserved_port

ROOT = Path(__file__).parents[2]
AXIS = "cell/Robot_800/Axs1_Pos"
ROUND_S = 75
"""Time in which each robot of the cell moves at least once."""
INSTANCE = "a50-demo"
BROWSER = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


def registers(cell: Cell, page: Any) -> None:
    """A register of the tree is overridden."""
    page.locator('.tree-row[data-path="cell/Robot_800"]').click()
    row = page.locator(f'.tree-row[data-path="{AXIS}"]')
    row.click()
    page.get_by_label("New value").fill("12.5")
    page.get_by_role("button", name="Override").click()
    expect(row.locator(".origin")).to_have_text("injected")


def plots(cell: Cell, page: Any) -> None:
    """Two plots of joint positions; one value is injected for a second."""
    add(page, AXIS, "cell/Robot_825/Axs1_Pos", "cell/Robot_800/Axs2_Pos")
    page.locator('.legend li[data-path="cell/Robot_825/Axs1_Pos"]').drag_to(page.locator(".lane").first)
    until(lambda: abs(position()) > 5, "the robot moves")
    cell.output("shmio", "inject", "--for", "1", AXIS, "60")
    until(lambda: abs(position()) < 1, "the robot is back")
    page.wait_for_timeout(1_000)


def scene(cell: Cell, page: Any) -> None:
    """The cell in 3D; an axis of one robot is injected."""
    page.locator(".scene-picture canvas").wait_for()
    with shmio.attach(INSTANCE, writable=True) as attached, attached.inject("cell/Robot_850/Axs2_Pos") as shadow:
        shadow.set({"cell/Robot_850/Axs2_Pos": -60.0})
        expect(page.get_by_text("injected").first).to_be_visible()
        page.wait_for_timeout(3_000)
        page.screenshot(path=picture("3d"))


def recordings(cell: Cell, page: Any) -> None:
    """A recording at a glance."""
    page.get_by_role("table", name="recordings").get_by_role("row").nth(1).click()
    add(page, AXIS, "cell/Robot_800/Axs3_Pos")
    expect(page.locator(f'.legend li[data-path="{AXIS}"] output')).not_to_have_text("no value")
    page.wait_for_timeout(3_000)


def configuration(cell: Cell, page: Any) -> None:
    """The configuration with a warning at its line, and what a reload would do."""
    file = cell.folder / "supervisor.toml"
    text = file.read_text()
    changed = text.replace("period_ms = 20", "period_ms = 50").replace('["Outputs", ', '["Outpts", ')
    drift = '\n[[injection]]\nname = "drift"\ntarget = "cell/NCAchse1_Pos"\noperation = "offset"\nvalue = 2.5\n'
    file.write_text(changed + drift)
    expect(page.get_by_label("Configuration file").locator(".message")).to_contain_text("warning")
    expect(page.locator(".plan .changes")).to_contain_text("drift")


PICTURES: dict[str, tuple[str, int, Callable[[Cell, Any], None]]] = {
    "registers": ("Registers", 640, registers),
    "plots": ("Plots", 640, plots),
    "3d": ("3D", 720, scene),
    "recordings": ("Recordings", 800, recordings),
    "configuration": ("Configuration", 800, configuration),
}
"""By name of the picture: the tab, the height in pixels, and what a user does there."""


def add(page: Any, *paths: str) -> None:
    """Type paths into the tab's search field."""
    search = page.get_by_label("Add a register")
    for path in paths:
        search.fill(path)
        search.press("Enter")
        expect(page.locator(f'.legend li[data-path="{path}"]')).to_be_visible()


def position() -> float:
    with shmio.attach(INSTANCE) as cell:
        return float(str(cell[AXIS]))


def picture(name: str) -> Path:
    return Path(sys.argv[1]) / f"page-{name}.png"


def prepare(folder: Path, stack: ExitStack) -> tuple[Cell, str]:
    """Copy the demo's configuration, with another name and free ports. Return the cell and the page's address."""
    for name in ("db201.db", "scene.toml"):
        shutil.copy(ROOT / name, folder)
    ports: dict[str, str] = {}

    def free(match: re.Match[str]) -> str:
        if match[0] not in ports:
            ports[match[0]] = str(stack.enter_context(reserved_port()).port)
        return ports[match[0]]

    text = re.sub(r"\b(1102|8089|8090|1883|8080)\b", free, (ROOT / "supervisor.toml").read_text())
    (folder / "supervisor.toml").write_text(text.replace('name = "a50" ', f'name = "{INSTANCE}" '))
    return Cell(folder, INSTANCE, shmio.config.Address("127.0.0.1", int(ports["8089"]))), f"127.0.0.1:{ports['8080']}"


def main() -> None:
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="a50-")))
        cell, address = prepare(folder, stack)
        stack.callback(cell.down)
        cell.up()
        time.sleep(ROUND_S)
        driver = stack.enter_context(sync_playwright())
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=BROWSER)
        expect.set_options(timeout=30_000)
        for name, (tab, height, use) in PICTURES.items():
            page = browser.new_page(viewport={"width": 1280, "height": height})
            page.goto(f"http://{address}/")
            page.get_by_role("tab", name=tab).click()
            use(cell, page)
            if name != "3d":  # its injection has ended by now
                page.screenshot(path=picture(name))
            page.close()


if __name__ == "__main__":
    main()
