"""The web page of a cell that is replayed, reloaded, stopped, stale or in 3D: each test has a cell of its own."""

from __future__ import annotations

import base64
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import suppress
from datetime import datetime
from typing import Any

import pytest

import shmio
from shmio.errors import RecordingError
from shmio.segment import EventKind
from shmio.testing.cell import Cell, until
from shmio.testing.ports import reserved_port
from tests.system.browser import (
    AXIS,
    CHROMIUM,
    SOFTWARE_GL,
    keep,
    open_tab,
    opened_browser,
    opened_page,
    start_cell,
)
from tests.system.page import printed

pytest.importorskip("uvicorn")
expect: Any = pytest.importorskip("playwright.sync_api").expect
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")
LEFT_PX = 70
"""Left margin of a plot."""
DOWNLOAD_MS = 100
"""Time between downloads. Chromium silently ignores the eleventh within a second."""
BIT = "cell/Outputs/500.%X0"
SCENE = f"""
[[body]]
name = "flag"
joint = {{ type = "prismatic", axis = [1, 0, 0], register = "{BIT}", scale = 4000 }}
shape = [{{ form = "box", size_mm = [1000, 1000, 1000], color = "#ff0000" }}]
[[body]]
name = "wall"
position_mm = [0, 3000, 0]
label = "Wall"
shape = [{{ form = "box", size_mm = [10000, 100, 2000], color = "#00ff00" }}]
"""


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with opened_browser(*SOFTWARE_GL) as browser:
        yield browser


@pytest.fixture
def address() -> Iterator[str]:
    """The page's address."""
    with reserved_port() as address:
        yield str(address)


@pytest.fixture
def scene() -> str:
    """The description of the cell in 3D; none."""
    return ""


@pytest.fixture
def cell(make_cell: Callable[..., Cell], address: str, scene: str) -> Cell:
    """A running cell with a page."""
    return start_cell(make_cell, address, scene)


@pytest.fixture
def page(cell: Cell, address: str, browser: Any) -> Iterator[Any]:
    with opened_page(browser, address) as page:
        yield page


def saved_table(page: Any) -> list[list[str]]:
    """Return the rows of the table that the page saves, with its head."""
    page.wait_for_timeout(DOWNLOAD_MS)
    with page.expect_download() as download:
        page.get_by_role("button", name="Save CSV").click()
    return [line.split(",") for line in download.value.path().read_text().splitlines()]


def recorded_s(cell: Cell) -> float:
    """Return the length of the recording that is being written."""
    [file] = (cell.folder / "dumps").glob("*.mem")
    with suppress(RecordingError), shmio.open_dump(file) as dump:
        return (dump.end_ns - dump.begin_ns) / 1e9
    return 0.0  # nothing is recorded yet


def zoom(page: Any, share: float, turns: int) -> None:
    """Turn the wheel with the pointer at a share of the time axis."""
    box = page.locator(".lane canvas").first.bounding_box()
    page.mouse.move(box["x"] + LEFT_PX + share * (box["width"] - LEFT_PX), box["y"] + box["height"] / 2)
    for _ in range(turns):
        page.mouse.wheel(0, -100)


def test_user_examines_a_recording(cell: Cell, page: Any) -> None:
    until(
        lambda: any((cell.folder / "dumps").glob("*.mem")) and recorded_s(cell) > 12, "a recording longer than the ring"
    )
    cell.output("shmio", "set", "cell/Outputs/500", "7")
    open_tab(page, "Recordings")
    row = page.get_by_role("table", name="recordings").get_by_role("row").nth(1)
    expect(row).to_contain_text("being written")
    row.click()
    expect(page.locator(".info")).to_contain_text("22 registers")
    search = page.get_by_label("Add a register")
    search.fill("cell/nothing")
    search.press("Enter")
    expect(
        page.get_by_text("this recording has no such register").or_(page.get_by_text("cell/nothing"))
    ).to_be_visible()
    expect(page.locator(".lane")).to_have_count(0)
    search.fill(AXIS)
    search.press("Enter")
    value = page.locator(f'.legend li[data-path="{AXIS}"] output')
    expect(value).not_to_have_text("no value")
    page.get_by_role("button", name="Check for damage").click()
    expect(page.get_by_label("Result of the check")).to_contain_text("no damage")
    zoom(page, 0.5, 12)
    [file] = (cell.folder / "dumps").glob("*.mem")

    def shows_frames() -> bool:
        head, *rows = saved_table(page)
        assert head == ["time", AXIS]
        times = [datetime.fromisoformat(time).timestamp() for time, _ in rows]
        with shmio.open_dump(file) as dump:
            found = dump.columns(AXIS, round((times[0] - 0.0005) * 1e9), round((times[-1] + 0.0015) * 1e9))
        return [float(value) for _, value in rows] == [float(one) for one in found["Robot_800/Axs1_Pos"]]

    until(shows_frames, "each frame in view, as it is in the file")
    keep(page, "recordings")

    open_tab(page, "Plots")
    search.fill(AXIS)
    search.press("Enter")
    expect(value).not_to_have_text("no value")
    page.get_by_label("Time span").select_option("120")

    def past_s() -> float:
        times = [datetime.fromisoformat(time).timestamp() for time, _ in saved_table(page)[1:]]
        return times[-1] - times[0]

    until(lambda: past_s() > 11, "the past from the recording")
    keep(page, "past")


def test_user_controls_a_replay(cell: Cell, page: Any) -> None:
    until(lambda: recorded_s(cell) > 3, "a recording")
    cell.output("shmio", "set", "cell/Outputs/500", "7")
    open_tab(page, "Recordings")
    page.get_by_role("table", name="recordings").get_by_role("row").nth(1).click()
    page.get_by_text("Replay it", exact=True).click()
    commands = page.locator(".command pre").last.inner_text()
    printed(f"{commands} --paused --detach", cell.folder)
    [file] = (cell.folder / "dumps").glob("*.mem")
    with shmio.open_dump(file) as dump:
        written_ns = next(entry.time_ns for entry in dump.events() if entry.item.kind == EventKind.WRITTEN)
    expect(page.get_by_role("alert")).to_be_hidden()
    expect(page.get_by_role("table", name="recordings").get_by_role("row").nth(1)).to_contain_text("closed")
    position = page.get_by_label("Present position")
    expect(position).to_contain_text("paused")
    with shmio.attach(cell.instance) as attached:

        def playing() -> Any:
            return attached.replay.status()[0]

        page.get_by_label("Position", exact=True).fill("1.5")
        until(lambda: playing().position_s == pytest.approx(1.5), "the position")
        expect(position).to_contain_text("1.500 s of")
        page.get_by_label("jump there instead of playing").check()
        page.get_by_label("Kind of event").select_option("written")
        page.get_by_role("button", name="To the next event").click()
        until(lambda: playing().time_s == pytest.approx(written_ns / 1e9, abs=1e-6), "the position of the event")
        keep(page, "replay")
        page.get_by_label("Speed").fill("2")
        page.get_by_label("Speed").press("Enter")
        until(lambda: playing().speed == 2, "the speed")
        page.get_by_label("start again at the end").check()
        until(lambda: playing().loop, "the loop")
        page.get_by_role("button", name="Play").click()
        until(lambda: not playing().paused, "that it plays")
        page.get_by_role("button", name="Pause").click()
        until(lambda: playing().paused, "the pause")


# Counts the pixels of a PNG in which red or green is far above the others.
COUNT_PIXELS = """async png => {
  const picture = await createImageBitmap(new Blob([Uint8Array.from(atob(png), one => one.charCodeAt(0))]));
  const pen = new OffscreenCanvas(picture.width, picture.height).getContext("2d");
  pen.drawImage(picture, 0, 0);
  const { data } = pen.getImageData(0, 0, picture.width, picture.height);
  const found = { left: 0, right: 0, green: 0 };
  for (let at = 0; at < data.length; at += 4) {
    const [red, green, blue] = [data[at], data[at + 1], data[at + 2]];
    const side = (at / 4) % picture.width < picture.width / 2 ? "left" : "right";
    if (red > 60 && red > 2 * green && red > 2 * blue) found[side] += 1;
    if (green > 60 && green > 2 * red && green > 2 * blue) found.green += 1;
  }
  return found;
}"""


# Returns where bodies are, of which a register with the value -90 turns one.
PLACES = """async () => {
  const { Kinematics } = await import("/scene/kinematics.js");
  const still = { joint: null, position_mm: [0, 0, 0], rotation_deg: [0, 0, 0] };
  const turned = {
    type: "revolute", register: "r", axis: [0, 2, 0], unit: "deg", scale: -0.5, offset: 45, smooth_s: 0
  };
  const bodies = [
    { ...still, parent: -1, position_mm: [1000, 0, 0], rotation_deg: [0, 0, 90] },
    { ...still, parent: 0, position_mm: [0, 500, 0], joint: turned },
    { ...still, parent: 1, position_mm: [200, 0, 0] },
    { ...still, parent: -1, rotation_deg: [90, 0, 90] },
    { ...still, parent: 3, position_mm: [0, 100, 0] },
  ];
  const kinematics = new Kinematics(bodies);
  kinematics.move(() => -90, 0);
  kinematics.judge(() => "bad");
  return [kinematics.world.map(matrix => [...matrix.slice(12, 15)]), kinematics.states];
}"""


@pytest.mark.parametrize("scene", [SCENE])
def test_registers_move_the_cell_in_3d(cell: Cell, page: Any) -> None:
    open_tab(page, "3D")
    page.get_by_role("button", name="Front").click()

    def seen() -> dict[str, int]:
        """Return the numbers of red pixels in both halves of the picture, and of green ones."""
        picture = page.locator(".scene-picture canvas").screenshot()
        found: dict[str, int] = page.evaluate(COUNT_PIXELS, base64.b64encode(picture).decode())
        return found

    until(lambda: seen()["left"] > 0 and seen()["green"] > 0, "the picture")
    line = page.locator(f'.scene-registers tr[data-path="{BIT}"]')
    expect(line).to_contain_text("false")
    before = seen()
    places, states = page.evaluate(PLACES)
    expected = [(1, 0, 0), (0.5, 0, 0), (0.5, 0, -0.2), (0, 0, 0), (0, 0, 0.1)]
    assert [pytest.approx(one, abs=1e-6) for one in expected] == places
    assert states == ["good", "bad", "bad", "good", "good"]
    cell.output("shmio", "set", BIT, "1")
    expect(line).to_contain_text("true")
    until(lambda: seen()["right"] > before["right"] + 500, "the body moves to the right")
    keep(page, "scene")
    cell.output("shmio", "set", BIT, "0")
    until(lambda: abs(seen()["left"] - before["left"]) < before["left"] / 5, "the body moves back")

    os.kill(cell.processes()["plc"]["pid"], signal.SIGSTOP)
    expect(page.locator(".scene-reasons")).to_contain_text("stale")
    expect(line).to_contain_text("bad")
    until(lambda: seen()["left"] == 0 and seen()["green"] > 0, "the body is grey, the wall is not")
    os.kill(cell.processes()["plc"]["pid"], signal.SIGCONT)
    until(lambda: seen()["left"] > 0, "the body is red again")


def edit(cell: Cell, old: str, new: str) -> None:
    file = cell.folder / "supervisor.toml"
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))


def test_user_reloads_the_configuration(cell: Cell, page: Any) -> None:
    edit(cell, "timeout = 1000", 'timeout = 1000 # password: "hunter2"')
    open_tab(page, "Configuration")
    file = page.get_by_label("Configuration file")
    changes = page.locator(".plan .changes")
    expect(changes).to_contain_text("change nothing")
    expect(file).to_contain_text("timeout = 1000 # password: •••")
    assert "hunter2" not in page.content()

    edit(cell, "period_ms = 20", "period_ms = -1")
    number = (cell.folder / "supervisor.toml").read_text().split("\n").index("period_ms = -1") + 1
    expect(file.locator(f'[data-line="{number}"] .message')).to_contain_text("fault: source[0].period_ms")
    expect(changes).to_contain_text("be refused: the file has a fault")
    expect(page.get_by_role("button", name="Reload …")).to_be_disabled()
    keep(page, "configuration-fault")

    edit(cell, "period_ms = -1", "period_ms = 50")
    edit(cell, 'writable = ["Outputs"]', 'writable = ["Outpts"]')
    expect(file.locator(".message")).to_contain_text("warning: source[0].writable: 'Outpts' matches no register")
    expect(changes.locator(".diff")).to_contain_text("± keep the connection of cell")
    expect(changes.locator(".diff")).to_contain_text("period_ms: 50 instead of 20")
    keep(page, "configuration")
    before = {name: process["pid"] for name, process in cell.processes().items()}
    page.get_by_role("button", name="Reload …").click()
    dialog = page.get_by_role("dialog")
    expect(dialog).to_contain_text("± keep the connection of cell")
    keep(page, "configuration-confirm")
    dialog.get_by_role("button", name="Cancel").click()
    assert {name: process["pid"] for name, process in cell.processes().items()} == before
    page.get_by_role("button", name="Reload …").click()
    dialog.get_by_role("button", name="Reload", exact=True).click()
    expect(page.locator(".plan .messages")).to_contain_text("cell: changed, and keeps its connection")
    expect(changes).to_contain_text("change nothing")
    after = {name: process["pid"] for name, process in cell.processes().items()}
    assert after == before
    with shmio.attach(cell.instance) as reader:
        assert reader.block("cell").period_ns == 50_000_000


def test_page_returns_after_a_reload_that_restarts_its_server(cell: Cell, page: Any) -> None:
    open_tab(page, "Configuration")
    edit(cell, "[web]", '[web]\nhosts = ["cell.example"]')
    pid = cell.processes()["web"]["pid"]
    expect(page.locator(".plan .diff")).to_contain_text("± restart web")
    page.get_by_role("button", name="Reload …").click()
    expect(page.get_by_role("dialog")).to_contain_text("connects again by itself")
    page.get_by_role("dialog").get_by_role("button", name="Reload", exact=True).click()
    expect(page.locator(".plan")).to_contain_text("change nothing")  # a failure shows the supervisor's answer, too
    expect(page.locator(".plan .changes")).to_contain_text("change nothing")
    assert cell.processes()["web"]["pid"] != pid


def test_page_says_that_the_instance_has_stopped(cell: Cell, page: Any) -> None:
    expect(page.locator("#state")).to_have_text("running")
    expect(page.get_by_role("cell", name="cell", exact=True).first).to_be_visible()
    keep(page, "overview")
    cell.down()
    expect(page.get_by_role("alert")).to_be_visible()
    cell.up()
    expect(page.get_by_role("alert")).to_be_hidden()
    expect(page.locator("#state")).to_have_text("running")


class Fingers:
    """Touches an element, by the protocol of Chromium's developer tools. Points are shares of its width and height."""

    def __init__(self, page: Any, selector: str) -> None:
        self._session = page.context.new_cdp_session(page)
        self._box = page.locator(selector).first.bounding_box()

    def _send(self, kind: str, points: list[tuple[float, float]]) -> None:
        box = self._box
        touches = [
            {"x": box["x"] + x * box["width"], "y": box["y"] + y * box["height"], "id": number}
            for number, (x, y) in enumerate(points)
        ]
        self._session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": touches})

    def tap(self, x: float, y: float) -> None:
        self._send("touchStart", [(x, y)])
        self._send("touchEnd", [])

    def move(self, *ways: tuple[tuple[float, float], tuple[float, float]]) -> None:
        """Move each finger from one point to another."""
        for step in range(9):
            points = [
                (old[0] + step / 8 * (new[0] - old[0]), old[1] + step / 8 * (new[1] - old[1])) for old, new in ways
            ]
            self._send("touchMove" if step else "touchStart", points)
        self._send("touchEnd", [])


@pytest.fixture
def tablet(cell: Cell, address: str, browser: Any) -> Iterator[Any]:
    """The cell's page, on a screen that senses fingers."""
    with opened_page(browser, address, has_touch=True, viewport={"width": 1024, "height": 768}) as page:
        yield page


@pytest.mark.parametrize("scene", [SCENE])
def test_fingers_move_plots_and_the_cell(tablet: Any) -> None:
    tablet.get_by_role("tab", name="Plots").tap()
    search = tablet.get_by_label("Add a register")
    search.fill(AXIS)
    search.press("Enter")
    expect(tablet.locator(f'.legend li[data-path="{AXIS}"] output')).not_to_have_text("no value")
    fingers = Fingers(tablet, ".lane canvas")
    fingers.move(((0.4, 0.5), (0.6, 0.5)))
    expect(tablet.get_by_role("button", name="Live")).to_be_visible()

    times = tablet.get_by_text("Δt")

    def measured_s() -> float:
        """Tap on two points; return the time between them."""
        fingers.tap(0.3, 0.5)
        expect(times).to_have_count(0)  # it shows the time between the points of the last call until it is drawn again
        fingers.tap(0.8, 0.5)
        return float(times.inner_text().split("Δt ")[1].split()[0])

    before_s = measured_s()
    assert 2 < before_s < 8
    fingers.move(((0.45, 0.5), (0.3, 0.5)), ((0.55, 0.5), (0.8, 0.5)))
    assert measured_s() == pytest.approx(before_s * 0.1 / 0.5, rel=0.01)  # the fingers' distance at the start and end
    fingers.move(((0.3, 0.5), (0.5, 0.5)), ((0.7, 0.5), (0.5, 0.5)))
    keep(tablet, "touch")

    tablet.get_by_role("tab", name="3D").tap()
    tablet.get_by_role("button", name="Front").tap()

    def green() -> int:
        picture = tablet.locator(".scene-picture canvas").screenshot()
        found: dict[str, int] = tablet.evaluate(COUNT_PIXELS, base64.b64encode(picture).decode())
        return found["green"]

    until(lambda: green() > 0, "the picture")
    front = green()
    fingers = Fingers(tablet, ".scene-picture canvas")
    fingers.move(((0.4, 0.5), (0.45, 0.5)), ((0.6, 0.5), (0.55, 0.5)))
    until(lambda: green() < front / 2, "two fingers make it smaller")
    small = green()
    fingers.move(((0.3, 0.5), (0.6, 0.5)))
    until(lambda: green() < small, "one finger turns it")
