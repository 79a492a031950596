"""``shmio-supervisor audit``: chooses entries, and prints them as text or JSON."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from shmio.audit.reading import EntryFilter, present_files
from shmio.cli.supervisor import main
from shmio.times import utc_text

CONFIG = """
[instance]
name = "{instance}"
[[source]]
name = "cell"
connector = "memory"
tags = "tags.toml"
"""


def entry(hour: int, who: str, action: str = "write", outcome: str = "written", **what: Any) -> str:
    found = {
        "time": f"2026-11-21T{hour:02}:00:00.000000Z", "instance": "a50", "process": "grpc", "pid": 1,
        "endpoint": "grpc",
        "kind": "token", "who": who, "from": "10.0.0.1", "action": action, "outcome": outcome, "reason": "",
        "what": what or {"cell/Outputs/1": 5}, "left_out": 0, "count": 1, "command": 0, "event": 0,
    }  # fmt: skip
    return json.dumps(found) + "\n"


@pytest.fixture
def printed(
    tmp_path: Path, instance: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., list[str]]:
    monkeypatch.chdir(tmp_path)
    Path("supervisor.toml").write_text(CONFIG.format(instance=instance))
    Path("logs").mkdir()

    def run(*words: str) -> list[str]:
        assert main(["audit", *words]) == 0
        return capsys.readouterr().out.splitlines()

    return run


def test_entries_of_all_files_are_printed_in_order(printed: Callable[..., list[str]]) -> None:
    Path("logs/audit.jsonl.10").write_text(entry(1, "anna"))
    Path("logs/audit.jsonl.2").write_text(entry(2, "bert"))
    Path("logs/audit.jsonl.old").write_text(entry(3, "nobody"))
    Path("logs/audit.jsonl").write_text(
        '{"torn' + "\n" + entry(4, "anna\x1b[31m", action="lift", source="cell", name="")
    )
    assert [file.name for file in present_files(Path("logs/audit.jsonl"))] == [
        "audit.jsonl.10", "audit.jsonl.2", "audit.jsonl"
    ]  # fmt: skip
    assert printed() == [
        "2026-11-21T01:00:00.000000Z grpc: token anna (10.0.0.1): write cell/Outputs/1 = 5: written",
        "2026-11-21T02:00:00.000000Z grpc: token bert (10.0.0.1): write cell/Outputs/1 = 5: written",
        r'2026-11-21T04:00:00.000000Z grpc: token anna\x1b[31m (10.0.0.1): lift source = cell, name = "": written',
    ]
    assert len(printed("-n", "1")) == 1
    assert json.loads(printed("--json", "-n", "1")[0])["from"] == "10.0.0.1"


def test_entries_are_chosen_by_time_actor_action_and_pattern(printed: Callable[..., list[str]]) -> None:
    lines = (
        entry(1, "anna"),
        entry(2, "anna", action="step", dt_s=1),
        entry(3, "bert", paths=["Robot/Axs1"], source="cell"),
    )
    Path("logs/audit.jsonl").write_text("".join(lines))

    def hours(*words: str) -> list[str]:
        return [line[11:13] for line in printed(*words)]

    assert hours("--since", "2026-11-21T02:00:00Z") == ["02", "03"]
    assert hours("--since", "2s") == []
    assert hours("--who", "b*") == ["03"]
    assert hours("--who", "token", "--action", "step") == ["02"]
    assert hours("cell/Outputs/*") == ["01"]
    assert hours("Robot/*") == ["03"]
    with pytest.raises(SystemExit) as wrong:
        main(["audit", "--since", "yesterday"])
    assert wrong.value.code == 2


def test_a_missing_log_is_an_error(printed: Callable[..., list[str]], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["audit"]) == 1
    assert "no audit log in" in capsys.readouterr().err


def test_a_filter_without_wishes_chooses_all() -> None:
    from shmio.audit.reading import parse_entry

    found = parse_entry(entry(1, "anna").encode())
    assert found is not None
    assert EntryFilter().chooses(found)
    assert not EntryFilter(since=utc_text(2e9)).chooses(found)
