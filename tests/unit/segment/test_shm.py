"""Shared-memory objects: whose are trusted."""

from __future__ import annotations

import os
from types import SimpleNamespace

import pytest

from shmio.errors import SegmentError
from shmio.segment import Segment, running_instances, shm
from shmio.segment.segment import PREFIX
from shmio.segment.shm import DIRECTORY

OWN, OTHER = 1000, 1001
TEAM, PRIVATE, FOREIGN = 2000, 1000, 3000


@pytest.mark.parametrize(
    ("uid", "gid", "mode", "trusted"),
    [
        (OWN, PRIVATE, 0o600, True),
        (0, 0, 0o600, True),
        (OTHER, TEAM, 0o640, True),
        (OTHER, FOREIGN, 0o640, False),
        (OTHER, OTHER, 0o644, False),
        (OTHER, TEAM, 0o600, False),
        (OTHER, TEAM, 0o660, False),
        (OTHER, TEAM, 0o642, False),
        (OTHER, 0, 0o640, False),
        (65534, 65534, 0o666, False),
    ],
)
def test_owners(monkeypatch: pytest.MonkeyPatch, uid: int, gid: int, mode: int, trusted: bool) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: OWN)
    monkeypatch.setattr(os, "getegid", lambda: PRIVATE)
    monkeypatch.setattr(os, "getgroups", lambda: [PRIVATE, TEAM, 0])
    status = SimpleNamespace(st_uid=uid, st_gid=gid, st_mode=0o100000 | mode)
    if trusted:
        shm._require_trusted("shmio-x", status)  # type: ignore[arg-type]
        return
    with pytest.raises(SegmentError, match=r"belongs to user .*, so its values cannot be trusted; run the command as"):
        shm._require_trusted("shmio-x", status)  # type: ignore[arg-type]


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a file to another user")
def test_an_instance_of_another_user_is_refused(instance: str) -> None:
    with Segment.create(instance, [], []) as built:
        file = f"{DIRECTORY}/{PREFIX}{instance}"
        assert instance in running_instances()
        os.chown(file, 65534, -1)
        with pytest.raises(SegmentError, match="so its values cannot be trusted"):
            Segment.open(instance)
        assert instance not in running_instances()
        built.unlink()
