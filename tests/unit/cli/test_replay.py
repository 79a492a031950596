"""``shmio replay``: its output and its arguments."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from shmio.cli.user import main
from tests.unit.connectors.replay.harness import Playing, built, record


@pytest.fixture
def playing(tmp_path: Path, instance: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[Playing]:
    monkeypatch.chdir(tmp_path)
    file = record(tmp_path / "dumps", instance)
    with built(instance) as segment, Playing(segment, file) as playing:
        playing.next()
        yield playing


def replay(instance: str, *words: str) -> int:
    return main(["replay", "--instance", instance, *words])


def test_status_is_printed_after_each_command(
    playing: Playing, instance: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert replay(instance) == 0
    line = capsys.readouterr().out
    assert line.startswith("cell: playing at 0.000 s of 0.400 s (1970-01-01 ")
    assert line.endswith("), speed 1\n")
    assert replay(instance, "seek", "0.1") == 0
    assert replay(instance, "pause") == 0
    assert replay(instance, "loop", "on") == 0
    capsys.readouterr()
    assert replay(instance, "speed", "0.5", "--json") == 0
    [told] = json.loads(capsys.readouterr().out)
    assert (told["position_s"], told["paused"], told["loop"], told["speed"]) == (0.1, True, True, 0.5)
    assert replay(instance, "to-change", "cell/other", "--jump") == 0
    assert capsys.readouterr().out.startswith("cell: paused at 0.200 s")
    assert replay(instance, "play", "--speed", "1", "--source", "cell") == 0
    assert replay(instance, "until", "0.3") == 0
    assert capsys.readouterr().out.endswith(", speed 1, until 0.300 s, in a loop\n")


@pytest.mark.parametrize(
    ("words", "error"),
    [
        (["seek"], "seek needs a VALUE"),
        (["pause", "1"], "pause takes no VALUE"),
        (["loop", "maybe"], "loop is on or off"),
        (["speed", "fast"], "'fast' is not a number"),
        (["seek", "1", "--jump"], "--jump is only for"),
        (["pause", "--speed", "1"], "--speed is only for the action play"),
        (["rewind"], "invalid choice"),
    ],
)
def test_wrong_usage(
    playing: Playing, instance: str, words: list[str], error: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        replay(instance, *words)
    assert ended.value.code == 2
    assert error in capsys.readouterr().err


def test_impossible_requests_are_refused_in_one_line(
    playing: Playing, instance: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert replay(instance, "seek", "900") == 1
    assert capsys.readouterr().err == "900 is outside the played range, which is 0.400 s long\n"
    assert replay(instance, "status", "--source", "none") == 1
    assert capsys.readouterr().err == "source 'none' plays no recording; these do: cell\n"
    assert replay(instance, "seek", "0.2") == 0
    assert replay(instance, "until", "0.1") == 1
    assert (
        capsys.readouterr().err
        == "cell: the requested time has passed: the replay is at 0.200 s; seek to an earlier time\n"
    )
    assert replay(instance, "to-event", "accepted") == 1
    assert capsys.readouterr().err == "there is no event accepted between here and the end of the played part\n"


def test_step_notes_a_replay_that_is_paused_or_over(
    playing: Playing, instance: str, capsys: pytest.CaptureFixture[str]
) -> None:
    def step(*words: str) -> str:
        capsys.readouterr()
        assert main(["step", "--instance", instance, *words]) == 0
        return capsys.readouterr().out

    stands = "; the replay of cell was {} and did not move; start it with shmio replay play\n"
    assert step().endswith(", steps of 50 ms\n")
    assert replay(instance, "pause") == 0
    assert step("--count", "2", "--dt-ms", "20").endswith("of 20 ms, step size 50 ms" + stands.format("paused"))
    assert replay(instance, "play") == 0
    assert step("--dt-ms", "1000").endswith(" of 1000 ms, step size 50 ms\n"), "this step moved the replay to its end"
    assert json.loads(step("--json"))["note"] == stands.format("over")[2:-1]


def test_until_survives_pause_and_play(playing: Playing, instance: str, capsys: pytest.CaptureFixture[str]) -> None:
    def told(*words: str) -> str:
        capsys.readouterr()
        assert replay(instance, *words) == 0
        return capsys.readouterr().out.partition("), ")[2]

    assert told("until", "0.3") == "speed 1, until 0.300 s\n"
    assert told("pause") == told("play") == "speed 1, until 0.300 s\n"
    assert told("play", "--speed", "2") == "speed 2, until 0.300 s\n"
    assert main(["step", "--instance", instance, "--dt-ms", "1000"]) == 0
    assert [told(), told("play")] == ["speed 2\n", "speed 2\n"], "the replay has passed that time"
    assert told("until", "0.35") == "speed 2, until 0.350 s\n"
    assert told("until", "0.4") == "speed 2\n"
    assert told("until", "0.35") == "speed 2, until 0.350 s\n"
    assert told("seek", "0.1") == "speed 2\n"
