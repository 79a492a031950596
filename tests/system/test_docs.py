"""Runs every command in the README as shown, in a separate shell, while the demo is running."""

from __future__ import annotations

import re
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

from shmio.segment import instances, running_instances
from tests.system.page import printed

ROOT = Path(__file__).parents[2]
BLOCK = re.compile(r"^```sh( background)?\n(.*?)^```$", re.DOTALL | re.MULTILINE)


def blocks(page: Path) -> Iterator[tuple[bool, str]]:
    for match in BLOCK.finditer(page.read_text()):
        yield bool(match[1]), match[2]


def test_the_readme_runs_as_shown() -> None:
    # The demo replaces what a dead instance left, and refuses to start beside a running one.
    assert "a50" not in running_instances(), "stop the running instance: shmio-supervisor down --instance a50"
    found = list(blocks(ROOT / "README.md"))
    (demo,) = [commands for background, commands in found if background]
    with subprocess.Popen(
        ["bash", "-c", f"exec {demo}"], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as cell:
        try:
            assert cell.stdout is not None
            lines = []
            for line in cell.stdout:
                lines.append(line)
                if "the instance is running" in line:
                    break
            assert any("127.0.0.1:8089" in line for line in lines), "".join(lines)
            for background, commands in found:
                if not background:
                    assert printed(commands, ROOT).strip(), f"printed nothing:\n{commands}"
        finally:
            cell.send_signal(signal.SIGINT)
            cell.communicate(timeout=60)
    assert cell.returncode == 0
    assert "a50" not in instances()
