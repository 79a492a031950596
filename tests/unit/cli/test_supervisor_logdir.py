"""A folder of log files belongs to one instance."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path

import pytest

from shmio.cli.instance.logdir import LOCK_NAME, held
from shmio.cli.supervisor import main
from shmio.errors import ConfigError


def test_a_second_instance_is_refused_by_the_name_of_the_first(tmp_path: Path) -> None:
    folder = tmp_path / "logs"
    refused = pytest.raises(ConfigError, match=r"instance\.log_dir: instance 'a50' writes its logs")
    with held(folder, "a50"), refused, held(folder, "b50"):
        pass
    with held(folder, "b50"):
        assert (folder / LOCK_NAME).read_text() == "b50\n"


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "logs").touch()
    with pytest.raises(ConfigError, match=r"instance\.log_dir: cannot write .*logs"), held(tmp_path / "logs", "a50"):
        pass


def test_what_a_link_leads_to_is_not_touched(tmp_path: Path) -> None:
    (tmp_path / "precious").write_text("as it was")
    (tmp_path / LOCK_NAME).symlink_to("precious")
    with pytest.raises(ConfigError, match=r"instance\.log_dir: cannot write"), held(tmp_path, "a50"):
        pass
    assert (tmp_path / "precious").read_text() == "as it was"


def test_a_full_disk_keeps_nothing_from_running(
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
        f"supervisor.toml: warning: {key}: {tmp_path}/{folder} cannot be made in {tmp_path}: the disk is full: "
        "make room, or choose another folder"
        for key, folder in (("instance.log_dir", "logs"), ("recorder.directory", "dumps"))
    ]
    assert sorted(tmp_path.iterdir()) == before
