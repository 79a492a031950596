"""Fixtures that all tests of the package use."""

from __future__ import annotations

import os
import secrets

import pytest


@pytest.fixture
def instance() -> str:
    """Return a name for an instance that no other test uses. shmio's conformance suite asks for it."""
    return f"test-{os.getpid()}-{secrets.token_hex(4)}"
