"""Commands that write files on a full disk: they name the file, and leave nothing behind."""

from __future__ import annotations

import resource
from collections.abc import Callable
from pathlib import Path

import pytest

from shmio.cli import layout, supervisor, user

TAGS = '"Count","%MW10","Int"\n'


@pytest.mark.parametrize(
    ("main", "arguments", "named", "room"),
    [
        (layout.main, ["import", "tags.sdf", "-o", "new.toml"], "new.toml", 10),
        (supervisor.main, ["init", "-c", "new/new.toml"], "new/new.toml", 10),
        (supervisor.main, ["init", "-c", "new/new.toml"], "new/", 3000),
        (supervisor.main, ["new-connector", "new", "-o", "new/made"], "new/made/", 10),
        (user.main, ["fabric", "server-config", "-o", "new", "--cell", "plant1.line1.a"], "new/", 10),
    ],
)
def test_commands_name_the_file_and_leave_nothing(
    main: Callable[[list[str]], int],
    arguments: list[str],
    named: str,
    room: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("tags.sdf").write_text(TAGS)
    Path("new").mkdir()
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, before[1]))  # like a full disk
    try:
        status = main(arguments)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert status != 0
    (told,) = [line for line in capsys.readouterr().err.splitlines() if "File too large" in line]
    assert told.startswith(named), told
    assert [path for path in Path().rglob("*") if path.is_file()] == [Path("tags.sdf")]
    assert main(arguments) == 0, "another attempt finds the place free"
