"""The files of one cell, when the process ends at any step."""

from __future__ import annotations

import os
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import polars
import pytest

from shmio.fabric.archive.cell_files import CellFiles
from shmio.segment import Segment
from tests.unit.fabric.stored import CELL, Stored, Uplink
from tests.unit.recorder.harness import publish

CREATED = datetime(2026, 11, 27, tzinfo=UTC)


class EndedError(BaseException):
    """The process ends here."""


def end_before_call(patch: pytest.MonkeyPatch, target: str, count: int) -> None:
    """End at the n-th call of a function."""
    owner, _, name = target.rpartition(".")
    left = count

    def counted(before: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            nonlocal left
            left -= 1
            if not left:
                raise EndedError
            return before(*arguments, **options)

        return call

    module: Any = {"os": os, "Path": Path}[owner]
    patch.setattr(module, name, counted(getattr(module, name)))


def add(files: CellFiles, messages: list[Stored], layout: Any) -> None:
    """Add the messages of a stream from the first one that the files do not have."""
    files.begin(CREATED, len(messages))
    for sequence in range(files.received + 1, len(messages) + 1):
        message = messages[sequence - 1]
        files.add(sequence, message.subject.split(".")[4], message.header, layout, message.data)


@pytest.mark.parametrize("target", ["os.fsync", "Path.replace", "Path.open", "Path.mkdir"])
def test_each_frame_is_in_one_file_wherever_the_process_ends(
    segment: Segment, tmp_path: Path, target: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    uplink = Uplink(segment)
    layout = segment.blocks["cell"].layout
    messages: list[Stored] = []
    dead: list[CellFiles | None] = []
    published = 0
    while True:
        for source in ("cell", "press"):
            publish(segment.writer(source), 20, first=published)
        published += 20
        messages += uplink.messages(each=3)
        with monkeypatch.context() as patch:
            end_before_call(patch, target, len(dead) + 1)
            files = None
            try:
                files = CellFiles(tmp_path, CELL)
                add(files, messages, layout)
                files.commit()
            except EndedError:
                dead.append(files)
            else:
                break
    assert len(dead) >= 2
    for source in ("cell", "press"):
        found = sorted(tmp_path.glob(f"cell=*/day=*/{source}-*.parquet"))
        numbers = [number for file in found for number in polars.read_parquet(file)["number"]]
        assert sorted(numbers) == list(range(1, published + 1))
    assert not list(tmp_path.rglob("*.part"))
    for one in dead:
        if one is not None:
            one.discard()


def test_numbers_that_the_server_uses_again_do_not_replace_files(segment: Segment, tmp_path: Path) -> None:
    """A server that lost power may have lost its newest messages."""
    uplink = Uplink(segment)
    layout = segment.blocks["cell"].layout
    publish(segment.writer("cell"), 10)
    messages = uplink.messages()
    files = CellFiles(tmp_path, CELL)
    add(files, messages, layout)
    files.commit()
    publish(segment.writer("cell"), 2)
    add(files, messages[:5] + uplink.messages()[1:], layout)
    files.commit()
    found = [number for file in tmp_path.rglob("*.parquet") for number in polars.read_parquet(file)["number"]]
    assert sorted(found) == list(range(1, 13))


def test_rows_do_not_stay_in_memory(segment: Segment, tmp_path: Path) -> None:
    uplink = Uplink(segment)
    layout = segment.blocks["cell"].layout
    publish(segment.writer("cell"), 100)
    files = CellFiles(tmp_path, CELL)
    add(files, uplink.messages(), layout)
    assert files.memory > 0
    files.flush()
    assert files.memory == 0
    assert files.largest > 0
    files.discard()
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
