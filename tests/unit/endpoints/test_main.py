"""The endpoint's process, without its supervisor."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from shmio.endpoints.grpc.__main__ import run
from shmio.segment import Segment
from tests.unit.endpoints.harness import TIMEOUT_S


def test_it_beats_while_layouts_are_read(segment: Segment, instance: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else a reload with several big ones would look like a hang, and the endpoint would be killed."""
    begun, going_on = threading.Event(), threading.Event()
    stops: list[Callable[[], object]] = []
    beats: list[object] = []

    def report(counters: object) -> None:
        if begun.is_set():
            beats.append(counters)
        if len(beats) == 3:
            going_on.set()
            stops[0]()

    with Segment.open(instance, writable=True) as opened:
        refresh = opened.refresh

        def slow() -> bool:
            begun.set()
            assert going_on.wait(TIMEOUT_S)
            return refresh()

        monkeypatch.setattr(opened, "refresh", slow)
        worker: Any = SimpleNamespace(
            on_stop=stops.append,
            config={"listen": ["127.0.0.1:0"]},
            slot=opened.processes.find("grpc"),
            segment=opened,
            log=logging.getLogger("test"),
            running=lambda: None,
            report=report,
        )
        run(worker)
    assert len(beats) >= 3
