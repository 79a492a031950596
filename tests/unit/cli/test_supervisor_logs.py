"""``shmio-supervisor logs``: merges the log files, and follows them."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path

import pytest

from shmio.cli.supervisor import main
from shmio.local.log_files import MAX_LINE_BYTES, TAIL_BYTES, Follower, last_lines
from shmio.segment import ProcessSpec, Segment


def stamped(second: int, text: str) -> str:
    return f"2026-11-21T05:20:{second:02}.000000Z INFO    {text}\n"


@pytest.fixture
def files(tmp_path: Path) -> list[Path]:
    files = [tmp_path / "a.log", tmp_path / "b.log"]
    files[0].write_text(
        stamped(1, "a one") + stamped(4, "a four") + "    Traceback\n    of four\n" + stamped(9, "a nine")
    )
    files[1].write_text(stamped(2, "b two") + stamped(5, "b five"))
    return files


def words(lines: list[bytes]) -> list[str]:
    return [line.decode().split()[-1] for line in lines]


def test_lines_are_merged_by_time_and_tracebacks_stay_whole(files: list[Path]) -> None:
    assert words(last_lines(files, 100)) == ["one", "two", "four", "Traceback", "four", "five", "nine"]
    assert words(last_lines(files, 3)) == ["four", "five", "nine"]
    assert last_lines(files, 0) == []


def test_last_lines_of_long_files_are_those_of_the_whole_file(tmp_path: Path) -> None:
    file = tmp_path / "a.log"
    text = "".join(
        stamped(at % 60, f"line {at} " + "x" * (at % 700)) + "    traceback\n" * (at % 50 == 7) * 3000
        for at in range(2000)
    )
    file.write_text(text)
    assert file.stat().st_size > 10 * TAIL_BYTES
    lines = text.encode().splitlines()
    for count in (1, 10, 500, 2900, 3500, 40_000, 200_000):
        assert last_lines([file], count) == lines[-count:]


def test_a_missing_file_has_no_lines(tmp_path: Path) -> None:
    assert last_lines([tmp_path / "none.log"], 5) == []


def test_follower_returns_added_lines(files: list[Path]) -> None:
    with Follower(files) as follower:
        with files[1].open("a") as log:
            log.write("new one\nand a par")
        assert follower.wait() == [b"new one"]
        with files[1].open("a") as log:
            log.write("t\n")
        assert follower.wait() == [b"and a part"]


def test_follower_continues_after_a_rotation(files: list[Path]) -> None:
    with Follower(files) as follower:
        with files[0].open("a") as log:
            log.write("last of the old\n")
        files[0].rename(files[0].with_suffix(".log.1"))
        files[0].write_text("first of the new\n")
        assert follower.wait() == [b"last of the old", b"first of the new"]


def test_follower_waits_for_a_missing_file(tmp_path: Path) -> None:
    with Follower([tmp_path / "late.log"]) as follower:
        (tmp_path / "late.log").write_text("here\n")
        assert follower.wait() == [b"here"]


def test_follower_returns_an_endless_line_in_parts(files: list[Path]) -> None:
    with Follower(files) as follower:
        with files[0].open("a") as log:
            log.write("x" * (MAX_LINE_BYTES + 1))
        assert [len(line) for line in follower.wait()] == [MAX_LINE_BYTES + 1]


def test_follower_in_a_missing_folder_is_an_error(tmp_path: Path) -> None:
    before = watches()
    with pytest.raises(OSError, match="No such file"):
        Follower([tmp_path / "none" / "a.log"])
    assert watches() <= before


def watches() -> set[str]:
    """Return this process's descriptors of inotify."""
    found = set()
    for entry in Path("/proc/self/fd").iterdir():
        with suppress(FileNotFoundError):  # the descriptor that lists the folder, or another that was just closed
            if "inotify" in str(entry.readlink()):
                found.add(entry.name)
    return found


@pytest.fixture
def instance_logs(
    tmp_path: Path, instance: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Path:
    monkeypatch.chdir(tmp_path)
    assert main(["init"]) == 0
    capsys.readouterr()
    config = Path("supervisor.toml")
    config.write_text(config.read_text().replace('name = "a50"', f'name = "{instance}"'))
    logs = tmp_path / "logs"
    logs.mkdir()
    (logs / "supervisor.log").write_text(stamped(1, "cell running"))
    (logs / "cell.log").write_text(stamped(2, "connected \x1b[31mred"))
    return logs


def test_logs_of_all_processes_and_of_one(instance_logs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["logs"]) == 0
    output = capsys.readouterr().out
    assert output == stamped(1, "cell running") + stamped(2, "connected \\x1b[31mred"), "control characters are escaped"
    assert main(["logs", "supervisor", "-n", "1"]) == 0
    assert capsys.readouterr().out == stamped(1, "cell running")


def test_logs_as_json(instance_logs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stamp = "2026-11-21T05:20:03.000000Z"
    (instance_logs / "cell.log").write_text(f"{stamp} WARNING cell[12] lost [a] source=cell\n    Traceback\n")
    assert main(["logs", "cell", "--json"]) == 0
    assert [json.loads(line) for line in capsys.readouterr().out.splitlines()] == [
        {"time": stamp, "level": "WARNING", "process": "cell", "pid": 12, "text": "lost [a] source=cell"},
        {"time": None, "level": None, "process": None, "pid": None, "text": "    Traceback"},
    ]
    assert main(["logs", "cel", "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["error"].startswith("unknown process 'cel'; did you mean 'cell'?")


def test_logs_of_both_formats_are_merged_and_printed_as_text(
    instance_logs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = {
        "time": "2026-11-21T05:20:01.500000Z",
        "level": "ERROR",
        "process": "grpc",
        "pid": 7,
        "message": "no\x1b",
        "fields": {"a": 1},
    }
    (instance_logs / "grpc.log").write_text(json.dumps(line | {"traceback": "Traceback\nodd"}) + "\n")
    assert main(["logs"]) == 0
    grpc = f"{line['time']} ERROR   grpc[7] no\\x1b a=1\n    Traceback\n    odd\n"
    assert capsys.readouterr().out == stamped(1, "cell running") + grpc + stamped(2, "connected \\x1b[31mred")
    assert main(["logs", "grpc", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["text"] == "no\x1b a=1\n    Traceback\n    odd"


def test_unknown_process_is_refused_with_the_valid_names(
    instance_logs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["logs", "cel"]) == 1
    assert capsys.readouterr().err == "unknown process 'cel'; did you mean 'cell'?\n"


def test_bridge_and_broker_have_logs(instance_logs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (instance_logs / "broker.log").write_text(stamped(3, "broker ready"))
    (instance_logs / "mqtt.log").write_text(stamped(4, "bridge connected"))
    for name, word in (("broker", "ready\n"), ("mqtt", "connected\n")):
        assert main(["logs", name]) == 0
        assert capsys.readouterr().out.endswith(word)
    config = Path("supervisor.toml")
    config.write_text(config.read_text().replace('broker = "embedded"', 'broker = "external"\nhost = "broker.example"'))
    assert main(["logs", "broker"]) == 1, "an external broker has no log here"


def test_running_process_that_is_not_configured_has_logs(
    instance_logs: Path, instance: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """``--mode replay`` adds a source that the configuration does not have."""
    (instance_logs / "arm.log").write_text(stamped(3, "arm plays"))
    assert main(["logs", "arm"]) == 1
    assert capsys.readouterr().err.startswith("unknown process 'arm'; ")
    processes, file = [ProcessSpec("cell", "source"), ProcessSpec("arm", "source")], Path("supervisor.toml").resolve()
    with Segment.create(instance, [], processes, config=file) as segment:
        try:
            assert main(["logs", "arm"]) == 0
            assert capsys.readouterr().out == stamped(3, "arm plays")
            assert main(["logs", "-n", "1"]) == 0
            assert capsys.readouterr().out == stamped(3, "arm plays")
            assert main(["logs", "plc"]) == 1, "plc is configured, but has no log"
        finally:
            segment.unlink()


def test_logs_before_the_first_start(instance_logs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["logs", "plc"]) == 1
    assert "has no log files yet" in capsys.readouterr().err


def test_following_ends_with_ctrl_c(
    instance_logs: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rounds = iter([[b"more"]])

    def wait(_: Follower) -> list[bytes]:
        for lines in rounds:
            return lines
        raise KeyboardInterrupt

    monkeypatch.setattr(Follower, "wait", wait)
    assert main(["logs", "-f", "-n", "0"]) == 130
    assert capsys.readouterr().out == "more\n"
