"""Processes that save and restore their state on request, as one that asks sees them."""

from __future__ import annotations

import errno
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import MagicMock, Mock

import pytest

from shmio.config import folder
from shmio.errors import SnapshotError
from shmio.layout.model import Layout, Register
from shmio.local import state_requests
from shmio.local.snapshots import ProcessStates, Snapshots
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
        assert f"folder of snapshots, {tmp_path};" in states.save("one", ["sim"], work)[1]["sim"]
    assert keeper.state == b"new"


def test_a_full_disk_is_the_reason_of_a_refusal(
    segment: Segment, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    (tmp_path / WORK).mkdir()
    monkeypatch.setattr(state_requests, "write_new", full)
    monkeypatch.setattr(folder, "_write", full)
    with serving(segment, monkeypatch, tmp_path, Keeper()) as states:
        _, refusals = states.save("one", ["sim"], tmp_path / WORK)
    expected = f"{tmp_path} cannot be written: the disk is full; make room, or choose another folder"
    assert refusals == {"sim": expected}


@pytest.mark.parametrize(
    ("states", "end"), [({}, "cell: full"), ({"other": b"x"}, "cell: full; --partial saves the rest")]
)
def test_partial_is_offered_only_if_something_remains(
    segment: Segment, tmp_path: Path, states: dict[str, bytes], end: str
) -> None:
    asked, still = Mock(), MagicMock()
    asked.names.return_value = (["cell", *states], {})
    asked.save.return_value = (states, {"cell": "full"})
    with pytest.raises(SnapshotError) as caught:
        Snapshots(segment, still, asked, lambda: tmp_path).save("one")
    assert str(caught.value) == f"cannot be saved: {end}"
