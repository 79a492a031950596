"""Cells for the tests of a whole instance."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from shmio.testing.cell import CONFIG, Cell
from shmio.testing.ports import reserved_port

ROOT = Path(__file__).parents[2]


@pytest.fixture
def make_cell(tmp_path: Path, instance: str) -> Iterator[Callable[..., Cell]]:
    """Write a cell's folder; whatever runs of it at the end of the test is stopped."""
    with ExitStack() as stack:
        made: list[Cell] = []

        def make(period_ms: float = 20, config: str = CONFIG) -> Cell:
            plc, grpc = (stack.enter_context(reserved_port()) for _ in range(2))
            shutil.copy(ROOT / "db201.db", tmp_path)
            text = config.format(instance=instance, period_ms=period_ms, plc=plc, grpc=grpc)
            (tmp_path / "supervisor.toml").write_text(text)
            cell = Cell(tmp_path, instance, grpc)
            made.append(cell)
            return cell

        yield make
        for cell in made:
            cell.supervisor("down")


@pytest.fixture
def cell(make_cell: Callable[..., Cell]) -> Cell:
    """The A50 cell, running."""
    cell = make_cell()
    cell.up()
    return cell
