"""A mirror's process."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.unit.connectors.fabric.harness import Mirroring, running


@pytest.fixture
def mirroring(instance: str) -> Iterator[Mirroring]:
    with running(instance) as found:
        yield found
