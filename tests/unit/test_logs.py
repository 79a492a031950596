"""Log lines and their files."""

from __future__ import annotations

import json
import logging
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from shmio import logs
from shmio.errors import ConfigError
from shmio.local.log_files import as_text, parse_line


@pytest.fixture(autouse=True)
def root_logger() -> Iterator[None]:
    root = logging.getLogger()
    before, level, raising = root.handlers[:], root.level, logging.raiseExceptions
    root.handlers = []
    yield
    for handler in root.handlers:
        with suppress(OSError):  # /dev/full
            handler.close()
    root.handlers, root.level, logging.raiseExceptions = before, level, raising
    logging.captureWarnings(False)


def test_a_line_names_time_level_process_and_fields(tmp_path: Path) -> None:
    log = logs.setup(tmp_path / "deep" / "cell.log", "cell")
    log.info("connected to %s", "plc", extra=logs.fields(pdu=960, jobs=8))
    (line,) = (tmp_path / "deep" / "cell.log").read_text().splitlines()
    assert re.fullmatch(
        rf"\d{{4}}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{{6}}Z INFO    cell\[{os.getpid()}\] connected to plc pdu=960 jobs=8",
        line,
    )


def test_a_line_as_json_has_the_same_fields_and_reads_as_text(tmp_path: Path) -> None:
    log = logs.setup(tmp_path / "cell.log", "cell", source="cell", form="json")
    log.info("connected to %s", "a\n\ud800plc", extra=logs.fields(pdu=960, took=float("nan"), of=tmp_path))
    try:
        raise ValueError("odd")
    except ValueError:
        log.exception("failed")
    first, second = (tmp_path / "cell.log").read_text().splitlines()
    found = json.loads(first)
    time = found.pop("time")
    assert found == {
        "level": "INFO", "process": "cell", "pid": os.getpid(), "message": "connected to a\n\ud800plc",
        "fields": {"source": "cell", "pdu": 960, "took": "nan", "of": str(tmp_path)},
    }  # fmt: skip
    assert "ValueError: odd" in json.loads(second)["traceback"]
    parsed = parse_line(second)
    assert (parsed["level"], parsed["process"], parsed["pid"]) == ("ERROR", "cell", os.getpid())
    assert parsed["text"].startswith("failed source=cell\n    Traceback")
    assert parse_line(as_text(second).split("\n")[0])["text"] == "failed source=cell"
    assert as_text(first.replace("\\ud800", "")).startswith(f"{time} INFO    cell[{os.getpid()}] connected to a\n")
    assert parse_line('{"time": 1}') == {
        "time": None,
        "level": None,
        "process": None,
        "pid": None,
        "text": '{"time": 1}',
    }


def test_text_from_devices_stays_on_its_line(tmp_path: Path) -> None:
    logs.setup(tmp_path / "x.log", "cell").warning("name %s", "a\nFAKE ERROR\x1b[2J")
    assert (tmp_path / "x.log").read_text().count("\n") == 1


def test_a_traceback_follows_indented(tmp_path: Path) -> None:
    log = logs.setup(tmp_path / "x.log", "cell")
    try:
        raise ValueError("odd")
    except ValueError:
        log.exception("failed")
    lines = (tmp_path / "x.log").read_text().splitlines()
    assert lines[0].endswith("failed")
    assert lines[-1] == "    ValueError: odd"
    assert all(line.startswith("    ") for line in lines[1:])


def test_files_rotate_and_old_ones_are_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(logs, "MAX_FILE_BYTES", 1000)
    log = logs.setup(tmp_path / "x.log", "cell")
    for number in range(100):
        log.info("line %d", number)
    files = sorted(file.name for file in tmp_path.iterdir())
    assert files == ["x.log", "x.log.1", "x.log.2"]
    assert all((tmp_path / name).stat().st_size <= 1000 for name in files)


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match=r"instance\.log_dir: .*file"):
        logs.setup(tmp_path / "file" / "x.log", "cell")


def test_a_log_file_is_started_as_soon_as_it_can_be_written(tmp_path: Path) -> None:
    (tmp_path / "logs").touch()
    log = logs.setup(tmp_path / "logs" / "x.log", "cell", patient=True)
    log.info("lost")
    (tmp_path / "logs").unlink()
    log.info("kept")
    (line,) = (tmp_path / "logs" / "x.log").read_text().splitlines()
    assert line.endswith("kept")


def test_a_full_disk_does_not_stop_the_process(tmp_path: Path) -> None:
    file = tmp_path / "x.log"
    file.symlink_to("/dev/full")
    logs.setup(file, "cell").info("lost")


STRAY = """
import os, sys
from pathlib import Path
from shmio import logs
file = Path(sys.argv[1])
output = os.open(file, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
os.dup2(output, 1)
os.dup2(output, 2)
logs.MAX_FILE_BYTES = 500
log = logs.setup(file, "cell", streams=True)
for number in range(100):
    log.info("line %d", number)
print("stray", flush=True)
"""


def test_a_processs_output_follows_the_rotation(tmp_path: Path) -> None:
    file = tmp_path / "x.log"
    subprocess.run([sys.executable, "-c", STRAY, str(file)], check=True)
    assert "stray" in file.read_text()


def test_a_removed_file_is_created_again_with_its_folder(tmp_path: Path) -> None:
    file = tmp_path / "logs" / "x.log"
    log = logs.setup(file, "cell")
    log.info("before")
    shutil.rmtree(tmp_path / "logs")
    log.info("after")
    assert "after" in file.read_text()
