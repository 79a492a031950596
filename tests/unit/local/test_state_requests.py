"""Processes that save and restore their state on request, as one that asks sees them."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from shmio.errors import SnapshotError
from shmio.layout.model import Layout, Register
from shmio.local.snapshots import ProcessStates
from shmio.local.state_requests import StateRequests
from shmio.segment import Attributes, BlockSpec, ProcessSpec, Segment

LAYOUT = Layout("DB1", 1, 4, False, (Register("count", "UDINT", (), 0, None, 4, 1),))
WORK = ".work-0123456789abcdef"


class Keeper:
    """A state of a few bytes."""

    def __init__(self) -> None:
        self.state = b"new"

    def save(self, name: str) -> bytes:
        return self.state + name.encode()

    def check(self, data: bytes) -> None:
        if data == b"wrong":
            raise SnapshotError("it does not fit")

    def restore(self, data: bytes, name: str) -> None:
        self.state = data


@pytest.fixture
def segment(instance: str) -> Iterator[Segment]:
    blocks = [BlockSpec("sim", LAYOUT, 20_000_000, 500_000_000, 1 << 20, Attributes("memory", stepped=True))]
    with Segment.create(instance, blocks, [ProcessSpec("sim", "source")]) as segment:
        yield segment
        segment.unlink()


@contextmanager
def serving(segment: Segment, monkeypatch: pytest.MonkeyPatch, folder: Path, keeper: Keeper) -> Iterator[ProcessStates]:
    """Serve the requests to the process in a thread, with ``folder`` as its folder of snapshots."""
    slot = segment.processes.find("sim")
    monkeypatch.setattr(type(slot), "alive", lambda _: True)
    requests = StateRequests(segment.clock, slot.index, "sim", folder, keeper)
    over = threading.Event()

    def serve() -> None:
        bell = segment.clock.slot_bell(slot.index)
        while not over.is_set():
            seen = bell.value()
            requests.serve()
            bell.wait(seen, 20_000_000)

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield ProcessStates(segment)
    finally:
        over.set()
        thread.join()


def test_a_state_is_saved_checked_and_restored(
    segment: Segment, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    work, other = tmp_path / WORK, tmp_path / WORK.replace("0", "1")
    work.mkdir()
    other.mkdir()
    keeper = Keeper()
    with serving(segment, monkeypatch, tmp_path, keeper) as states:
        assert states.save("one", ["sim"], work) == ({"sim": b"newone"}, {})
        assert states.check("one", {"sim": b"old"}, other) == {}
        assert keeper.state == b"new"
        assert states.restore("one", {"sim": b"old"}, other) == {}
        assert keeper.state == b"old"


def test_a_refusal_has_its_reason(segment: Segment, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / WORK).mkdir()
    with serving(segment, monkeypatch, tmp_path, Keeper()) as states:
        assert states.check("one", {"sim": b"wrong"}, tmp_path / WORK) == {"sim": "it does not fit"}


def test_a_process_that_cannot_use_the_folder_refuses(
    segment: Segment, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """As if another user, such as root, had created the folder: the process cannot write its reason either."""
    work = tmp_path / WORK
    work.mkdir()
    keeper = Keeper()
    with serving(segment, monkeypatch, tmp_path / "unreachable", keeper) as states:
        assert "folder" in states.check("one", {"sim": b"old"}, work)["sim"]
        assert "folder" in states.restore("one", {"sim": b"old"}, work)["sim"]
        assert "folder" in states.save("one", ["sim"], work)[1]["sim"]
    assert keeper.state == b"new"
