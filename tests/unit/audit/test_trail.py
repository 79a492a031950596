"""What a process writes to the audit log: who, what and the outcome, bounded, and without waiting."""

from __future__ import annotations

import contextvars
import json
import math
import os
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shmio.audit import trail
from shmio.audit.file import AuditFile, AuditSettings
from shmio.audit.trail import MAX_NAMED, MAX_TEXT, Acting, Actor, Attempt
from shmio.errors import CommandError
from shmio.testing.cell import until

ANNA = Acting(Actor("token", "anna", "10.0.0.1:5"), "grpc")


@pytest.fixture
def path(tmp_path: Path) -> Iterator[Path]:
    path = tmp_path / "audit.jsonl"
    trail.open_trail(AuditSettings(str(path), 10**7, 2), "a50", "grpc")
    yield path
    trail.close_trail()


def written(path: Path) -> list[dict[str, Any]]:
    trail.close_trail()
    return [json.loads(line) for line in path.read_bytes().splitlines()]


def test_an_entry_has_all_fields(path: Path) -> None:
    trail.record("write", {"cell/a": 1}, "refused", "why", who=ANNA, command=7, event=9)
    (entry,) = written(path)
    assert next(iter(entry)) == "time"
    del entry["time"]
    assert entry == {
        "instance": "a50", "process": "grpc", "pid": os.getpid(), "endpoint": "grpc", "kind": "token", "who": "anna",
        "from": "10.0.0.1:5", "action": "write", "outcome": "refused", "reason": "why", "what": {"cell/a": 1},
        "left_out": 0, "count": 1, "command": 7, "event": 9,
    }  # fmt: skip


def test_the_actor_of_a_task_is_that_of_its_attempts(path: Path) -> None:
    def elsewhere() -> None:
        Attempt("write", {"cell/b": 1}).end("written")

    with trail.acting(ANNA.actor, "grpc"):
        attempt = Attempt("write", {"cell/a": 1})
        thread = threading.Thread(target=contextvars.copy_context().run, args=(elsewhere,))
        thread.start()
        thread.join()
    with trail.acting(Actor("token", "bert"), "grpc"):
        attempt.end("written")
        attempt.end("written")  # only once
    trail.record("lift", {}, "done")
    assert [(entry["kind"], entry["who"]) for entry in written(path)] == [
        ("token", "anna"),
        ("token", "anna"),
        ("process", "grpc"),
    ]


def test_an_exception_ends_an_attempt_and_is_not_recorded_again(path: Path) -> None:
    acting = trail.act(ANNA.actor, "grpc")
    with pytest.raises(CommandError), Attempt("write", {}):
        raise CommandError("not writable")
    assert acting.refused
    with pytest.raises(KeyError), Attempt("write", {}):
        raise KeyError
    with Attempt("write", {}):
        pass  # the outcome comes later
    assert [(entry["outcome"], entry["reason"]) for entry in written(path)] == [
        ("refused", "not writable"),
        ("cancelled", "KeyError"),
    ]


def test_values_are_bounded(path: Path) -> None:
    trail.record("write", {f"cell/{n}": n for n in range(5000)}, "written", who=ANNA)
    values = {"array": np.arange(100_000), "text": "x" * 10_000, "bytes": bytes(100_000), "deep": [[1] * 1000] * 1000}
    trail.record("write", values, "written", "y" * 10_000, who=ANNA)
    many, large = written(path)
    assert many["what"] == {f"cell/{n}": n for n in range(MAX_NAMED)}
    assert many["left_out"] == 5000 - MAX_NAMED
    assert large["what"]["array"][:3] == [0, 1, 2]
    assert large["what"]["text"] == "x" * MAX_TEXT + "…"
    assert len(json.dumps(large)) < 6000


def test_odd_values_have_an_entry(path: Path) -> None:
    odd = {
        "nan": math.nan,
        "inf": np.float32("inf"),
        "big": 1 << 80,
        "text": "a\ud800\nb",
        "none": None,
        "np": np.int16(3),
    }
    trail.record("write", odd, "written", who=Acting(Actor("token", "\udcff"), "grpc"))

    def fail() -> dict[str, Any]:
        raise ZeroDivisionError

    trail.record("inject", fail, "injected", who=ANNA)
    first, second = written(path)
    assert (first["what"]["nan"], first["what"]["inf"], first["what"]["big"]) == ("nan", "inf", 1 << 80)
    assert (first["what"]["np"], first["what"]["text"]) == (3, "a\ud800\nb")
    assert "ZeroDivisionError" in second["what"]["error"]


def test_entries_wait_for_a_disk_and_lost_ones_are_counted(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    full = threading.Event()
    full.set()
    append = AuditFile.append

    def hindered(self: AuditFile, lines: bytes) -> None:
        if full.is_set():
            raise OSError(28, "No space left on device")
        append(self, lines)

    monkeypatch.setattr(AuditFile, "append", hindered)
    monkeypatch.setattr(trail, "RETRY_S", 0.01)
    monkeypatch.setattr(trail, "MAX_WAITING", 50)
    trail.record("write", {"n": 0}, "written", who=ANNA)
    until(lambda: "No space left" in trail.problem(), "the problem is known", 10)
    for number in range(1, 101):
        trail.record("write", {"n": number}, "written", who=ANNA)
    full.clear()
    until(lambda: not trail.problem(), "the disk has room again", 10)
    *entries, last = written(path)
    assert [entry["what"]["n"] for entry in entries] == list(range(51))
    assert (last["action"], last["outcome"], last["what"]) == ("audit", "lost", {"entries": 50})


def test_repetitions_of_a_second_are_one_entry(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trail, "MERGE_S", 0.05)
    bert = Acting(Actor("token", "bert"), "grpc")
    for number in range(100):
        trail.record("feed", {"cell/a": number}, "shadowed", who=ANNA)
        trail.record("step", {"step": number}, "done", who=bert)
        trail.record("write", {"cell/b": number}, "written", who=ANNA)
    trail.record("feed", {"cell/a": 7}, "refused", "why", who=ANNA)
    until(lambda: path.exists() and path.read_bytes().count(b'"feed"') >= 3, "an entry for repetitions", 10)
    trail.record("feed", {"cell/a": 100}, "shadowed", who=ANNA)
    entries = written(path)
    assert [entry["what"] for entry in entries if entry["action"] == "write"] == [{"cell/b": n} for n in range(100)]
    for action, count in (("feed", 101), ("step", 100)):
        found = [entry for entry in entries if entry["action"] == action and entry["outcome"] != "refused"]
        assert sum(entry["count"] for entry in found) == count
        assert len(found) < 20
        assert found[0]["count"] == 1
        assert found[-1]["what"] == ({"cell/a": 100} if action == "feed" else {"step": 99})


def test_without_an_audit_log_nothing_is_written() -> None:
    trail.open_trail(None, "a50", "grpc")
    trail.record("write", {}, "written")
    assert trail.problem() == ""
