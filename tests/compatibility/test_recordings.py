"""This version reads the recordings of earlier versions as they read them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from shmio.recording.check import check
from shmio.recording.reading.reader import Reader
from tests.compatibility.reading import described


@pytest.mark.parametrize("name", ["closed.mem", "killed.mem"])
def test_a_stored_recording_is_read_as_its_version_read_it(baseline: Path, name: str) -> None:
    was = json.loads((baseline / "reading.json").read_text())[name]
    is_ = json.loads(json.dumps(described(baseline / name)))
    assert is_["closed"] == (name == "closed.mem")
    for source, part in was["sources"].items():
        assert part["frames"] > 50, "there is something to read"
        for key, value in part.items():
            assert is_["sources"][source][key] == value, f"{source}: {key}"
    assert is_ == was


@pytest.mark.parametrize("name", ["closed.mem", "killed.mem"])
def test_a_stored_recording_is_found_undamaged(baseline: Path, name: str) -> None:
    with Reader(baseline / name) as reader:
        found = check(reader)
    assert (found.texts(), found.messages > 100) == ([], True)
