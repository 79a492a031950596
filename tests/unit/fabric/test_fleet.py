"""What happens to the cells of a fabric, seen between two looks at the registry."""

from __future__ import annotations

from typing import Any

import pytest

from shmio.fabric.fleet import changes, member
from shmio.fabric.registry import DEAD_S, CellEntry, Seen, SourceEntry
from shmio.version import __version__

CELL = "plant1.line3.a50"


def seen(age_s: float = 1.0, quality: str = "good", **more: Any) -> Seen:
    told: dict[str, Any] = {"host": "near", "version": __version__, "state": "running", "started": 1} | more
    sources = (SourceEntry("cell", "00", 1, 1, 1, quality, "" if quality == "good" else "the PLC is off"),)
    return Seen(
        CellEntry(
            CELL, told["host"], "a50", told["version"], "0", told["state"], told["started"], 2, sources=sources,
            note=told.get("note", ""),
        ),
        age_s, 1,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("found", "state"),
    [
        (seen(), "running"),
        (seen(6.0), "late"),
        (seen(DEAD_S), "down"),
        (seen(3600.0, state="stopped"), "stopped"),
        (seen(state="degraded"), "degraded"),
    ],
)
def test_state_follows_the_age_of_the_entry(found: Seen, state: str) -> None:
    assert member(found).state == state
    assert member(found).alive == (state in ("running", "degraded"))


def test_notes_name_another_version_and_bad_sources() -> None:
    assert member(seen()).notes == ()
    version, source = member(seen(version="0.1", quality="bad")).notes
    assert "0.1" in version
    assert __version__ in version
    assert "cell is bad (the PLC is off)" in source
    assert member(seen(state="degraded", note="recorder: the disk is full")).notes == ("recorder: the disk is full",)
    assert member(seen(3600.0, quality="bad")).notes == ()  # the quality of a cell that is down is old


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (None, seen(), ["appeared: running on near"]),
        (seen(), None, ["disappeared"]),
        (seen(), seen(2.0), []),
        (seen(), seen(7.0), ["late for 7 s, was running"]),
        (seen(7.0), seen(), ["running, was late"]),
        (seen(), seen(started=2), ["started again"]),
        (seen(), seen(host="far", started=2), ["moved from a50 on near to a50 on far"]),
        (seen(), seen(version="0.1"), ["version 0.1, was"]),
        (seen(), seen(quality="bad"), ["cell is bad: the PLC is off"]),
    ],
)
def test_changes_between_two_looks(old: Seen | None, new: Seen | None, words: list[str]) -> None:
    before, now = ({CELL: member(one)} if one else {} for one in (old, new))
    found = changes(before, now)
    assert [cell for cell, _ in found] == [CELL] * len(words)
    assert all(word in text for word, (_, text) in zip(words, found, strict=True))
