"""The file of a search: it survives kills at any byte, and refuses other searches."""

from __future__ import annotations

import os
import resource
from pathlib import Path

import msgspec
import pytest

from shmio.errors import ConfigError, RecordingError
from shmio.falsification.journal import NAME, Beginning, Journal, Line
from shmio.falsification.trial import Found, Result
from shmio.judging.verdict import Outcome

BEGINNING = Beginning(
    "0.1", "tpe", 1, 1, None, {"injection": [{"name": "a", "value": {"from": 0, "to": 5}}]}, 3.0, 20.0, {"model": "x"}
)
LINES = [Line({"a.value": 0.1 * n}, Result(n, "passed", [Found("é", Outcome.PASSED, 5e-324)])) for n in range(4)]


def written(folder: Path) -> bytes:
    with Journal(folder, BEGINNING, resume=False) as journal:
        for line in LINES:
            journal.add(line)
    return (folder / NAME).read_bytes()


def test_a_search_goes_on_from_any_byte(tmp_path: Path) -> None:
    whole = written(tmp_path)
    ends = [index + 1 for index, byte in enumerate(whole) if byte == 10]
    for cut in range(len(whole) + 1):
        (tmp_path / NAME).write_bytes(whole[:cut])
        with Journal(tmp_path, BEGINNING, resume=True) as journal:
            found = list(journal.lines())
            assert found == LINES[: max(0, sum(end <= cut for end in ends) - 1)]
            journal.add(LINES[3])
            assert list(journal.lines()) == [*found, LINES[3]]


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"seed": 2}, "seed is 2, but was 1"),
        ({"jobs": 4}, "jobs is 4, but was 1"),
        (
            {"campaign": {"injection": [{"name": "a", "value": {"from": 0, "to": 6}}]}},
            r"injection\[0\]\.value\.to is 6",
        ),
        ({"campaign": {"injection": []}}, "campaign.injection is"),
        ({"files": {"model": "y"}}, 'files.model is "y", but was "x"'),
        ({"step_ms": 10.0}, "step_ms is 10.0, but was 20.0"),
    ],
)
def test_another_beginning_is_refused_by_name(tmp_path: Path, change: dict[str, object], text: str) -> None:
    before = written(tmp_path)
    with pytest.raises(ConfigError, match=f"--resume: .*{text}"):
        Journal(tmp_path, msgspec.structs.replace(BEGINNING, **change), resume=True)
    assert (tmp_path / NAME).read_bytes() == before


def test_one_search_in_a_folder(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no search to continue"):
        Journal(tmp_path / "none", BEGINNING, resume=True)
    with Journal(tmp_path, BEGINNING, resume=False), pytest.raises(ConfigError, match="another search is using"):
        Journal(tmp_path, BEGINNING, resume=True)
    with pytest.raises(ConfigError, match=r"a search already.*--resume"):
        Journal(tmp_path, BEGINNING, resume=False)
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "case-001").touch()
    with pytest.raises(ConfigError, match="other files"):
        Journal(tmp_path / "own", BEGINNING, resume=False)


def test_damage_and_a_full_disk(tmp_path: Path) -> None:
    written(tmp_path)
    file = tmp_path / NAME
    file.write_bytes(file.read_bytes().replace(b'"number":1,', b'"number":"one",'))
    with Journal(tmp_path, BEGINNING, resume=True) as journal:
        with pytest.raises(ConfigError, match=f"{NAME}:3: this line is damaged"):
            list(journal.lines())
        limits = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (file.stat().st_size + 10, limits[1]))  # like a full disk
        try:
            with pytest.raises(RecordingError, match=r"File too large.*--resume"):
                journal.add(LINES[0])
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    file.write_bytes(b"{}\n")
    with pytest.raises(ConfigError, match="not the file of a search"):
        Journal(tmp_path, BEGINNING, resume=True)


@pytest.mark.parametrize("umask", [0o022, 0o077])
def test_the_file_has_the_permissions_that_the_umask_allows(tmp_path: Path, umask: int) -> None:
    before = os.umask(umask)
    try:
        written(tmp_path)
    finally:
        os.umask(before)
    assert (tmp_path / NAME).stat().st_mode & 0o777 == 0o666 & ~umask
