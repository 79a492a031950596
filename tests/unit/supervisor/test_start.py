from __future__ import annotations

from pathlib import Path

import pytest

from shmio.errors import ConfigError
from shmio.supervisor.start import LOCK_NAME, hold_log_folder


def test_a_second_instance_in_a_log_folder_is_refused_and_the_first_named(tmp_path: Path) -> None:
    folder = tmp_path / "logs"
    refused = pytest.raises(ConfigError, match=r"instance\.log_dir: instance 'a50' writes its logs")
    with hold_log_folder(folder, "a50"), refused, hold_log_folder(folder, "b50"):
        pass
    with hold_log_folder(folder, "b50"):
        assert (folder / LOCK_NAME).read_text() == "b50\n"


def test_a_log_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "logs").touch()
    with (
        pytest.raises(ConfigError, match=r"instance\.log_dir: cannot write .*logs"),
        hold_log_folder(tmp_path / "logs", "a50"),
    ):
        pass


def test_the_target_of_a_link_is_not_changed(tmp_path: Path) -> None:
    (tmp_path / "precious").write_text("as it was")
    (tmp_path / LOCK_NAME).symlink_to("precious")
    with pytest.raises(ConfigError, match=r"instance\.log_dir: cannot write"), hold_log_folder(tmp_path, "a50"):
        pass
    assert (tmp_path / "precious").read_text() == "as it was"
