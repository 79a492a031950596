"""The parts of a recording that can be played, and errors of recordings that cannot."""

from __future__ import annotations

from pathlib import Path

import pytest

from shmio.connectors.replay.recording import Moment, Recording
from shmio.connectors.replay.source import Replay
from shmio.errors import ConfigError, RecordingError
from shmio.local.time_control import Coordinator
from shmio.segment import Quality
from tests.unit.connectors.replay.harness import (
    BEGIN_NS,
    PERIOD_NS,
    Playing,
    S,
    built,
    counts,
    image,
    record,
    recorded,
)


def test_part_begins_with_the_frame_before_its_start(tmp_path: Path, instance: str) -> None:
    file = record(tmp_path, instance)
    with built(instance) as segment, Playing(segment, file, start=0.105, end=0.3) as cell:
        coordinator = Coordinator(segment)
        coordinator.step(2 * S)
        frames = cell.frames()
        coordinator.close()
    assert counts(frames[:-1]) == list(range(5, 15))
    assert frames[-1].reason == "replay: the recording is over"


@pytest.mark.parametrize(
    ("start", "end", "error"),
    [
        (5.0, None, "start, end: there is nothing to play between these times; .* has 0.400 s from "),
        (0.2, 0.1, "there is nothing to play"),
        ("yesterday", None, "start: 'yesterday' is neither a time such as"),
        (None, float("nan"), "end: nan is neither"),
        (None, "9999-12-31T23:59:59+00:00", ""),
    ],
)
def test_invalid_part_is_refused(
    tmp_path: Path, instance: str, start: Moment | None, end: Moment | None, error: str
) -> None:
    with Recording([record(tmp_path, instance)]) as recording:
        if not error:
            assert recording.span(start, end) == recording.whole
            return
        with pytest.raises(RecordingError, match=error):
            recording.span(start, end)


def test_missing_source_is_refused(tmp_path: Path, instance: str) -> None:
    file = record(tmp_path, instance)
    with pytest.raises(ConfigError, match=r"source: .* has no frames of a source 'arm'; its sources are: cell"):
        Replay(Replay.Options(file=str(file)), "arm")
    named = Replay(Replay.Options(file=str(file), source="cell"), "arm")
    assert named.layout.name == "DB1"
    named.close()


def test_recording_without_frames_is_refused(tmp_path: Path, instance: str) -> None:
    with recorded(tmp_path, instance):
        pass
    [file] = tmp_path.glob("*.mem")
    with pytest.raises(ConfigError, match=f"file: {file} has no frames, so it cannot be played"):
        Replay(Replay.Options(file=str(file)), "cell")


def test_invalid_times_are_refused(tmp_path: Path, instance: str) -> None:
    with recorded(tmp_path, instance) as [cell]:
        cell.frame(1 << 62, image(0))
    [file] = tmp_path.glob("*.mem")
    with pytest.raises(ConfigError, match="has invalid times"):
        Replay(Replay.Options(file=str(file)), "cell")


def test_files_of_different_runs_are_refused(tmp_path: Path, instance: str) -> None:
    files = [str(record(tmp_path / name, f"{instance}{name}")) for name in "ab"]
    with pytest.raises(ConfigError, match="come from different runs"):
        Replay(Replay.Options(file=files), "cell")


@pytest.mark.parametrize("text", [b"", b"\x89MCAP0\r\n", b"no recording at all"])
def test_file_that_is_no_recording_is_refused(tmp_path: Path, text: bytes) -> None:
    file = tmp_path / "some.mem"
    file.write_bytes(text)
    with pytest.raises(ConfigError, match=f"file: {file}"):
        Replay(Replay.Options(file=str(file)), "cell")
    with pytest.raises(ConfigError, match="No such file"):
        Replay(Replay.Options(file=str(tmp_path / "none.mem")), "cell")


def test_damaged_chunk_is_bad_and_the_rest_is_played(tmp_path: Path, instance: str) -> None:
    with recorded(tmp_path, instance) as [cell]:
        for number in range(45_000):
            cell.frame(BEGIN_NS + number * PERIOD_NS, image(number % 30000, number * 7919 % 30000))
            if number % 100 == 0:
                cell.take()
    [file] = tmp_path.glob("*.mem")
    data = bytearray(file.read_bytes())
    chunks = [at for at in range(len(data) - 60) if data[at] == 6 and data[at + 41 : at + 45] == b"zstd"]
    assert len(chunks) > 2
    data[chunks[1] + 200] ^= 0xFF
    file.write_bytes(data)
    with built(instance) as segment, Playing(segment, file) as playing:
        coordinator = Coordinator(segment)
        bad = []
        seen = 0
        for _ in range(181):
            coordinator.step(5 * S)
            for frame in playing.frames():
                seen += 1
                if frame.quality is Quality.BAD:
                    bad.append(frame.reason)
        coordinator.close()
    assert bad == ["replay: not in the recording: it is damaged here", "replay: the recording is over"]
    assert 5_000 < seen < 45_000
