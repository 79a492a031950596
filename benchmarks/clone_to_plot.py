"""The time from ``git clone`` to a moving plot, as a new user spends it: without reading anything but the output.

The script clones this repository into a new folder, runs the README's first command, takes the page's address from
its output, opens the page in headless Chromium, adds a plot, and waits until the plot has moved. Times are in s since
the start of ``git clone``. The demo has fixed ports, so nothing else may use them. pip may use its cache, so a first
installation takes longer by its downloads; ``--no-cache`` leaves the cache out.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import signal
import socket
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from queue import Empty, SimpleQueue

from common import ROOT, machine

PORTS = (8080, 8089, 8090, 1102, 1883)
LIMIT_S = 600.0
REGISTER = "cell/Robot_800/Axs1_Pos"
PATIENCE_MS = 60_000
_ADDRESS = re.compile(r"open (https?://\S+)")
_MOVED = """path => {
  const canvas = document.querySelector(`canvas[aria-label$="${path}"]`);
  const picture = canvas?.toDataURL();
  window.pictures ??= new Set();
  if (picture) window.pictures.add(picture);
  return window.pictures.size >= 5;
}"""


def require_free_ports() -> None:
    """End if another program uses one of the demo's ports."""
    for port in PORTS:
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind(("127.0.0.1", port))
            except OSError as error:
                raise SystemExit(f"port {port} is in use, which the demo needs: {error}") from None


@contextmanager
def demo(folder: Path, environment: dict[str, str], command: str) -> Iterator[str]:
    """Run the demo until the block ends. Provide the page's address, which it prints."""
    process = subprocess.Popen(
        command, shell=True, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        text=True, start_new_session=True,
    )  # fmt: skip
    lines: SimpleQueue[str | None] = SimpleQueue()
    assert process.stdout is not None
    output = process.stdout

    def read() -> None:
        for line in output:
            lines.put(line)
        lines.put(None)

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    try:
        yield _address(lines)
    finally:
        os.killpg(process.pid, signal.SIGINT)
        try:
            process.wait(60)
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
        reader.join(10)


def _address(lines: SimpleQueue[str | None]) -> str:
    seen: list[str] = []
    deadline_s = time.monotonic() + LIMIT_S
    while True:
        try:
            line = lines.get(timeout=max(0.0, deadline_s - time.monotonic()))
        except Empty:
            line = None
        if line is None:
            raise SystemExit(f"the demo did not print the page's address. Its output:\n{''.join(seen)}")
        seen.append(line)
        if found := _ADDRESS.search(line):
            return found[1]


def first_command(readme: str) -> str:
    """Return the first command of the README."""
    found = re.search(r"^```sh[^\n]*\n([^\n]+)\n", readme, re.MULTILINE)
    if found is None:
        raise SystemExit("README.md has no command")
    return found[1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("repository", nargs="?", default=str(ROOT), help="what to clone; default: this clone")
    parser.add_argument("--no-cache", action="store_true", help="let pip download everything")
    arguments = parser.parse_args()
    from playwright.sync_api import sync_playwright  # noqa: PLC0415  it need not be installed

    chromium = shutil.which("chromium")
    if chromium is None:
        raise SystemExit("chromium is not installed (Debian: apt install chromium)")
    require_free_ports()
    print(f"# From git clone to a moving plot\n{machine()}")
    environment = {name: value for name, value in os.environ.items() if name not in ("VIRTUAL_ENV", "PYTHONPATH")}
    if arguments.no_cache:
        environment["PIP_NO_CACHE_DIR"] = "1"
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "shmio"
        begun_s = time.monotonic()

        def done(what: str) -> None:
            print(f"{time.monotonic() - begun_s:6.1f} s  {what}", flush=True)

        subprocess.run(["git", "clone", "-q", arguments.repository, folder], check=True)
        done("cloned")
        command = first_command((folder / "README.md").read_text())
        with demo(folder, environment, command) as address, sync_playwright() as driver:
            done(f"{command} has printed {address}")
            browser = driver.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
            page = browser.new_page(viewport={"width": 1280, "height": 800})
            page.set_default_timeout(PATIENCE_MS)
            page.goto(address)
            page.get_by_role("tab", name="Plots").click()
            done("page opened")
            search = page.get_by_label("Add a register")
            search.fill(REGISTER)
            search.press("Enter")
            while not page.evaluate(_MOVED, REGISTER):  # the page forbids wait_for_function, which needs eval
                page.wait_for_timeout(50)
            done("the plot moves")
            browser.close()


if __name__ == "__main__":
    main()
