"""The web page of a running cell, used by a person with a browser. The tests share the cell, and leave it as it was."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Callable, Iterator
from typing import Any

import pytest

import shmio
from shmio.testing.cell import Cell, until
from shmio.testing.ports import reserved_port
from tests.system.browser import (
    AXIS,
    CHROMIUM,
    HOSTILE,
    keep,
    open_tab,
    opened_browser,
    opened_page,
    reading,
    start_cell,
)

pytest.importorskip("uvicorn")
expect: Any = pytest.importorskip("playwright.sync_api").expect
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with opened_browser() as browser:
        yield browser


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """The page's address."""
    with reserved_port() as address:
        yield str(address)


@pytest.fixture(scope="module")
def shared_cell(make_shared_cell: Callable[..., Cell], address: str) -> Cell:
    return start_cell(make_shared_cell, address)


@pytest.fixture
def cell(shared_cell: Cell) -> Iterator[Cell]:
    """The running cell. After the test, its outputs are 0, so that nothing holds it."""
    yield shared_cell
    with shmio.attach(shared_cell.instance, writable=True) as attached:
        register = attached.layouts("cell")["cell"].by_path["Outputs"]
        zeros = [0] * attached.layouts("cell")["cell"].registers[register].size
        until(lambda: attached.write({"cell/Outputs": zeros})[0].done, "the outputs are written")


@pytest.fixture
def page(cell: Cell, address: str, browser: Any) -> Iterator[Any]:
    with opened_page(browser, address) as page:
        yield page


def test_user_filters_the_log(cell: Cell, page: Any) -> None:
    with (cell.folder / "logs" / "cell.log").open("a") as log_file:
        log_file.write(f"{HOSTILE}\n")
    expect(page.get_by_role("tab", name="3D")).to_be_hidden()  # this cell has no scene
    open_tab(page, "Log")
    log = page.get_by_label("Log", exact=True).last
    expect(log).to_contain_text("supervisor: the supervisor is running")
    expect(log).to_contain_text(HOSTILE)
    keep(page, "log")
    page.get_by_label("Filter").fill("connected")
    expect(log).not_to_contain_text("the supervisor is running")
    expect(log).to_contain_text("connected")


def test_user_sees_the_registers_of_dropped_files(cell: Cell, page: Any) -> None:
    open_tab(page, "Configuration")
    files = page.get_by_label("Files", exact=True)
    files.set_input_files(cell.folder / "db201.db")
    rows = page.get_by_role("table", name="Registers of the files")
    expect(rows.get_by_role("row").filter(has_text="Axs1_Pos").first).to_be_visible()
    expect(page.locator(".drop [role=status]")).to_contain_text("DB201")
    page.get_by_role("button", name="Theme").click()
    keep(page, "configuration-dropped")
    page.get_by_label("Search registers").fill("Robot_800/Axs3_Pos")
    expect(rows.get_by_role("row")).to_have_count(1)
    files.set_input_files({"name": "x.db", "mimeType": "text/plain", "buffer": b"DATA_BLOCK x STRUCT a : INTT;"})
    expect(page.locator(".drop .messages")).to_contain_text("x.db:1:")
    expect(rows).to_be_hidden()


def test_user_writes_a_register_and_overrides_it(cell: Cell, page: Any) -> None:
    open_tab(page, "Registers")
    page.get_by_label("Search").fill("Outputs")
    expect(page.get_by_text("1 row", exact=True)).to_be_visible()  # a click on a row of the table before would be lost
    page.locator('.tree-row[data-path="cell/Outputs"]').click()
    expect(page.get_by_role("button", name="Write")).to_be_enabled()
    size = len(reading(cell, "cell/Outputs")[0])
    page.get_by_label("New value").fill(json.dumps([7] * size))
    page.get_by_role("button", name="Write").click()
    expect(page.locator(".detail output")).to_have_text("written")
    until(lambda: reading(cell, "cell/Outputs/500") == (7, "live"), "the value in the PLC's memory")

    page.get_by_label("Search").fill("Axs1_Pos")
    row = page.locator(f'.tree-row[data-path="{AXIS}"]')
    row.click()
    expect(page.get_by_role("button", name="Write")).to_be_disabled()
    expect(row).to_contain_text(HOSTILE)
    page.get_by_label("New value").fill("12.5")
    page.get_by_role("button", name="Override").click()
    expect(row.locator(".origin")).to_have_text("injected")
    keep(page, "registers")
    until(lambda: reading(cell, AXIS) == (12.5, "injected"), "the override")
    page.get_by_role("button", name="Lift").click()
    expect(row.locator(".origin")).to_have_text("live")


def test_marked_register_is_the_one_that_is_written(cell: Cell, page: Any) -> None:
    """By keyboard, as on the panel of a cell: what is marked is what Write and Override change, and nothing else is."""
    open_tab(page, "Registers")
    table, form = page.get_by_role("treegrid", name="Registers"), page.get_by_role("form", name="Register")
    marked, named = page.locator(".tree-row[aria-selected=true]"), form.locator("strong")
    field, write = page.get_by_label("New value"), page.get_by_role("button", name="Write")
    search = page.get_by_label("Search")

    def marks(path: str) -> None:
        expect(marked).to_have_attribute("data-path", path)
        expect(named).to_have_text(path)

    page.locator('.tree-row[data-path="cell/Outputs"]').click()
    marks("cell/Outputs")
    elements = page.locator('.tree-row[data-path^="cell/Outputs/"]')
    expect(elements.first).to_be_visible()
    table.evaluate("(rows) => rows.scrollTo(0, 26 * 510)")
    first, second, third = (f"cell/Outputs/{n}" for n in (510, 511, 512))
    row = page.locator(f'.tree-row[data-path="{first}"]')
    expect(row).to_be_visible()
    expect(named).to_have_text("cell/Outputs")  # its mark is out of view
    field.fill("111")  # half typed, and never written
    row.click()
    marks(first)
    expect(field).to_have_value("")
    field.fill("112")
    table.press("ArrowDown")
    marks(second)
    expect(field).to_have_value("")
    field.fill("7")
    field.press("Enter")
    expect(form.locator("output")).to_have_text("written")
    until(lambda: reading(cell, second) == (7, "live"), "the marked element in the PLC's memory")
    assert (reading(cell, first)[0], reading(cell, third)[0]) == (0, 0)

    field.fill("9")
    page.locator(f'.tree-row[data-path="{third}"]').click()
    marks(third)
    expect(field).to_have_value("")
    table.press("ArrowUp")
    marks(second)
    field.fill("12")
    page.get_by_role("button", name="Override").press("Enter")
    expect(marked.locator(".origin")).to_have_text("injected")
    until(lambda: reading(cell, second) == (12, "injected"), "the override of the marked element")
    assert reading(cell, third) == (0, "live")
    expect(field).to_have_value("12")
    cell.output("shmio-supervisor", "restart", "web")  # also ends the page's override
    expect(marked.locator(".origin")).to_have_text("live")
    marks(second)
    expect(field).to_have_value("12")

    search.fill("Robot_800/Axs1_Pos")
    expect(page.get_by_text("1 row", exact=True)).to_be_visible()
    expect(write).to_have_count(0)  # nothing is marked any more, so nothing can be written
    table.press("ArrowDown")
    marks(AXIS)
    expect(write).to_be_disabled()
    search.fill("")
    expect(page.locator('.tree-row[data-path="cell"]')).to_be_visible()
    table.press("ArrowUp")
    expect(write).to_have_count(0)
    expect(marked).to_have_attribute("data-path", "cell")


def test_user_sees_active_alerts(cell: Cell, page: Any) -> None:
    alerts = page.get_by_role("table", name="alerts")
    expect(page.get_by_role("button", name="Restart cell")).to_be_visible()
    expect(alerts).to_be_hidden()
    cell.output("shmio", "set", "cell/Outputs/500", "7")
    expect(alerts.get_by_role("row", name="seven")).to_contain_text("cell/Outputs/500 = 7")
    keep(page, "alerts")
    cell.output("shmio", "set", "cell/Outputs/500", "0")
    expect(alerts).to_be_hidden()


def test_user_runs_a_campaign_and_lifts_everything(cell: Cell, page: Any) -> None:
    open_tab(page, "Injections")
    campaign = f'[[injection]]\nname = "drift"\ntarget = "{AXIS}"\noperation = "set"\nvalue = 42.0\n'
    text = page.get_by_role("textbox", name="Campaign")
    text.fill(campaign.replace('"set"', '"sett"'))
    page.get_by_role("button", name="Check").click()
    expect(page.locator(".preview")).to_contain_text("injection[0].operation")
    text.fill("")
    page.get_by_label("Register to inject").fill(AXIS)
    page.get_by_label("value", exact=True).fill("42.0")
    page.get_by_label("Name of the injection").fill("drift")
    condition = page.get_by_label("Condition")
    condition.fill(f"abs({AXIS}) >")
    expect(page.locator(".condition")).to_contain_text("when: at character")
    condition.fill(f"abs({AXIS}) < 1000")
    expect(page.locator(".condition")).to_contain_text(f"The condition is true now: {AXIS} = ")
    page.get_by_role("button", name="Add to the campaign").click()
    expect(page.locator(".preview")).to_contain_text(f"drift: set when abs({AXIS}) < 1000, over {AXIS}")
    page.get_by_role("button", name="Start").click()
    present = page.get_by_role("table", name="injections").get_by_role("row").filter(has_text="drift")
    expect(present).to_contain_text("active")
    until(lambda: reading(cell, AXIS) == (42.0, "injected"), "the campaign")
    expect(page.get_by_role("table", name="events").get_by_role("row").filter(has_text="drift").first).to_be_visible()
    keep(page, "injections")
    page.get_by_role("button", name="Lift all injections").click()
    expect(present).to_have_count(0)
    until(lambda: reading(cell, AXIS)[1] == "live", "the end of the campaign")


def test_plot_moves_and_survives_restarts(cell: Cell, page: Any) -> None:
    open_tab(page, "Plots")
    search = page.get_by_label("Add a register")
    for path in (AXIS, "cell/Robot_800/Axs3_Pos"):
        search.fill(path)
        search.press("Enter")
    expect(page.locator(".lane")).to_have_count(2)
    value = page.locator(f'.legend li[data-path="{AXIS}"] output')

    def moves() -> None:
        expect(value).not_to_have_text("no value")
        expect(value).not_to_have_text(value.inner_text())

    moves()
    page.locator(f'.legend li[data-path="{AXIS}"]').drag_to(page.locator(".lane").last)
    expect(page.locator(".lane")).to_have_count(1)
    keep(page, "plots")
    cell.output("shmio-supervisor", "restart", "web")
    moves()
    os.kill(cell.processes()["cell"]["pid"], signal.SIGKILL)
    moves()
    page.get_by_role("button", name="Pause").click()
    with page.expect_download() as download:
        page.get_by_role("button", name="Save CSV").click()
    head, *rows = download.value.path().read_text().splitlines()
    assert head == f"time,cell/Robot_800/Axs3_Pos,{AXIS}"
    assert len(rows) > 20
    assert any(row.count(",") == 2 and float(row.split(",")[2]) for row in rows if not row.endswith(","))
    with page.expect_download() as download:
        page.get_by_role("button", name="Save PNG").click()
    assert download.value.path().read_bytes().startswith(b"\x89PNG")


def test_user_restarts_a_process(cell: Cell, page: Any) -> None:
    before = cell.processes()["cell"]["pid"]
    page.on("dialog", lambda dialog: dialog.accept())
    page.get_by_role("button", name="Restart cell").click()
    expect(page.get_by_text("cell runs again")).to_be_visible()
    assert cell.processes()["cell"]["pid"] != before


def test_user_steps_time_and_returns_to_real_time(cell: Cell, page: Any) -> None:
    open_tab(page, "Time")
    page.get_by_label("Number of steps").fill("5")
    page.get_by_label("Length of a step in ms").fill("250")
    page.get_by_role("button", name="Step").click()
    until(lambda: cell.status()["clock"]["step"] == 5, "five steps")
    expect(page.locator(".time dl")).to_contain_text("virtual: only steps move time")
    page.get_by_role("button", name="Run").click()
    expect(page.locator(".time dl")).to_contain_text("yes, at 1 times real time")
    keep(page, "time")
    page.get_by_role("button", name="Pause").click()
    expect(page.locator(".time dl")).not_to_contain_text("yes, at")
    page.get_by_role("button", name="Back to real time").click()
    until(lambda: cell.status()["clock"]["mode"] == "wall", "real time")
