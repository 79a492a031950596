"""The synchronous client equals what the script generates from the asynchronous client."""

from __future__ import annotations

import runpy
from pathlib import Path

SCRIPT = Path(__file__).parents[3] / "scripts" / "generate-sync-client"


def test_the_synchronous_client_is_current() -> None:
    script = runpy.run_path(str(SCRIPT))
    generated = script["generate"]()
    folder = script["CLIENT"] / "sync"
    there = {file: file.read_text() for file in folder.glob("*.py") if file.name not in script["BY_HAND"]}
    assert there.keys() == generated.keys()
    stale = [file.name for file in there if there[file] != generated[file]]
    assert not stale, "run scripts/generate-sync-client"
