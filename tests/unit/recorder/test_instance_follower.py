"""Starts and ends of processes, and changes of the configuration, in a recording."""

from __future__ import annotations

from pathlib import Path

import pytest

from shmio.recorder import instance_follower
from shmio.recorder import recorder as recorder_module
from shmio.recorder.instance_follower import InstanceFollower, ProcessWatch
from shmio.recorder.recorder import AttachedFile
from shmio.recording.format.encoding import ProcessChange, ProcessEvent, decode_process, encode_json
from shmio.recording.reading.reader import Reader
from shmio.segment import Activity, ProcessSpec, Report, Segment
from shmio.segment.processes import Phase, ProcessSlot, Supervised
from tests.unit.recorder.harness import changes, publish, recorder


def to(slot: ProcessSlot, phase: Phase, pid: int, restarts: int = 0, why: str = "") -> None:
    """Set the slot as the supervisor and the process would."""
    slot.report = Report(pid, Activity.RUNNING)
    slot.supervised = Supervised(phase, restarts, 0, why)


def told(watch: ProcessWatch) -> list[tuple[str, str, int, str]]:
    return [(change.name, change.what, change.pid, change.why) for change in watch.check()]


def test_each_start_and_end_of_a_process_is_reported(segment: Segment) -> None:
    slot = segment.processes.find("cell")
    watch = ProcessWatch(segment)
    to(slot, Phase.STARTING, 7)
    assert told(watch) == []
    to(slot, Phase.RUNNING, 7)
    assert told(watch) == [("cell", "started", 7, "")]
    assert told(watch) == []
    to(slot, Phase.BACKOFF, 7, 0, "killed by SIGKILL")
    assert told(watch) == [("cell", "died", 7, "killed by SIGKILL")]
    to(slot, Phase.STARTING, 7, 1)
    assert told(watch) == []
    to(slot, Phase.RUNNING, 8, 1)
    assert told(watch) == [("cell", "started", 8, "")]
    to(slot, Phase.FATAL, 8, 1, "no such layout")
    assert told(watch) == [("cell", "gave up", 8, "no such layout")]
    to(slot, Phase.RUNNING, 9, 2)
    assert told(watch) == [("cell", "started", 9, "")]
    to(slot, Phase.STOPPED, 9, 2)
    assert told(watch) == [("cell", "ended", 9, "")]


def test_a_restart_between_two_looks_is_reported(segment: Segment) -> None:
    slot = segment.processes.find("cell")
    to(slot, Phase.RUNNING, 7)
    watch = ProcessWatch(segment)
    to(slot, Phase.STARTING, 7, 1, "killed by SIGKILL")
    assert told(watch) == [("cell", "died", 7, "killed by SIGKILL")]
    to(slot, Phase.RUNNING, 8, 1)
    assert told(watch) == [("cell", "started", 8, "")]
    to(slot, Phase.STARTING, 8, 1, "restarting")
    assert told(watch) == [("cell", "ended", 8, "restarting")]
    to(slot, Phase.RUNNING, 9, 2)
    assert told(watch) == [("cell", "started", 9, "")]
    to(slot, Phase.RUNNING, 10, 3)
    assert told(watch) == [("cell", "ended", 9, ""), ("cell", "started", 10, "")]


def test_a_process_added_or_removed_by_a_reload_is_reported(segment: Segment) -> None:
    slot = segment.processes.find("cell")
    to(slot, Phase.RUNNING, 7)
    watch = ProcessWatch(segment)
    segment.processes.remove(slot)
    to(segment.processes.add(ProcessSpec("press", "source")), Phase.RUNNING, 9)
    assert told(watch) == [("cell", "removed", 7, ""), ("press", "started", 9, "")]


def test_a_recording_has_the_state_and_changes_of_processes(
    segment: Segment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(instance_follower, "TURN_S", 0.0)
    slot = segment.processes.find("cell")
    to(slot, Phase.RUNNING, 7)
    work = recorder(segment, tmp_path)
    work.run_once()
    work.run_once()
    to(slot, Phase.BACKOFF, 7, 0, "killed by SIGKILL")
    work.run_once()
    assert work.close()
    found = changes(work.output.path)
    assert found == [
        ProcessChange("cell", "source", 7, ProcessEvent.IS, "", 0),
        ProcessChange("cell", "source", 7, ProcessEvent.DIED, "killed by SIGKILL", 0),
    ]


def test_changes_without_room_are_recorded_as_the_state_afterwards(
    segment: Segment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(instance_follower, "TURN_S", 0.0)
    slot = segment.processes.find("cell")
    work = recorder(segment, tmp_path)
    work.run_once()
    with monkeypatch.context() as full:
        full.setattr(type(work.output), "full", True)
        to(slot, Phase.RUNNING, 7)
        work.run_once()
    work.run_once()
    assert work.close()
    found = changes(work.output.path)
    assert found == [ProcessChange("cell", "source", 7, ProcessEvent.IS, "", 0)]


def test_a_configuration_that_changes_is_attached_again(
    segment: Segment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder_module, "CONFIG_S", 0.0)
    texts = [b"one", b"one", b"two", b"two", b""]
    now = [texts[0]]

    def attachments(source: str | None, _: int) -> list[AttachedFile]:
        config = AttachedFile("config/supervisor.toml", "application/toml", now[0], 5)
        return [config] if source is None and now[0] else []

    work = recorder(segment, tmp_path, attachments=attachments)
    for text in texts:
        now[0] = text
        work.run_once()
    now[0] = texts[-1]
    assert work.close()
    content = work.output.path.read_bytes()
    assert content.count(b"\x16\x00\x00\x00config/supervisor.toml\x10\x00\x00\x00application/toml\x03") == 2 + 0
    with Reader(work.output.path) as reader:
        list(reader.messages())
        entry = reader.attachments["config/supervisor.toml"]
        assert reader.records.read(entry.at, entry.size) == b"two"


def test_the_largest_file_is_attached_and_a_larger_one_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(recorder_module, "MAX_FILE_BYTES", 10)
    file = tmp_path / "supervisor.toml"
    files = recorder_module.ConfigFiles(file)
    file.write_bytes(bytes(10))
    assert [(one.name, one.data) for one in files(None, 0)] == [("config/supervisor.toml", bytes(10))]
    file.write_bytes(bytes(11))
    for _ in range(2):
        assert files(None, 0) == []
    assert [record.getMessage() for record in caplog.records] == [
        f"{file} is not attached to the recording: it is larger than 10 bytes"
    ]


def test_a_configuration_is_attached_without_its_secrets(tmp_path: Path) -> None:
    file = tmp_path / "supervisor.toml"
    file.write_bytes(b'[[alert]]\nname = "a"\nwebhook = "https://hooks.example/s3cr3t"\n# \xff\n')
    (attached,) = recorder_module.ConfigFiles(file)(None, 0)
    assert b"s3cr3t" not in attached.data
    assert attached.data.startswith(b'[[alert]]\nname = "a"\nwebhook = ')
    assert attached.data.endswith(b"# \xff\n")


def test_a_configuration_that_became_invalid_is_named_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    file = tmp_path / "supervisor.toml"
    file.write_text("[instance\n")
    files = recorder_module.ConfigFiles(file)
    assert files("cell", 1) == files("cell", 1) == []
    (line,) = caplog.messages
    assert line.startswith("the layout files of source cell are not attached to the recording: ")
    assert str(file) in line


def test_after_many_entries_the_next_turn_comes_sooner(segment: Segment) -> None:
    tap = InstanceFollower(segment)
    tap.take()
    calm_s = tap.pause_s
    publish(segment.writer("cell"), 1)
    tap.take()
    assert tap.pause_s == calm_s
    publish(segment.writer("cell"), 300)
    tap.take()
    assert tap.pause_s < calm_s


@pytest.mark.parametrize("data", [b"", b"{}", b'{"name": 1}', b"[" * 5000])
def test_invalid_process_changes_are_refused(data: bytes) -> None:
    with pytest.raises(ValueError, match=r"."):
        decode_process(data)


def test_a_change_survives_a_round_trip() -> None:
    change = ProcessChange("cell", "source", 7, ProcessEvent.DIED, "grün", 3)
    assert decode_process(encode_json(change)) == change
