"""Two configurations with one instance name: commands with the other file cannot reach the running plant."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from shmio.cli import dump, supervisor, user
from shmio.local.status import read_status
from shmio.testing.cell import Cell, kill
from shmio.testing.ports import reserved_port

CONFIG = """
[instance]
name = "{}"

[[source]]
name = "cell"
connector = "memory"
layout = "cell.toml"
period_ms = 20
writable = {}
"""
TAGS = '[registers]\nMode = "INT"\n'

COMMANDS = {"shmio": user.main, "shmio-supervisor": supervisor.main, "shmio-dump": dump.main}
VERBS = (
    "shmio list",
    "shmio get cell/Mode",
    "shmio watch cell/Mode",
    "shmio set cell/Mode 3",
    "shmio inject cell/Mode 7 --keep",
    "shmio inject --list",
    "shmio inject --lift-all",
    "shmio inject --file campaign.toml",
    "shmio step --pause",
    "shmio replay",
    "shmio-dump record --for 0.1 -o dumps",
    "shmio-dump note hello",
    "shmio-supervisor status",
    "shmio-supervisor status --json",
    "shmio-supervisor logs",
    "shmio-supervisor restart cell",
    "shmio-supervisor reload",
    "shmio-supervisor down",
)


def run(words: str, *option: str) -> int:
    command, verb, *rest = words.split()
    return COMMANDS[command]([verb, *option, *rest])


def write_folder(folder: Path, instance: str, writable: str) -> Path:
    folder.mkdir()
    (folder / "cell.toml").write_text(TAGS)
    (folder / "campaign.toml").write_text('[[injection]]\nname = "x"\ntarget = "cell/Mode"\nset = 1\n')
    file = folder / "supervisor.toml"
    file.write_text(CONFIG.format(instance, writable))
    return file


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory, shared_instance: str) -> Iterator[tuple[Path, Path]]:
    """Return the running instance's file (all writable) and the other file (nothing writable)."""
    folder = tmp_path_factory.mktemp("cells").resolve()
    running = write_folder(folder / "a", shared_instance, '["**"]')
    other = write_folder(folder / "b", shared_instance, "[]")
    with reserved_port() as address:
        cell = Cell(running.parent, shared_instance, address)
        cell.up()
        yield running, other
        cell.supervisor("down", "--instance", shared_instance)


def unchanged(instance: str) -> None:
    """Assert that nothing has changed in the running plant."""
    status = read_status(instance)
    assert (status.state, [process.restarts for process in status.processes]) == ("running", [0])
    assert status.clock is not None
    assert status.clock.mode == "wall"


@pytest.mark.parametrize("named", ["by option", "in this folder"])
@pytest.mark.parametrize("words", VERBS)
def test_every_command_refuses_the_file_of_another_plant(
    words: str,
    named: str,
    files: tuple[Path, Path],
    shared_instance: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    running, other = files
    monkeypatch.chdir(other.parent)
    option = ["-c", str(other)] if named == "by option" else []
    assert run(words, *option) == 1
    output = capsys.readouterr()
    refusal = (
        f"the running instance {shared_instance!r} was started from {running}, not from {other}; "
        f"to use that instance anyway, add --instance {shared_instance}"
    )
    assert output.err == f"{refusal}\n"
    if "--json" in words:
        assert json.loads(output.out) == {"error": refusal}
    else:
        assert output.out == ""
    assert not (other.parent / "dumps").exists()
    unchanged(shared_instance)


def test_instance_option_reaches_the_plant_from_any_folder(
    files: tuple[Path, Path],
    shared_instance: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(files[1].parent)
    name = ["--instance", shared_instance]
    assert run("shmio set cell/Mode 3", *name) == 0
    capsys.readouterr()
    assert run("shmio get cell/Mode --json", *name) == 0
    assert json.loads(capsys.readouterr().out)["cell/Mode"]["value"] == 3
    for words in ("shmio list", "shmio inject --list", "shmio-dump note hello", "shmio-supervisor logs"):
        assert run(words, *name) == 0, words
    for words in ("shmio-supervisor status", "shmio-supervisor reload"):
        assert run(words, *name) == 0, words


def test_another_path_to_the_same_file_and_an_edited_file_are_accepted(
    files: tuple[Path, Path],
    tmp_path: Path,
    shared_instance: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    running, _ = files
    (tmp_path / "link").symlink_to(running.parent)
    (tmp_path / "plant.toml").symlink_to(running)
    monkeypatch.chdir(tmp_path)
    ways = ["link/supervisor.toml", "plant.toml", os.path.relpath(running), f"{running.parent}/../a/supervisor.toml"]
    for path in ways:
        assert run("shmio get cell/Mode", "-c", path) == 0, path
    edited = running.read_text() + "# edited since\n"
    running.with_suffix(".new").write_text(edited)
    running.with_suffix(".new").rename(running)  # as editors do
    monkeypatch.chdir(running.parent)
    assert run("shmio get cell/Mode") == 0
    moved = running.rename(running.with_name("moved.toml"))
    assert run("shmio get cell/Mode", "-c", str(moved)) == 1
    assert f"was started from {running}, not from {moved}" in capsys.readouterr().err
    moved.rename(running)


def test_another_file_neither_takes_over_nor_clears_a_dead_supervisors_instance(tmp_path: Path, instance: str) -> None:
    running = write_folder(tmp_path.resolve() / "a", instance, "[]")
    other = write_folder(tmp_path.resolve() / "b", instance, "[]")
    with reserved_port() as address:
        cell, stranger = Cell(running.parent, instance, address), Cell(other.parent, instance, address)
        cell.up()
        before = read_status(instance)
        assert before.supervisor is not None
        kill(before.supervisor.pid)
        told = f"was started from {running}, not from {other}"
        for verb in (["up", "--detach"], ["down"], ["status"]):
            refused = stranger.supervisor(*verb)
            assert refused.returncode == 1
            assert told in refused.stderr, verb
        cell.up()
        assert [process.pid for process in read_status(instance).processes] == [p.pid for p in before.processes]
        cell.down()
