"""Cells for the tests of a whole instance."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from shmio.testing.cell import CONFIG, Cell
from shmio.testing.ports import reserved_port

ROOT = Path(__file__).parents[2]


@contextmanager
def _cells(folder: Path, instance: str) -> Iterator[Callable[..., Cell]]:
    """Yield a function that writes a cell's folder; at the end, stop each cell."""
    with ExitStack() as stack:
        made: list[Cell] = []

        def make(period_ms: float = 20, config: str = CONFIG) -> Cell:
            plc, grpc = (stack.enter_context(reserved_port()) for _ in range(2))
            shutil.copy(ROOT / "db201.db", folder)
            text = config.format(instance=instance, period_ms=period_ms, plc=plc, grpc=grpc)
            (folder / "supervisor.toml").write_text(text)
            cell = Cell(folder, instance, grpc)
            made.append(cell)
            return cell

        yield make
        for cell in made:
            cell.supervisor("down")


@pytest.fixture
def make_cell(tmp_path: Path, instance: str) -> Iterator[Callable[..., Cell]]:
    """Return a function that writes a cell's folder, for one test."""
    with _cells(tmp_path, instance) as make:
        yield make


@pytest.fixture(scope="module")
def make_shared_cell(tmp_path_factory: pytest.TempPathFactory, shared_instance: str) -> Iterator[Callable[..., Cell]]:
    """Return a function that writes a cell's folder, for tests that leave it unchanged."""
    with _cells(tmp_path_factory.mktemp("cell"), shared_instance) as make:
        yield make


@pytest.fixture
def cell(make_cell: Callable[..., Cell]) -> Cell:
    """Start the A50 cell."""
    cell = make_cell()
    cell.up()
    return cell
