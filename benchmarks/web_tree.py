"""A source with 100,000 registers on the web page, in headless Chromium without a GPU.

The time until Chromium first paints the page, from a click on the tab of the registers until the values of the first
rows are there, and from a text in the search until its row is there.
"""

from __future__ import annotations

import shutil
import statistics
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

from common import begin, table
from instance import instance
from web_page import PERIOD_MS

from shmio.testing.ports import reserved_port

_PAINT = "performance.getEntriesByName('first-contentful-paint')[0]?.startTime ?? null"
_VALUES = "[...document.querySelectorAll('.tree-rows .value')].some(value => value.textContent)"


def tree(rounds: int) -> list[list[str]]:
    """Return the rows of the table of a tree with 100,000 registers."""
    from playwright.sync_api import sync_playwright  # noqa: PLC0415  it need not be installed

    steps = ("first paint", "registers are opened", "a search is answered")
    found: dict[str, list[float]] = {step: [] for step in steps}
    with ExitStack() as stack:
        address = stack.enter_context(reserved_port())
        tags = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "tags.toml"
        paths = (
            f"l{line:02}/u{unit:02}/v{value:02}" for line in range(100) for unit in range(50) for value in range(20)
        )
        tags.write_text("[registers]\n" + "".join(f'"{path}" = {{ type = "REAL" }}\n' for path in paths))
        source = f'[[source]]\nname = "big"\nconnector = "memory"\ntags = "{tags}"\nperiod_ms = 200\n'
        stack.enter_context(instance(PERIOD_MS, more=f'{source}[web]\nlisten = "{address}"\n'))
        driver = stack.enter_context(sync_playwright())
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        for _ in range(rounds):
            page = browser.new_context(viewport={"width": 1280, "height": 800}).new_page()
            page.goto(f"http://{address}/")
            while (paint := page.evaluate(_PAINT)) is None:  # the page forbids wait_for_function, which needs eval
                page.wait_for_timeout(20)
            found["first paint"].append(paint)
            begun_s = time.monotonic()
            page.get_by_role("tab", name="Registers").click()
            while not page.evaluate(_VALUES):
                page.wait_for_timeout(20)
            found["registers are opened"].append(1000 * (time.monotonic() - begun_s))
            begun_s = time.monotonic()
            page.get_by_label("Search").fill("l99/u49/v19")
            page.wait_for_selector('.tree-row[data-path="big/l99/u49/v19"]')
            found["a search is answered"].append(1000 * (time.monotonic() - begun_s))
            page.context.close()
        browser.close()
    return [
        [step, f"{min(times):.0f}", f"{statistics.median(times):.0f}", f"{max(times):.0f}"]
        for step, times in found.items()
    ]


def main() -> None:
    quick = begin("A tree of 100,000 registers on the web page")
    if shutil.which("chromium") is None:
        print("chromium is not installed")
    else:
        table(["ms", "least", "median", "most"], tree(1 if quick else 5))


if __name__ == "__main__":
    main()
