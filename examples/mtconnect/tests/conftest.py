"""Fixtures of all tests."""

from __future__ import annotations

import os
import secrets

import pytest


@pytest.fixture
def instance() -> str:
    """Return a name for an instance that no other test has; shmio's suite asks for it."""
    return f"test-{os.getpid()}-{secrets.token_hex(4)}"
