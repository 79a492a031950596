"""``shmio``: how it chooses the instance, and how it ends. Tests of its output are in tests/system."""

from __future__ import annotations

import io
import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from shmio.cli import target
from shmio.cli.user import main
from shmio.layout.model import Layout, Register
from shmio.local.attach import Attachment
from shmio.local.status import read_status
from shmio.segment import BlockSpec, Segment
from tests.unit.cli.terminal import Terminal

LAYOUT = Layout("DB1", 1, 2, False, (Register("a", "INT", (), 0, None, 2, 1),))


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def running(instance: str) -> Iterator[str]:
    blocks = [BlockSpec("cell", LAYOUT, 20_000_000, 3600 * 10**9, 1 << 16)]
    with Segment.create(instance, blocks, [], config=Path("supervisor.toml").resolve()) as segment:
        segment.writer("cell").publish(b"\0\7", cycle=1, source_ns=1)
        yield instance
        segment.unlink()


def test_faulty_file_in_the_current_folder_names_the_instance(running: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path("supervisor.toml").write_text(f'wings = 2\n[instance]\nname = "{running}"\n')
    assert main(["get", "cell/a"]) == 0
    assert capsys.readouterr().out == "cell/a  7\n"


def test_instance_of_an_unknown_file_is_reached_only_by_name(instance: str, capsys: pytest.CaptureFixture[str]) -> None:
    """The segment of such an instance does not name its configuration file."""
    Path("supervisor.toml").write_text(f'[instance]\nname = "{instance}"\n')
    with Segment.create(instance, [], []) as segment:
        assert main(["list"]) == 1
        assert "was started from an unknown file" in capsys.readouterr().err
        assert main(["list", "--instance", instance]) == 0
        segment.unlink()


def test_empty_text_is_printed_as_quotes(instance: str, capsys: pytest.CaptureFixture[str]) -> None:
    layout = Layout("DB1", 1, 8, False, (Register("name", "STRING[6]", (), 0, None, 8, 1),))
    with Segment.create(instance, [BlockSpec("cell", layout, 20_000_000, 3600 * 10**9, 1 << 16)], []) as segment:
        for image, line in ((b"\6\0", 'cell/name  ""\n'), (b"\6\1a", "cell/name  a\n")):
            segment.writer("cell").publish(image.ljust(8, b"\0"), cycle=1, source_ns=1)
            assert main(["get", "--instance", instance, "cell/name"]) == 0
            assert capsys.readouterr().out == line
        segment.unlink()


@pytest.mark.parametrize("name", ["../../etc", "", "a b"])
def test_invalid_name_is_refused(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list", "--instance", name]) == 1
    assert capsys.readouterr().err.startswith(f"--instance: {name!r} is not a name: at most 40 letters")


def test_several_instances_need_a_choice(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(target, "running_instances", lambda: ["one", "two"])
    assert main(["list"]) == 1
    assert "choose one by --instance (one, two)" in capsys.readouterr().err


@pytest.mark.parametrize("count", ["0", "-1", "x", "1.5", "٣"])
def test_a_number_of_lines_is_one_or_more(count: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["watch", "-n", count, "cell/a"])
    assert stop.value.code == 2
    assert "is not a whole number from 1 to " in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        *(
            (("--dt-ms", text), f"'{text}' is not a number of ms from 0.001 to 3600000")
            for text in ("0", "-5", "4e6", "x")
        ),
        *((("--play", text), f"'{text}' is not a number above 0 and up to 1000") for text in ("0", "1001", "nan")),
    ],
)
def test_step_size_and_rate_have_limits(
    words: tuple[str, str], problem: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["step", *words])
    assert stop.value.code == 2
    assert problem in capsys.readouterr().err


def test_an_unknown_word_shows_the_usage_of_the_verb(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["step", "200"])
    assert stop.value.code == 2
    said = capsys.readouterr().err
    assert "usage: shmio step " in said
    assert "--count N" in said
    assert "unrecognized arguments: 200" in said


class Keyboard(io.StringIO):
    """A stand-in for standard input from a terminal."""

    def isatty(self) -> bool:
        return True


REAL = (
    "the instance follows real time; a step pauses its time until shmio step --release, while source cell "
    "continues in real time"
)


def mode(instance: str) -> str:
    clock = read_status(instance).clock
    return clock.mode if clock else ""


@pytest.mark.parametrize("words", [(), ("--play",), ("--pause",)])
def test_script_needs_yes_to_pause_real_time_over_a_device(
    running: str, capsys: pytest.CaptureFixture[str], words: tuple[str, ...]
) -> None:
    assert main(["step", "--instance", running, *words]) == 1
    assert capsys.readouterr().err == f"{REAL}; to step anyway, add --yes\n"
    assert mode(running) == "wall"


def test_real_time_over_a_device_is_paused_after_consent(
    running: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["step", "--instance", running, "--pause", "--json"]
    for answer in ("\n", "n\n", ""):
        monkeypatch.setattr("sys.stdin", Keyboard(answer))
        assert main(command) == 1
        told = capsys.readouterr()
        assert json.loads(told.out) == {"error": "the clock was not changed"}
        assert told.err == f"{REAL}. Continue? [y/N] the clock was not changed\n"
    assert mode(running) == "wall"
    monkeypatch.setattr("sys.stdin", Keyboard("y\n"))
    assert main(command) == 0
    assert json.loads(capsys.readouterr().out)["mode"] == "virtual"
    monkeypatch.setattr("sys.stdin", None)
    assert main(command) == 0, "consent is needed only once"


def test_option_yes_skips_the_question(running: str) -> None:
    assert main(["step", "--instance", running, "--pause", "--yes"]) == 0
    assert mode(running) == "virtual"


def test_watch_ends_with_ctrl_c(running: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Attachment, "subscribe", interrupt)
    assert main(["watch", "--instance", running, "cell/a"]) == 130


def test_the_command_starts_without_heavy_imports() -> None:
    heavy = {"numpy", "grpc", "snap7", "asyncio", "mcap"}
    code = f"import sys, shmio.cli.user; sys.exit(','.join({heavy!r} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=False)
    assert done.stderr.strip() == ""


def watching(*arguments: str) -> subprocess.Popen[str]:
    program = "import sys; from shmio.cli.user import main; sys.exit(main())"
    command = [sys.executable, "-P", "-c", program, "watch", *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def test_watch_prints_each_change_of_a_local_source(instance: str) -> None:
    spec = BlockSpec("cell", LAYOUT, 20_000_000, 3600 * 10**9, 1 << 16)
    with Segment.create(instance, [spec], []) as segment:
        writer = segment.writer("cell")
        writer.publish(b"\0\7", cycle=1, source_ns=1)
        with watching("--instance", instance, "-n", "3", "cell/a") as watch:
            try:
                assert watch.stdout is not None
                assert "cell/a  7" in watch.stdout.readline()
                for cycle, value in enumerate((8, 7), 2):  # watch may read only after the second
                    writer.publish(bytes((0, value)), cycle=cycle, source_ns=1)
                out, _ = watch.communicate(timeout=60)
            finally:
                watch.kill()
        segment.unlink()
    assert [line[-1] for line in out.splitlines()] == ["8", "7"]


def test_watch_continues_with_the_block_of_a_reload(instance: str) -> None:
    wide = Layout(
        "DB1", 1, 4, False, (Register("b", "INT", (), 0, None, 2, 1), Register("a", "INT", (), 2, None, 2, 1))
    )
    spec = BlockSpec("cell", LAYOUT, 20_000_000, 3600 * 10**9, 1 << 16)
    with Segment.create(instance, [spec], []) as segment:
        segment.writer("cell").publish(b"\0\7", cycle=1, source_ns=1)
        with watching("--instance", instance, "cell/a") as watch:
            assert watch.stdout is not None
            assert "cell/a  7" in watch.stdout.readline()
            segment.change(add=[BlockSpec("cell", wide, 20_000_000, 3600 * 10**9, 1 << 16)], retire=["cell"])
            segment.writer("cell").publish(b"\0\0\0\x08", cycle=2, source_ns=1)
            try:
                while "cell/a  8" not in (line := watch.stdout.readline()):
                    assert "no data yet" in line, "watch may read before the first frame"
                watch.send_signal(signal.SIGINT)
                _, err = watch.communicate(timeout=60)
            finally:
                watch.kill()
        segment.unlink()
    assert (watch.returncode, err) == (130, "")


def test_watch_ends_when_a_reload_removes_its_register(instance: str) -> None:
    other = Layout("DB1", 1, 2, False, (Register("other", "INT", (), 0, None, 2, 1),))
    spec = BlockSpec("cell", LAYOUT, 20_000_000, 3600 * 10**9, 1 << 16)
    with Segment.create(instance, [spec], []) as segment:
        segment.writer("cell").publish(b"\0\7", cycle=1, source_ns=1)
        with watching("--instance", instance, "cell/a") as watch:
            assert watch.stdout is not None
            assert "cell/a  7" in watch.stdout.readline()
            segment.change(add=[BlockSpec("cell", other, 20_000_000, 3600 * 10**9, 1 << 16)], retire=["cell"])
            _, err = watch.communicate(timeout=60)
        segment.unlink()
    assert watch.returncode == 1
    assert "no such register" in err


@pytest.mark.parametrize(
    ("patterns", "gone"),
    [
        (("press/a",), "source 'press' was"),
        (("cell/a", "press/a"), "source 'press' was"),
        (("press/a", "robot/a"), "sources press, robot were"),
    ],
)
def test_watch_ends_when_a_reload_removes_its_source(instance: str, patterns: tuple[str, ...], gone: str) -> None:
    names = ("cell", "press", "robot")
    specs = [BlockSpec(name, LAYOUT, 20_000_000, 3600 * 10**9, 1 << 16) for name in names]
    with Segment.create(instance, specs, []) as segment:
        for name in names:
            segment.writer(name).publish(b"\0\7", cycle=1, source_ns=1)
        with watching("--instance", instance, *patterns) as watch:
            assert watch.stdout is not None
            seen = {watch.stdout.readline().split()[1] for _ in patterns}
            segment.change(retire=["press", "robot"])
            out, err = watch.communicate(timeout=60)
        segment.unlink()
    assert seen == set(patterns)
    assert (watch.returncode, out) == (1, "")
    assert err == f"{gone} removed from instance {instance!r} by a reload\n"


TIMES = Layout(
    "DB1",
    1,
    216,
    False,
    (
        Register("wait", "TIME", (), 0, None, 4, 1),
        Register("day", "DATE", (), 4, None, 2, 1),
        Register("noon", "TIME_OF_DAY", (), 6, None, 4, 1),
        Register("many", "BYTE", ((0, 199),), 16, None, 200, 200),
    ),
)


@pytest.fixture
def times(instance: str) -> Iterator[Segment]:
    with Segment.create(instance, [BlockSpec("cell", TIMES, 20_000_000, 3600 * 10**9, 1 << 16)], []) as segment:
        publish_times(segment, 1500)
        yield segment
        segment.unlink()


def publish_times(segment: Segment, wait_ms: int) -> None:
    image = wait_ms.to_bytes(4) + (10 * 365).to_bytes(2) + (43_200_000).to_bytes(4)
    segment.writer("cell").publish(image.ljust(216, b"\0"), cycle=1, source_ns=1)


def test_get_prints_times_as_s7_literals_and_whole_arrays_into_a_pipe(
    times: Segment, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["get", "--instance", times.instance, "cell"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "cell/wait  T#1s500ms",
        "cell/day   D#1999-12-30",
        "cell/noon  TOD#12:00:00",
        f"cell/many  [{','.join(['0'] * 200)}]",
    ]


def test_watch_every_prints_all_registers_each_time(times: Segment, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--instance", times.instance, "--every", "0.01", "-n", "5", "cell/wait", "cell/day"]
    assert main(["watch", "--json", *words]) == 0
    told = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [(one["path"], one["value"]) for one in told] == [
        ("cell/wait", 1500), ("cell/day", "1999-12-30"), ("cell/wait", 1500), ("cell/day", "1999-12-30"),
        ("cell/wait", 1500),
    ]  # fmt: skip
    assert main(["watch", *words]) == 0
    assert [line.split()[1:] for line in capsys.readouterr().out.splitlines()[:3]] == [
        ["cell/wait", "T#1s500ms"],
        ["cell/day", "D#1999-12-30"],
        ["cell/wait", "T#1s500ms"],
    ]


def test_watch_every_ends_with_the_instance(times: Segment) -> None:
    with watching("--instance", times.instance, "--every", "0.01", "cell/wait") as watch:
        assert watch.stdout is not None
        assert "T#1s500ms" in watch.stdout.readline()
        times.unlink()
        _, err = watch.communicate(timeout=60)
    assert (watch.returncode, err) == (1, f"instance {times.instance!r} has stopped\n")


def terminal_of(*words: str) -> Terminal:
    return Terminal(sys.executable, "-P", "-c", "import sys; from shmio.cli.user import main; sys.exit(main())", *words)


def test_watch_on_a_terminal_updates_a_table_in_place(times: Segment) -> None:
    with terminal_of("watch", "--instance", times.instance, "--every", "0.02", "cell/wait", "cell/many") as terminal:
        first = terminal.until(r"\(all: --full\)")
        assert "cell/wait  T#1s500ms" in first
        assert first.splitlines()[-1].count("0,") == 19, "the array is cut so that the mark fits"
        assert "\x1b[2F" in terminal.until("cell/wait"), "the cursor goes up over both lines"
        publish_times(times, 7)
        terminal.until("cell/wait  T#7ms")
        terminal.process.send_signal(signal.SIGINT)
        assert terminal.process.wait(60) == 130
    with terminal_of("watch", "--instance", times.instance, "cell/many/0..8") as terminal:
        terminal.until(r"cell/many/3.*… and 5 more lines; enlarge the window, or use --lines")
    with terminal_of("watch", "--lines", "--full", "--instance", times.instance, "cell/many") as terminal:
        assert "\x1b" not in terminal.until(r"(0,){199}0\]\s")
