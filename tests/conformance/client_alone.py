"""A pytest plugin for scripts/test-client: remote cells conform with the distribution shmio-client alone.

It refuses imports of what the client's users need not have: shmio's other packages, their libraries,
and modules of the standard library that exist on Linux only.
"""

from __future__ import annotations

import importlib.abc
import json
import os
import sys
from collections.abc import Iterator, Sequence
from importlib.machinery import ModuleSpec
from types import ModuleType

import pytest

REFUSED = frozenset(
    {"argcomplete", "fcntl", "grp", "mcap", "paho", "posix_ipc", "pwd", "resource", "snap7", "syslog", "termios"}
    | {"zstandard", "shmio.audit", "shmio.connectors", "shmio.local", "shmio.recording", "shmio.segment"}
)
COMMON = "fcntl", "grp", "pwd", "resource", "termios"
"""Modules that the standard library or pytest may have imported before the tests."""


class Refuser(importlib.abc.MetaPathFinder):
    """Refuses the imports."""

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None, /
    ) -> ModuleSpec | None:
        if name in REFUSED:
            raise ModuleNotFoundError(f"{name} is refused by this test", name=name)
        return None


def pytest_configure() -> None:
    assert "shmio" not in sys.modules
    for name in COMMON:
        sys.modules.pop(name, None)
    sys.meta_path.insert(0, Refuser())

    from shmio.testing.cell import Cell

    def status(cell: Cell) -> object:
        return json.loads(cell.output("shmio-supervisor", "status", "--json"))

    setattr(Cell, "status", status)  # noqa: B010  the original reads the segment


@pytest.fixture(scope="module")
def shared_instance() -> str:
    return f"t-client-{os.getpid()}"


@pytest.fixture(scope="session", autouse=True)
def nothing_refused_was_imported() -> Iterator[None]:
    yield
    assert sorted(REFUSED & sys.modules.keys()) == []
