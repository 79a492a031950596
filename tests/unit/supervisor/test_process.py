"""A child process: its description, its environment, and the text that says how it ended."""

from __future__ import annotations

import json
import os
import select
from pathlib import Path

import pytest

from shmio.supervisor.process import ChildProcess, describe_end


def run(
    module: str, folder: Path, monkeypatch: pytest.MonkeyPatch, description: bytes = b"{}"
) -> tuple[ChildProcess, int]:
    monkeypatch.setenv("PYTHONPATH", str(folder))
    child = ChildProcess.spawn(module, description, folder / "a.log")
    assert select.select([child.pidfd], [], [], 30)[0], "its end makes the pidfd readable"
    return child, child.reap()


def test_a_large_description_arrives_completely(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "echo.py").write_text("import json, sys; print(len(json.loads(sys.stdin.read())))")
    child, code = run("echo", tmp_path, monkeypatch, json.dumps("x" * 500_000).encode())
    assert (code, child.last_words()) == (0, "500000")


def test_a_child_that_does_not_read_its_description_blocks_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "deaf.py").write_text("")
    assert run("deaf", tmp_path, monkeypatch, b"x" * 500_000)[1] == 0


def test_an_ended_process_no_longer_waits_for_a_processor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "mute.py").write_text("")
    assert run("mute", tmp_path, monkeypatch)[0].processor_time() == (0, 0)


def test_last_words_are_of_this_process_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.log").write_text("words of an earlier process\n")
    (tmp_path / "mute.py").write_text("")
    assert run("mute", tmp_path, monkeypatch)[0].last_words() == ""
    (tmp_path / "logs.py").write_text("print('2026-11-21T05:20:01.000000Z ERROR   cell[12] no such host')")
    assert run("logs", tmp_path, monkeypatch)[0].last_words() == "no such host"


def test_a_module_in_the_working_directory_is_not_imported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "here").mkdir()
    (tmp_path / "here" / "logging.py").write_text("raise SystemExit(7)")
    (tmp_path / "honest.py").write_text("import logging, shmio")
    monkeypatch.chdir(tmp_path / "here")
    assert run("honest", tmp_path, monkeypatch)[1] == 0


def test_it_has_a_new_session_and_inherits_no_descriptors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "me.py").write_text(
        "import os; print(os.getsid(0) == os.getpid(), sorted(map(int, os.listdir('/proc/self/fd')))[:-1])"
    )
    reader, writer = os.pipe()
    os.set_inheritable(writer, True)
    try:
        assert run("me", tmp_path, monkeypatch)[0].last_words() == "True [0, 1, 2]"
    finally:
        os.close(reader)
        os.close(writer)


@pytest.mark.parametrize(
    ("given", "found"),
    [({}, "1 None"), ({"OMP_NUM_THREADS": "3"}, "None 3"), ({"OPENBLAS_NUM_THREADS": "2"}, "2 None")],
)
def test_numpy_starts_no_threads_unless_the_user_wants_them(
    given: dict[str, str], found: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")
    for name in (*names, "GOTO_NUM_THREADS"):
        monkeypatch.delenv(name, raising=False)
    for name, value in given.items():
        monkeypatch.setenv(name, value)
    (tmp_path / "show.py").write_text(f"import os; print(*map(os.environ.get, {names}))")
    assert run("show", tmp_path, monkeypatch)[0].last_words() == found


@pytest.mark.parametrize(
    ("code", "words"),
    [(0, "ended by itself"), (1, "exit status 1"), (-9, "killed by SIGKILL"), (-11, "killed by SIGSEGV")],
)
def test_an_exit_status_in_words(code: int, words: str) -> None:
    assert describe_end(code) == words


def test_a_signal_without_a_name_in_words() -> None:
    assert describe_end(-50) == "killed by signal 50"
