"""How ``--mode replay`` changes the configuration."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from shmio.cli.instance.detach import replay_words
from shmio.cli.supervisor import main
from shmio.errors import ConfigError
from shmio.plan.prepare import prepare
from shmio.plan.processes import process_names
from shmio.segment import Origin
from tests.unit.connectors.replay.harness import BEGIN_NS, S, image, recorded

CONFIG = """
[instance]
name = "line"
[[source]]
name = "panel"
connector = "memory"
layout = "panel.toml"
[[source]]
name = "cell"
connector = "memory"
layout = "panel.toml"
writable = ["count"]
[[emulator]]
name = "plc"
kind = "s7"
layout = "db1.db"
listen = "127.0.0.1:1102"
[[injection]]
name = "off"
target = "cell/count"
operation = "set"
value = 3
[grpc]
listen = ["127.0.0.1:8089"]
default_source = "panel"
[recorder]
directory = "dumps"
"""


@pytest.fixture
def file(tmp_path: Path, instance: str) -> Path:
    with recorded(tmp_path, instance, "cell", "arm") as both:
        for one in both:
            one.frame(BEGIN_NS, image(1))
            one.frame(BEGIN_NS + S, image(2))
    [found] = tmp_path.glob("*.mem")
    (tmp_path / "panel.toml").write_text('[registers]\nspeed = { type = "REAL" }\n')
    (tmp_path / "supervisor.toml").write_text(CONFIG)
    return found


def test_recorded_sources_replace_the_configured_ones(file: Path) -> None:
    prepared = prepare(file.with_name("supervisor.toml"), "replay", {"file": [str(file)], "loop": True})
    plan = prepared.plan
    assert [(job.name, job.kind) for job in plan.jobs] == [("cell", "source"), ("arm", "source"), ("grpc", "grpc")]
    assert plan.mode == "replay"
    assert plan.origin == Origin(BEGIN_NS - 2 * S, 7_000 * S)
    assert [block.attributes.replay for block in plan.blocks] == [True, True]
    assert [block.attributes.writable for block in plan.blocks] == [("count",), ()]
    assert all(block.period_ns == 20_000_000 and block.stale_ns == 500_000_000 for block in plan.blocks)
    options = plan.jobs[0].config["options"]
    assert (options["own_clock"], options["loop"], options["file"]) == (True, True, [str(file)])
    notices = "\n".join(plan.warnings)
    assert "source panel is left out: the recording does not contain it; it contains cell, arm" in notices
    assert "emulator plc is left out: a replay reads no device" in notices
    assert "the configuration's injections are left out" in notices
    assert "grpc.default_source is left out" in notices


def test_topics_of_left_out_sources_are_left_out(file: Path) -> None:
    config = file.with_name("supervisor.toml")
    mqtt = '[mqtt]\nlisten = "127.0.0.1:1883"\nprefix = "shmio/test"\n[[mqtt.account]]\nroles = ["read", "write"]\n'
    config.write_text(f"""{CONFIG}{mqtt}
[[mqtt.topic]]
match = ["panel", "cell"]
payload = "frames"
[[mqtt.topic]]
match = "panel"
payload = "frames"
""")
    prepared = prepare(config, "replay", {"file": [str(file)]})
    assert prepared.config.mqtt is not None
    assert [rule.patterns for rule in prepared.config.mqtt.topic] == [["cell"]]
    told = "mqtt.topic[1].match: panel is left out: the recording has no such source"
    assert [told in warning for warning in prepared.plan.warnings].count(True) == 1
    config.write_text(f'{CONFIG}{mqtt}[[mqtt.topic]]\nmatch = "pannel"\npayload = "frames"\n')
    with pytest.raises(ConfigError, match="'pannel' is not the name of a source"):
        prepare(config, "replay", {"file": [str(file)]})


def test_recorder_without_any_replayed_source_is_refused(file: Path) -> None:
    config = file.with_name("supervisor.toml")
    config.write_text(f'{CONFIG}sources = ["panel"]\n')
    with pytest.raises(ConfigError, match=r"replay.record: nothing would be recorded: the recording has cell, arm"):
        prepare(config, "replay", {"file": [str(file)], "record": True})
    assert prepare(config, "replay", {"file": [str(file)]}).plan.jobs


def test_options_add_the_recorder_and_the_configured_injections(file: Path) -> None:
    keys = {"file": [str(file)], "injections": "leave out", "record": True}
    prepared = prepare(file.with_name("supervisor.toml"), "replay", keys)
    plan = prepared.plan
    assert [job.kind for job in plan.jobs] == ["source", "source", "grpc", "recorder"]
    assert [job.name for job in plan.jobs] == process_names(prepared.config)
    assert plan.blocks[0].declared != b"[]"


def test_command_line_overrides_the_replay_section(file: Path) -> None:
    config = file.with_name("supervisor.toml")
    config.write_text(f'{CONFIG}[replay]\nfile = "{file.name}"\nspeed = 2.0\nstart = 0.5\n')
    plan = prepare(config, "replay", {"speed": 3.0}).plan
    found = plan.jobs[0].config["options"]
    assert (found["speed"], found["start"], found["file"]) == (3.0, 0.5, [str(file)])
    assert prepare(config, "replay").plan.jobs[0].config["options"]["speed"] == 2.0


def test_replay_source_has_the_registers_of_the_recording(
    file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(file.parent)
    text = f'[instance]\nname = "line"\n[[source]]\nname = "cell"\nconnector = "replay"\nfile = "{file.name}"\n'
    config = Path("supervisor.toml")
    config.write_text(text)
    assert main(["check"]) == 0
    assert "source cell: DB1, 2 registers, 4 bytes" in capsys.readouterr().out
    for more, error in (
        ('layout = "db1.db"', "source[0].layout: leave out this key in a replay"),
        ("speed = 0", "source[0].speed: "),
        ("start = 99", "source[0].start, end: there is nothing to play"),
        ('source = "none"', "source[0].source: "),
        ('injections = "some"', "source[0].injections: "),
        ("spede = 1.0", "source[0].spede: unknown key; did you mean 'speed'?"),
    ):
        config.write_text(text + more)
        assert main(["check"]) == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert re.match(rf"supervisor\.toml(:[0-9]+)?: {re.escape(error)}", line), line
    for name, error in (("none.mem", ": No such file"), ("panel.toml", " is not a recording")):
        config.write_text(text.replace(file.name, name))
        assert main(["check"]) == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert re.match(r"supervisor\.toml:[0-9]+: source\[0\]\.file: ", line), line
        assert f"{Path(name).absolute()}{error}" in line


def test_check_covers_the_replay_section(
    file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(file.parent)
    text = (
        '[instance]\nname = "line"\n[[source]]\nname = "panel"\nconnector = "memory"\nlayout = "panel.toml"\n[replay]\n'
    )
    config = Path("supervisor.toml")
    config.write_text(f'{text}file = "{file.name}"\n')
    assert main(["check"]) == 0
    out = capsys.readouterr().out
    assert "  with --mode replay: source cell: DB1, 2 registers, 4 bytes" in out
    assert "warning: source panel is left out: the recording does not contain it; it contains cell, arm\n" in out
    assert out.endswith("usable, with 1 warning\n")
    config.write_text(text + "speed = 2.0\n")
    assert main(["check"]) == 0
    assert capsys.readouterr().out.endswith("no faults found\n"), "--from may name the file"
    for keys, error in (
        ('file = "none.mem"', f"replay.file: {Path('none.mem').absolute()}: No such file"),
        ('file = "panel.toml"', "replay.file: "),
        (f'file = "{file.name}"\nstart = 99', "replay.start, end: there is nothing to play"),
        (f'file = "{file.name}"\nrecord = true', "replay.record: this needs a [recorder] section"),
    ):
        config.write_text(f"{text}{keys}\n")
        assert main(["check"]) == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert re.match(rf"supervisor\.toml(:[0-9]+)?: {re.escape(error)}", line), line


@pytest.mark.parametrize(
    ("keys", "error"),
    [
        ({}, "replay.file: name the recording to play"),
        ({"file": ["none.mem"]}, "replay.file: "),
        ({"start": 90.0}, "replay.start, end: there is nothing to play"),
        ({"start": "then"}, "replay.start: 'then' is neither"),
        ({"end": "then"}, "replay.end: 'then' is neither"),
        ({"speed": -1.0}, "replay.speed: "),
    ],
)
def test_invalid_options_are_refused_by_key(file: Path, keys: dict[str, object], error: str) -> None:
    keys = {"file": [str(file)], **keys} if keys else {}
    with pytest.raises(ConfigError, match=rf"supervisor\.toml(:[0-9]+)?: {error}"):
        prepare(file.with_name("supervisor.toml"), "replay", keys)


def test_detached_supervisor_gets_the_same_options() -> None:
    keys = {"file": ["/a.mem", "/b.mem"], "start": 1.5, "injections": "leave out", "loop": True}
    assert replay_words(keys) == ["--from", "/a.mem", "/b.mem", "--start=1.5", "--injections=leave out", "--loop"]


def test_recorded_source_with_a_reserved_name_is_refused(tmp_path: Path, instance: str) -> None:
    with recorded(tmp_path, instance, "grpc") as [one]:
        one.frame(BEGIN_NS, image(1))
    [found] = tmp_path.glob("*.mem")
    (tmp_path / "supervisor.toml").write_text('[instance]\nname = "line"\n')
    with pytest.raises(ConfigError, match="has a source 'grpc', and that name is reserved"):
        prepare(tmp_path / "supervisor.toml", "replay", {"file": [str(found)]})
