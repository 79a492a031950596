"""With ``--json``, every command also reports its failure as one object on standard output."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

from shmio.cli import dump, layout, supervisor, user

Main = Callable[[Sequence[str]], int]
NOT_THERE = ["--instance", "not-there"]
FAILING: dict[Main, dict[str, list[str]]] = {
    user.main: {
        "list": NOT_THERE,
        "get": [*NOT_THERE, "cell/a"],
        "watch": [*NOT_THERE, "cell/a"],
        "set": [*NOT_THERE, "cell/a", "1"],
        "inject": NOT_THERE,
        "step": NOT_THERE,
        "replay": NOT_THERE,
        "snapshot": [*NOT_THERE, "list"],
    },
    dump.main: {
        "record": NOT_THERE,
        "info": ["no.mem"],
        "verify": ["no.mem"],
        "cut": ["no.mem", "-o", "part.mem"],
        "export": ["no.mem", "-o", "x.csv"],
        "diff": ["no.mem", "neither.mem"],
        "cat": ["no.mem"],
        "fetch": ["no.mem", "-o", "part.mem"],
    },
    supervisor.main: {
        "status": ["-c", "no.toml"],
        "list": [],
        "reload": NOT_THERE,
        "check": ["-c", "no.toml"],
        "logs": NOT_THERE,
        "audit": NOT_THERE,
    },
}
"""Arguments with which each verb that has ``--json`` fails.

Here ``list`` has an instance: without one it lists the instances, which never fails.
"""


def verbs_with_json(parser: argparse.ArgumentParser) -> Iterator[str]:
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            yield from (name for name, verb in action.choices.items() if "--json" in verb.format_help())


@pytest.mark.parametrize("module", [user, dump, supervisor])
def test_every_verb_with_json_is_covered(module: object) -> None:
    parser: argparse.ArgumentParser = module._parser()  # type: ignore[attr-defined]
    main: Main = module.main  # type: ignore[attr-defined]
    assert set(verbs_with_json(parser)) == set(FAILING[main])


@pytest.mark.parametrize(
    ("main", "words"),
    [
        *((main, [verb, *words]) for main, verbs in FAILING.items() for verb, words in verbs.items() if words),
        (user.main, ["get", "--host", "unix:no.sock", "cell/a"]),
        (layout.main, ["no.db"]),
    ],
    ids=lambda value: " ".join(value[:2]) if isinstance(value, list) else "",
)
def test_failure_is_one_object(
    main: Main, words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main([*words, "--json"]) == 1
    out, err = capsys.readouterr()
    assert err
    assert json.loads(out) == {"error": err.rstrip("\n")}


def test_each_of_several_files_has_its_own_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("empty.mem").touch()
    assert dump.main(["info", "--json", "no.mem", "empty.mem"]) == 1
    out, err = capsys.readouterr()
    assert [one["error"] for one in json.loads(out)] == err.splitlines()
    assert len(err.splitlines()) == 2
