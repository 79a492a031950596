"""Folders of the configuration that are on a full disk."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path

import pytest

from shmio.cli.supervisor import main


def test_full_disk_is_only_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["init"]) == 0
    before = sorted(tmp_path.iterdir())

    def write(_: Path) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("shmio.config.folder._write", write)
    capsys.readouterr()
    assert main(["check", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["warnings"] == [
        f"supervisor.toml:{line}: warning: {key}: {tmp_path}/{folder} cannot be created in {tmp_path}: the disk is "
        "full; make room, or choose another folder"
        for key, folder, line in (("instance.log_dir", "logs", 3), ("recorder.directory", "dumps", 36))
    ]
    assert sorted(tmp_path.iterdir()) == before
