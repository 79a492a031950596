"""``shmio-supervisor check``: usual slips get their remedy, all faults are shown at once, open doors are named."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

from shmio.cli.supervisor import main
from tests.unit.cli.test_exposure import TOKEN

TABLE = """
[registers]
"Rob/Axis/1/SetPos" = "REAL"
"Rob/Axis/2/SetPos" = "REAL"
"Rob/Axis/2/Name" = "STRING[8]"
Mode = "INT"
"""
SOURCE = """[instance]
name = "x"
[[source]]
name = "cell"
connector = "{connector}"
layout = "rob.toml"
period_ms = 20
{more}
"""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SHMIO_MOSQUITTO", sys.executable)  # any program will do
    (tmp_path / "rob.toml").write_text(TABLE)
    return tmp_path


def check(capsys: pytest.CaptureFixture[str], text: str) -> tuple[int, str]:
    Path("supervisor.toml").write_text(text)
    status = main(["check"])
    told = capsys.readouterr()
    return status, told.out + told.err


def test_connectors_are_suggested_by_what_people_write(capsys: pytest.CaptureFixture[str]) -> None:
    for word, meant in {
        "S7-1500": "s7", "s7_300": "s7", "Siemens": "s7", "Modbus-TCP": "modbus", "OPC-UA": "opcua", "ROS": "ros2",
        "fmu": "simulation", "MQTTv5": "mqtt",
    }.items():  # fmt: skip
        status, told = check(capsys, SOURCE.format(connector=word, more=""))
        assert status == 1
        assert f"supervisor.toml:5: source[0].connector: unknown connector '{word}'; did you mean '{meant}'?" in told


def test_wrong_addresses_are_faults(capsys: pytest.CaptureFixture[str]) -> None:
    for connector, line, key in (
        ("s7", 'host = "{}"', "source[0].host"),
        ("modbus", 'host = "{}"', "source[0].host"),
        ("opcua", 'url = "opc.tcp://{}:4840"', "source[0].url"),
    ):
        for host in ("192.168.0.300", "10.0.0.1.2", "192.168.1"):
            _, told = check(capsys, SOURCE.format(connector=connector, more=line.format(host)))
            assert f"{key}: '{host}' is not an IP address; write four numbers from 0 to 255" in told
        _, told = check(capsys, SOURCE.format(connector=connector, more=line.format("192.168.0.010")))
        assert f"{key}: '192.168.0.010' is not clear" in told
        assert "as octal; write 192.168.0.10 " in told
        _, told = check(capsys, SOURCE.format(connector=connector, more=line.format("192.168.0.30")))
        assert "is not an IP address" not in told
    _, told = check(capsys, SOURCE.format(connector="memory", more='[grpc]\nlisten = ["127.0.0.256:8089"]'))
    assert "'127.0.0.256' is not an IP address" in told
    for more, key in (
        ('[grpc]\nlisten = ["127.0.00.1:8089"]', "grpc.listen"),
        ('[mqtt]\nbroker = "external"\nhost = "127.0.00.1"', "mqtt.host"),
        ('[fabric]\nserver = "nats://127.0.00.1"\ncell = "a.b.c"', "fabric.server"),
        ('[[alert]]\nname = "x"\nwhen = "cell/x > 5"\nwebhook = "http://127.0.00.1/"', "alert[0].webhook"),
    ):
        _, told = check(capsys, SOURCE.format(connector="memory", more=more))
        assert re.search(rf"{re.escape(key)}\S*: '127\.0\.00\.1' is not clear.*write 127\.0\.0\.1\b", told), told
    assert main(["browse", "opc.tcp://127.0.00.1:4840"]) == 1
    assert "'127.0.00.1' is not clear" in capsys.readouterr().err


def test_patterns_that_match_nothing_suggest_one_that_matches(capsys: pytest.CaptureFixture[str]) -> None:
    for pattern, meant in {
        "Rob/*/SetPos": "Rob/**/SetPos", "*/SetPos": "**/SetPos", "Axis/*/SetPos": "**/Axis/*/SetPos",
        "cell/Rob/*": "Rob/*", "Nix/*": None,
        "*/*/*/*/*": "*/*/*/*", "Rbo/**": "Rob/**", "Robt/Axis/*/*": "Rob/Axis/*/*",
        "Mdoe*": "Mode*", "Rob/Axs*": "Rob/Axis*",
    }.items():  # fmt: skip
        status, told = check(capsys, SOURCE.format(connector="memory", more=f'writable = ["{pattern}"]'))
        assert status == 0
        remedy = f"; did you mean '{meant}'?" if meant else "\n"
        assert f"writable: '{pattern}' matches no register of rob{remedy}" in told
        assert "  writable: no registers, because the patterns match nothing\n" in told
    topics = '[mqtt]\nbroker = "embedded"\nlisten = "127.0.0.1:1883"\nprefix = "x"\n[[mqtt.topic]]\nmatch = "Rob/**"\n'
    _, told = check(capsys, SOURCE.format(connector="memory", more=topics))
    assert "mqtt.topic[0].match: 'Rob/**' matches no register; did you mean 'cell/Rob/**'?" in told


def test_all_faults_of_all_kinds_are_shown_at_once(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "p.ini").write_text("[S7]\nhostt=3\n")
    (folder / "scene.toml").write_text('[[joint]]\nname = "j"\n')
    text = SOURCE.format(connector="s7", more='host = "192.168.0.300"\nproperties = "p.ini"') + "\n".join([
        '[[injection]]\nname = "a"\ntarget = "cell/None"\noperation = "set"\nvalue = 1',
        '[[alert]]\nname = "b"\nwhen = "cell/Nope > 3"',
        '[web]\nlisten = "127.0.0.1:8080"\nscene = "scene.toml"',
        '[recorder]\ndirectory = "d"\n[recorder.trigger]\nwhen = "cell/Nada"\nbefore_s = 1\nafter_s = 1',
    ])  # fmt: skip
    (folder / "rob.toml").write_text('[registers]\nMode = { type = "INT", address = "DB1.DBW0" }\n')
    status, told = check(capsys, text.replace('name = "x"', 'name = "x"\nfoo = 1', 1))
    assert status == 1
    for fault in (
        "p.ini:2: hostt: unknown key",
        "supervisor.toml:9: source[0].host: '192.168.0.300'",
        "injection[0].target: cell/None: ",
        "alert[0].when: cell/Nope: ",
        "instance.foo: unknown key",
        "recorder.trigger.when: cell/Nada: ",
        "scene.toml:1: joint: unknown key",
    ):
        assert fault in told


def test_a_fault_hides_no_fault_of_another_section_and_causes_none(capsys: pytest.CaptureFixture[str]) -> None:
    layout, scene = "source[0].layout: ", "web.scene: "
    two = '[[source]]\nname = "two"\nconnector = "memory"\nlayout = "rob.toml"\n'
    for old, new, more, faults in (
        (
            'connector = "memory"\n', 'connector = "S7-1500"\nhost = "192.168.0.300"\nperiode_ms = 20\n',
            '[recoder]\ndirectory = "d"\n',
            ("source[0].connector: ", "source[0].host: ", "source[0].periode_ms: unknown key; did you mean 'period_ms'",
             "recoder: ", scene),
        ),
        ("period_ms", 'writable = ["Nix/*"]\nperiod_ms', "", ("warning: source[0].writable: 'Nix/*'", scene)),
        (
            "period_ms = 20", "period_ms = 0.01", '[grpc]\nlisten = ["127.0.0.1:8080"]\ndefault_source = "cell"\n',
            ("source[0].period_ms: ", "web.listen: 127.0.0.1:8080 has the same port as grpc.listen[0]", scene),
        ),
        (
            "rob.toml", "db202.db", '[[emulator]]\nname = "plc"\nkind = "s7"\nlisten = "127.0.0.1:1102"\n',
            (layout, scene),
        ),
        (
            "rob.toml", "db202.db", two + "".join(
                f'[[alert]]\nname = "{source}"\nwhen = "{source}/Nix > 1"\n' for source in ("cell", "two")
            ),
            (layout, "alert[1].when: two/Nix: ", scene),
        ),
        ("rob.toml", "db202.db", two + '[recorder]\nsources = ["cell", "twoo"]\n', (layout, "'twoo'", scene)),
        (
            "period_ms = 20", "period_ms = 0.01",
            '[[injection]]\nname = "i"\ntarget = "cell/Mode"\noperation = "set"\nvalue = 1\n',
            ("source[0].period_ms: ", scene),
        ),
    ):  # fmt: skip
        text = SOURCE.format(connector="memory", more="").replace(old, new, 1)
        _, told = check(capsys, f'{text}{more}[web]\nlisten = "127.0.0.1:8080"\nscene = "none.toml"\n')
        lines = [line for line in told.splitlines() if "supervisor.toml:" in line]
        assert len(lines) == len(faults), told
        assert all(any(fault in line for line in lines) for fault in faults), told


def test_open_doors_are_named_if_others_are_guarded(capsys: pytest.CaptureFixture[str]) -> None:
    doors = {
        "metrics.roles": ('[metrics]\nlisten = "127.0.0.1:9100"\nroles = ["read"]\n', "read at 127.0.0.1:9100"),
        "web.roles": ('[web]\nlisten = "127.0.0.1:8080"\nroles = ["read", "write"]\n', "read and write at"),
        "opcua.anonymous": ('[opcua]\nlisten = "127.0.0.1:4840"\n', "read, write, inject and control at"),
        "mqtt.account": ('[mqtt]\nbroker = "embedded"\nlisten = "127.0.0.1:1883"\nprefix = "x"\n', "read at"),
        "grpc.address[0].listen": ('[[grpc.address]]\nlisten = "127.0.0.1:8089"\nroles = ["read"]\n', "read at"),
    }
    for key, (section, what) in doors.items():
        grpc = "" if "grpc" in key else '[grpc]\nlisten = ["unix:s"]\n'
        _, told = check(capsys, SOURCE.format(connector="memory", more=section + grpc + TOKEN))
        assert f"note: {key}: clients without credentials may {what}" in told
        assert "although there is [[grpc.token]]" in told
        if key != "grpc.address[0].listen":
            _, told = check(capsys, SOURCE.format(connector="memory", more=section))
            assert "without credentials" not in told
    closed = '[metrics]\nlisten = "127.0.0.1:9100"\n[web]\nlisten = "127.0.0.1:8080"\n[grpc]\nlisten = ["unix:s"]\n'
    _, told = check(capsys, SOURCE.format(connector="memory", more=closed + TOKEN))
    assert "without credentials" not in told
