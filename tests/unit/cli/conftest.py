"""What all tests of commands share."""

from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def free_ports(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the examples' ports be free in this process, though another instance on this host may use them."""
    monkeypatch.setattr("shmio.plan.ports._taken", lambda *_: False)
