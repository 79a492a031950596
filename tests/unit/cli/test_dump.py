"""``shmio-dump``: what it records, prints and refuses."""

from __future__ import annotations

import csv
import json
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from mcap.opcode import Opcode

from shmio.cli.dump import main
from shmio.recorder.instance_follower import StartPositions
from shmio.recording.reading.reader import Reader
from shmio.recording.selection import Selection
from shmio.segment import EventKind, Quality, Record, Segment
from shmio.testing.cell import until
from tests.unit.recorder.harness import OTHER, RING, numbers, publish, recorder, spec

Output = Callable[[], tuple[list[str], list[str]]]


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def segment(instance: str) -> Iterator[Segment]:
    with Segment.create(instance, [spec("cell"), spec("press")], []) as segment:
        yield segment
        segment.unlink()


@pytest.fixture
def said(capsys: pytest.CaptureFixture[str]) -> Output:
    """Return the lines on standard output and standard error since the last call."""

    def lines() -> tuple[list[str], list[str]]:
        captured = capsys.readouterr()
        return captured.out.splitlines(), captured.err.splitlines()

    return lines


@pytest.fixture
def file(segment: Segment, tmp_path: Path) -> str:
    """Make a recording of good and bad frames, a command, a change of layout and a gap."""
    work = recorder(segment, tmp_path / "dumps")
    cell = segment.writer("cell")
    for value in (7, 7, 8):
        cell.publish(value.to_bytes(2, "big"), cycle=value)
    cell.event(Record(EventKind.WRITTEN, "", 4, 99, 0, 1, 0, 0, 2))
    cell.event(Record(EventKind.QUALITY, "cable out"), quality=Quality.BAD)
    cell.publish(b"\0\x08", cycle=9, quality=Quality.BAD, reason="cable out")
    work.run_once()
    press = segment.writer("press")
    publish(press, 3 * RING)
    work.run_once()
    segment.change(add=[spec("cell", OTHER)], retire=["cell"])
    segment.writer("cell").publish(b"\x40\x20\0\0\0\x05", cycle=10)
    assert work.close()
    return str(work.output.path)


def objects(lines: list[str]) -> list[dict[str, Any]]:
    return [json.loads(line) for line in lines]


def test_info_describes_a_file(file: str, segment: Segment, said: Output) -> None:
    assert main(["info", "--json", file]) == 0
    out, err = said()
    found = json.loads("\n".join(out))
    assert err == []
    assert (found["instance"], found["closed"], found["damage"]) == (segment.instance, True, [])
    assert found["size"] == Path(file).stat().st_size
    blocks = {(block["source"], block["block"]): block for block in found["blocks"]}
    old, press, new = (blocks[key] for key in (("cell", 1), ("press", 2), ("cell", 3)))
    assert (old["frames"], old["first_frame"], old["last_frame"], old["events"]) == (4, 1, 4, 3)
    assert (new["frames"], new["size"], new["layout_hash"]) == (1, 6, OTHER.hash.hex())
    assert press["frames"] + press["missed_frames"] == 3 * RING
    assert found["missed_frames"] == press["missed_frames"] > 0
    [gap] = found["gaps"]
    assert (gap["source"], gap["what"], gap["first"], gap["reason"]) == ("press", "frames", 1, "overtaken")
    assert found["bytes_per_minute"] > 0

    assert main(["info", file]) == 0
    out, _ = said()
    assert out[0] == f"{file}: {found['size'] / 1e6:.2f} MB, closed"
    assert any("press: DB1, 1 register, 2 bytes" in line for line in out)
    assert any(f"{gap['count']} frames, 1 to {gap['last']}: overtaken" in line for line in out)


def test_info_on_an_empty_recording(segment: Segment, tmp_path: Path, said: Output) -> None:
    work = recorder(segment, tmp_path)
    work.close()
    assert main(["info", str(work.output.path)]) == 0
    assert "  no frames in it" in said()[0]


def test_info_folds_equal_lines(segment: Segment, tmp_path: Path, said: Output) -> None:
    """Each reload gives the source another block with the same contents, so ``info`` prints one line for all."""
    work = recorder(segment, tmp_path / "dumps")
    for turn in range(3):
        publish(segment.writer("cell"), 1, first=turn)
        work.run_once()
        segment.change(add=[spec("cell")], retire=["cell"])
    assert work.close()
    assert main(["info", str(work.output.path)]) == 0
    out, _ = said()
    [line] = [line for line in out if "  cell: " in line]
    assert line.endswith(": 1 frame, 1 event (3 of these)")


def test_cat_prints_a_line_for_each_change(file: str, said: Output) -> None:
    assert main(["cat", file, "cell/count"]) == 0
    out, err = said()
    stamp = r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d\.\d{3}"
    expected = [
        rf"{stamp}  cell  event 1 after frame 0: started: pid \d+",
        r"time +cell  frame  count",
        rf"{stamp}  cell  1      7",
        rf"{stamp}  cell  3      8",
        rf"{stamp}  cell  event 2 after frame 3: written cell/count/in by grpc, command 99\.0",
        rf"{stamp}  cell  event 3 after frame 3: quality bad: cable out",
        rf"{stamp}  cell  4      8      bad: cable out",
        rf"{stamp}  cell  event 1 after frame 0: started: pid \d+",
        r"time +cell  frame  count",
        rf"{stamp}  cell  1      5",
    ]
    assert len(out) == len(expected), out
    for line, pattern in zip(out, expected, strict=True):
        assert re.fullmatch(pattern, line), (line, pattern)
    assert err == []


def test_cat_prints_json_lines(file: str, said: Output) -> None:
    assert main(["cat", "--json", file, "cell/*"]) == 0
    found = objects(said()[0])
    frames = [line for line in found if "frame" in line]
    assert [(line["frame"], line["quality"], line["values"]) for line in frames] == [
        (1, "good", {"count": 7}),
        (3, "good", {"count": 8}),
        (4, "bad", {"count": 8}),
        (1, "good", {"speed": 2.5, "count": 5}),
    ]
    assert {"time", "source", "cycle", "reason", "provenance"} < set(frames[0])
    assert frames[0]["time"].endswith("Z")
    events = [line for line in found if "event" in line]
    assert [line["kind"] for line in events] == ["started", "written", "quality", "started"]
    assert (events[1]["after_frame"], events[1]["command"], events[1]["size"]) == (3, 99, 2)


def test_cat_prints_gaps_in_place(file: str, said: Output) -> None:
    assert main(["cat", "--json", file, "press/count"]) == 0
    found = objects(said()[0])
    where = next(index for index, line in enumerate(found) if "missed" in line)
    assert found[where]["missed"] == found[where]["last"]
    assert found[where + 1]["frame"] == found[where]["last"] + 1
    assert main(["cat", file]) == 0
    assert any("frames missed, 1 to" in line for line in said()[0]), "also without a pattern"


def test_cat_limits_its_output_to_the_time_range(file: str, said: Output) -> None:
    with Reader(Path(file)) as reader:
        times = [message.log_ns for message in reader.messages() if message.channel.source]
    assert main(["cat", "--json", file, "--from", "1e6"]) == 0
    out, [line] = said()
    assert out == []
    when = r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d\.\d{3}"
    assert re.search(
        rf": nothing that you selected was recorded in that time; the recording goes from {when} to {when}$", line
    )
    assert main(["cat", "--json", file, "--to", "0", "cell"]) == 0
    out, err = said()
    assert ([line["event"] for line in objects(out)], err) == ([1], [])
    assert main(["cat", "--json", file, "--from", "2020-01-01", "--to", "2020-01-01T10:00:00Z"]) == 0
    assert said()[0] == []
    assert main(["cat", "--json", file, "--from", "2020-01-01T10:00:00+02:00", "cell"]) == 0
    assert len(said()[0]) == 8
    assert min(times) == times[0]


@pytest.mark.parametrize("time", ["yesterday", "nan", "1e400", "2026-13-01"])
def test_invalid_time_is_refused(file: str, time: str, said: Output) -> None:
    assert main(["cat", file, f"--from={time}"]) == 1
    out, [line] = said()
    assert line.startswith(f"--from: {time!r} is neither a time such as")
    assert out == []


@pytest.mark.parametrize("verb", [["cat"], ["cut", "-o", "new"], ["export", "-o", "new"]])
def test_an_end_before_its_beginning_is_refused(file: str, verb: list[str], said: Output) -> None:
    assert main([*verb, file, "--from", "3", "--to", "2.5"]) == 1
    assert said() == ([], ["--to 2.5 is before --from 3"])
    assert main([*verb, file, "--from", "2026-01-02", "--to", "2026-01-01T08:00:00Z"]) == 1
    assert said() == ([], ["--to 2026-01-01T08:00:00Z is before --from 2026-01-02"])
    assert not Path("new").exists()


def test_path_without_a_register_is_refused(file: str, said: Output) -> None:
    assert main(["cat", file, "cell/cout"]) == 1
    assert said() == ([], ["cell/cout: DB1 has no such register; did you mean 'cell/count'?"])
    assert main(["cat", file, "cell/x*"]) == 1
    assert said()[1] == ["cell/x*: this recording has no such register"]
    assert main(["cat", file, "cell/speed"]) == 0, "only the second layout has speed"
    assert main(["cat", file, "count"]) == 1
    assert said()[1] == ["count: 'count' is not one of the 2 sources; begin the path with cell/… or press/…"]


def test_cat_of_several_files_refers_to_merge(file: str, said: Output) -> None:
    assert main(["cat", file, file]) == 1
    assert said() == (
        [],
        [f"{file} is a file, but cat prints only one; join the files with shmio-dump merge FILE… -o NEW"],
    )


@pytest.mark.parametrize(
    "verb", [["info"], ["cat"], ["verify"], ["recover"], ["cut", "-o", "x"], ["campaign", "-o", "x"]]
)
def test_file_that_is_no_recording_is_refused_in_one_line(
    verb: list[str], file: str, tmp_path: Path, said: Output
) -> None:
    data = Path(file).read_bytes()
    contents = {"short": data[:5], "magic": data[:8], "header": data[:40], "text": b"some text", "empty": b""}
    for name, content in contents.items():
        Path(name).write_bytes(content)
    begun = "has no content: its recorder was killed before it wrote anything, or has just started"
    for path, why in (
        (str(tmp_path), f"is a directory; name the recordings in it: {tmp_path}/*.mem"),
        (".", "is a directory; name the recordings in it: ./*.mem"),
        ("short", begun),
        ("magic", begun),
        ("header", begun),
        ("text", "is not a recording: it does not begin like an MCAP file"),
        ("empty", "is empty: its recorder wrote nothing"),
    ):
        assert main([*verb, path]) == 1
        assert said() == ([], [f"{path} {why}"])
    assert main([*verb, "no.mem"]) == 1
    assert said() == ([], ["no.mem: No such file or directory"])


def test_empty_recording_is_undamaged(segment: Segment, tmp_path: Path, said: Output) -> None:
    work = recorder(segment, tmp_path, selection=Selection(["nobody"]))
    work.close()
    path = work.output.path
    assert main(["verify", str(path)]) == 0
    assert said() == ([f"{path}: closed; the recording is empty, no damage"], [])
    assert main(["cut", str(path), "-o", "x"]) == 1
    assert said() == ([], [f"{path}: the recording is empty"])


def test_unclosed_recording_is_read_and_reported(file: str, said: Output) -> None:
    data = Path(file).read_bytes()
    Path("cut.mem").write_bytes(data[:-600])
    assert main(["info", "--json", "cut.mem"]) == 0
    found = json.loads("\n".join(said()[0]))
    assert (found["closed"], found["damage"]) == (False, [])
    assert main(["info", "cut.mem"]) == 0
    told = said()[0][0].partition(" MB, ")[2]
    assert re.fullmatch(
        r"not closed \(it ends within .*\): it is still being written, or its recorder was killed", told
    )
    assert main(["verify", "cut.mem"]) == 0
    assert said()[0][0].startswith(f"cut.mem: {told}; "), "the same words as info"
    assert main(["cat", "cut.mem", "cell"]) == 0
    out, [line] = said()
    assert len(out) == 10
    assert line == f"cut.mem: {told}"


@pytest.fixture
def damaged(segment: Segment, tmp_path: Path, file: str) -> tuple[str, str]:
    """Make two recordings of 30 frames in three chunks: an undamaged one, and one with damage in the second chunk."""
    work = recorder(segment, tmp_path / "steady", selection=Selection(["press"]), start=StartPositions(first=False))
    for turn in range(3):
        publish(segment.writer("press"), 10, first=10 * turn)
        work.run_once()
        work._writer.flush()
    assert work.close()
    content = bytearray(work.output.path.read_bytes())
    with Reader(work.output.path) as reader:
        chunk = [record for record in reader.records.walk() if record.opcode == Opcode.CHUNK][1]
    content[chunk.at + chunk.size // 2] ^= 0xFF
    Path("bad.mem").write_bytes(content)
    return str(work.output.path), "bad.mem"


TIME = r"[-\d]+ [:\d]+\.\d{3}"
WHERE = rf"lost after {TIME}, before {TIME} \(bytes \d+ to \d+\): bad\.mem: the chunk at byte \d+ is damaged: .*"


def test_verify_locates_damage(damaged: tuple[str, str], said: Output) -> None:
    file, bad = damaged
    assert main(["verify", file]) == 0
    assert said() == ([f"{file}: closed; 3 chunks and 33 messages are whole, no damage"], [])
    assert main(["verify", bad, file]) == 1
    out, err = said()
    [place, events, frames] = [line for line in out if line.startswith("  damage: ")]
    assert re.fullmatch(f"  damage: {WHERE}", place)
    first = 3 * RING + 11
    assert (
        frames
        == f"  damage: press, block 1: frames {first} to {first + 9} are missing, but no gap is recorded for them"
    )
    assert events.startswith("  damage: press, block 1: events ")
    assert out[-1].endswith("no damage"), "the undamaged file is reported, too"
    assert err == []
    assert main(["verify", "--json", bad]) == 1
    found = json.loads("\n".join(said()[0]))
    assert (found["closed"], found["chunks"], found["messages"], len(found["damage"])) == (True, 2, 22, 3)


def test_cat_as_csv(file: str, said: Output) -> None:
    assert main(["cat", "--csv", file, "cell"]) == 0
    out, err = said()
    rows = list(csv.reader(out))
    assert err == []
    own = ["time", "source", "what", "number", "quality", "text", "path", "value", "direction", "by"]
    assert rows[0] == [*own, "count", "speed"]
    about = rows[0].index("path")
    [written] = [row for row in rows if row[2] == "written"]
    assert written[about : about + 4] == ["cell/count", "", "in", "grpc"]
    rows = [row[:about] + row[about + 4 :] for row in rows]
    assert [row[1:] for row in rows if row[2] == "frame"] == [
        ["cell", "frame", "1", "good", "", "7", ""],
        ["cell", "frame", "3", "good", "", "8", ""],
        ["cell", "frame", "4", "bad", "cable out", "8", ""],
        ["cell", "frame", "1", "good", "", "5", "2.5"],
    ], "the last frame has the layout of the reload"
    assert ["cell", "quality", "bad", "cable out"] in [row[1:3] + row[4:6] for row in rows]
    assert {len(row) for row in rows} == {8}
    with pytest.raises(SystemExit):
        main(["cat", "--csv", "--json", file])


def test_cat_continues_after_a_damaged_chunk_and_reports_the_loss(damaged: tuple[str, str], said: Output) -> None:
    file, bad = damaged
    assert main(["cat", "--json", file]) == 0
    whole = objects(said()[0])
    assert main(["cat", "--json", bad]) == 1
    out, [line] = said()
    assert objects(out) == whole[:11] + whole[-11:]
    assert re.fullmatch(rf"bad\.mem: {WHERE}", line)


def test_damaged_channel_description_affects_no_other_channel(segment: Segment, tmp_path: Path, said: Output) -> None:
    """The damage is in all chunks that describe channels, and in the first copy in the index."""
    work = recorder(segment, tmp_path / "two")
    for turn in range(3):
        for source in ("cell", "press"):
            publish(segment.writer(source), 10, first=10 * turn)
        work.run_once()
        work._writer.flush()
    assert work.close()
    content = bytearray(work.output.path.read_bytes())
    with Reader(work.output.path) as reader:
        chunks = [record for record in reader.records.walk() if record.opcode == Opcode.CHUNK]
        describing = {r for r in chunks if any(code == Opcode.CHANNEL for code, _ in reader.records.chunk(r))}
        lost = next(record for record in reader.records.summary() if record.opcode == Opcode.CHANNEL)
        list(reader.messages())
    topic = reader.channels[int.from_bytes(content[lost.at : lost.at + 2], "little")].topic
    for record in describing:
        content[record.at + record.size - 1] ^= 1
    content[lost.at + 7] = 0xFF  # the length of its topic
    Path("bad.mem").write_bytes(content)

    assert topic.startswith("cell/")
    assert main(["info", "--json", "bad.mem"]) == 1
    out, err = said()
    found = json.loads("\n".join(out))
    assert err == []
    assert f"bad.mem: the description of a channel is damaged (byte {lost.at}, in the index)" in found["damage"]
    assert {block["source"]: block["frames"] for block in found["blocks"]}["press"] > 0
    assert main(["verify", "bad.mem"]) == 1
    out, err = said()
    assert any("its checksum is wrong" in line for line in out)
    assert err == []
    assert main(["cat", "--json", str(work.output.path)]) == 0
    whole = objects(said()[0])
    assert main(["cat", "--json", "bad.mem"]) == 1
    out, err = said()
    kind = topic.removeprefix("cell/").removesuffix("s")
    kept = [line for line in objects(out) if line["source"] == "press"]
    assert kept == [line for line in whole if line["source"] == "press"][-len(kept) :]
    assert [line["frame"] for line in kept if "frame" in line][-20:] == list(range(11, 31))
    assert not any(line["source"] == "cell" and kind in line for line in objects(out))
    assert any("which has no description" in line for line in err)


def test_cat_reports_a_damaged_layout_and_prints_the_other_blocks(file: str, said: Output) -> None:
    data = Path(file).read_bytes()
    assert data.count(b'"path":"speed"') == 1
    Path("bad.mem").write_bytes(data.replace(b'"path":"speed"', b'"path":"spred"'))
    assert main(["cat", "--json", "bad.mem", "cell/count"]) == 1
    out, [line] = said()
    assert [entry["frame"] for entry in objects(out) if "frame" in entry] == [1, 3, 4]
    assert line == "bad.mem: the layout of cell/frames is damaged"


def test_record_ends_after_its_duration(segment: Segment, said: Output) -> None:
    assert main(["record", "--instance", segment.instance, "-o", "mine", "--for", "0.01", "--source", "press"]) == 0
    out, err = said()
    [file] = Path("mine").iterdir()
    assert out == []
    assert any(line.startswith(f"recording press of {segment.instance} to {file}") for line in err)
    assert err[-1].startswith(f"{file}: 0 frames, 0 events, 0 missed")
    with Reader(file) as reader:
        assert list(reader.messages()) == []
        assert reader.records.closed
        assert reader.about["recorder"] == "shmio-dump"


@pytest.mark.parametrize("sign", [signal.SIGINT, signal.SIGTERM])
def test_signal_closes_the_files_of_concurrent_recorders(segment: Segment, sign: signal.Signals) -> None:
    command = [sys.executable, "-m", "shmio.cli.dump", "record", "--instance", segment.instance]
    recorders = [subprocess.Popen(command, stderr=subprocess.PIPE, text=True) for _ in range(2)]
    try:
        writer = segment.writer("cell")

        def all_have_some() -> bool:
            publish(writer, 1, first=writer.block.ring.head())
            files = list(Path("dumps").glob("*.mem"))
            return len(files) == 2 and all(file.stat().st_size and numbers(file) for file in files)

        until(all_have_some, "frames in both files")
        for process in recorders:
            process.send_signal(sign)
        errors = [process.communicate(timeout=60)[1] for process in recorders]
    finally:
        for process in recorders:
            process.kill()
            process.wait()
    assert [process.returncode for process in recorders] == [0, 0], errors
    for file in Path("dumps").glob("*.mem"):
        found = numbers(file)
        assert found == list(range(found[0], writer.block.ring.head() + 1))
        with Reader(file) as reader:
            list(reader.messages())
            assert reader.records.closed


def test_the_end_of_the_instance_ends_a_recording(segment: Segment) -> None:
    command = [sys.executable, "-m", "shmio.cli.dump", "record", "--instance", segment.instance]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        until(lambda: any(Path("dumps").glob("*.mem")), "a file")
        segment.unlink()
        errors = process.communicate(timeout=60)[1]
    assert process.returncode == 0
    assert f"instance {segment.instance!r} has stopped" in errors


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--source", "pres"], "unknown source 'pres'; did you mean 'press'?"),
        (["-o", "text"], "cannot create a recording in text: File exists"),
    ],
)
def test_unknown_source_or_unusable_folder_is_refused(
    segment: Segment, arguments: list[str], message: str, said: Output
) -> None:
    Path("text").touch()
    assert main(["record", "--instance", segment.instance, *arguments]) == 1
    assert said()[1][-1] == message


def test_record_without_a_running_instance_is_refused(said: Output) -> None:
    assert main(["record", "--instance", "test-none"]) == 1
    assert "no instance 'test-none' is running" in said()[1][0]


@pytest.mark.parametrize("option", ["--before", "--after"])
def test_before_and_after_need_when(option: str, said: Output) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["record", option, "3"])
    assert "--before and --after need --when" in said()[1][-1]


@pytest.mark.parametrize("seconds", ["0", "-1", "nan", "x", "inf"])
def test_a_duration_is_a_positive_number(seconds: str, said: Output) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["record", f"--for={seconds}"])
    assert stop.value.code == 2
    assert "is not a number of seconds above 0" in said()[1][-1]
