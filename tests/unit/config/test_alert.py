"""The sections ``[[alert]]``: what they accept, and what they refuse."""

from __future__ import annotations

from pathlib import Path

import pytest

from shmio.config import Alert, load
from shmio.errors import ConfigError

MQTT = '[mqtt]\nlisten = "127.0.0.1:1883"\n'
WHEN = 'when = "cell/x > 5"\n'


def read(folder: Path, *alerts: str, more: str = "") -> list[Alert]:
    file = folder / "supervisor.toml"
    sections = "".join(f"[[alert]]\n{text}" for text in alerts)
    file.write_text(f'[instance]\nname = "a"\n[[source]]\nname = "cell"\nconnector = "memory"\n{more}{sections}')
    return load(file).alert


def test_the_shortest_alert(tmp_path: Path) -> None:
    [alert] = read(tmp_path, WHEN)
    assert (alert.title, alert.resolved, alert.command, alert.webhook) == ("cell/x > 5", False, None, None)


def test_paths_are_relative_to_the_file(tmp_path: Path) -> None:
    [alert, other] = read(
        tmp_path,
        f'{WHEN}command = ["./page.sh", "./x"]\nwebhook = "https://h.example/"\nwebhook_header_file = "secret"\n',
        'process = "cell"\nstate = "fatal"\ncommand = ["logger"]\n',
    )
    assert alert.command == [str(tmp_path / "page.sh"), "./x"]
    assert alert.webhook_header_file == str(tmp_path / "secret")
    assert other.command == ["logger"]
    assert other.states == ["fatal"]


@pytest.mark.parametrize(
    "text",
    [
        'source = "*"\nquality = ["bad", "uncertain"]\n',
        f'{WHEN}webhook = "http://127.0.0.1:8000/x?y=1"\n',
        f'{WHEN}webhook = "http://pager.lan/"\ninsecure = true\n',
        f'{WHEN}mqtt_topic = "shmio/a/alerts"\nmqtt_retain = true\n',
    ],
)
def test_sound_sections(tmp_path: Path, text: str) -> None:
    assert len(read(tmp_path, text, more=MQTT)) == 1


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("", "alert[0].when: give exactly one of when, process and source"),
        (f'{WHEN}source = "cell"\n', "alert[0].when: give exactly one of"),
        (f'{WHEN}state = "fatal"\n', "alert[0].state: this key is only for an alert with process"),
        (f'{WHEN}quality = "bad"\n', "alert[0].quality: this key is only for an alert with source"),
        (
            'process = "cell"\nstate = "dead"\n',
            "alert[0].state: unknown state 'dead'; valid: starting, running, backoff",
        ),
        ('process = "cell"\nstate = ["fatl"]\n', "did you mean 'fatal'?"),
        (f'{WHEN}severity = "high"\n', "alert[0].severity: unknown severity 'high'; valid: info, warning, critical"),
        (f"{WHEN}every_s = 0\n", "alert[0].every_s: "),
        (f"{WHEN}command = []\n", "alert[0].command: must not be empty"),
        (f'{WHEN}command = "rm -rf"\n', "alert[0].command: expected"),
        (f'{WHEN}webhok = "http://127.0.0.1/"\n', "alert[0].webhok: unknown key; did you mean 'webhook'?"),
        (f'{WHEN}webhook = "pager.lan/x"\n', "alert[0].webhook: expected a URL"),
        (f'{WHEN}webhook = "http://127.0.0.1:99999/"\n', "alert[0].webhook: this is not a URL"),
        (f'{WHEN}webhook = "https://u:secret@h.example/"\n', "alert[0].webhook: the URL must not contain a password"),
        (
            f'{WHEN}webhook = "http://pager.lan/"\n',
            "alert[0].webhook: shmio would send plain text over the network to pager.lan",
        ),
        (f'{WHEN}webhook = "http://127.0.0.1/"\nwebhook_ca = "ca"\n', "alert[0].webhook_ca: this key is only for"),
        (f'{WHEN}webhook_header_file = "x"\n', "alert[0].webhook_header_file: this key is only for an alert with webh"),
        (f'{WHEN}mqtt_topic = "a/#"\n', "alert[0].mqtt_topic: 'a/#' is not a topic"),
        (f'{WHEN}mqtt_topic = "shmio/a/cell/x/out"\n', "is a topic of the MQTT bridge"),
        (f'{WHEN}mqtt_topic = "shmio/a/status"\n', "is a topic of the MQTT bridge"),
    ],
)
def test_faulty_sections_are_refused_by_key(tmp_path: Path, text: str, fault: str) -> None:
    with pytest.raises(ConfigError) as raised:
        read(tmp_path, text, more=MQTT)
    assert fault in str(raised.value)
    assert "secret" not in str(raised.value)


def test_names_are_unique_and_a_broker_is_needed(tmp_path: Path) -> None:
    with pytest.raises(
        ConfigError, match=r"alert\[1\]\.name: alert\[0\] watches the same thing; give both alerts names"
    ):
        read(tmp_path, WHEN, WHEN)
    with pytest.raises(ConfigError, match=r"alert\[1\]\.name: 'hot' is already the name of alert\[0\]"):
        read(tmp_path, f'{WHEN}name = "hot"\n', 'process = "cell"\nname = "hot"\n')
    with pytest.raises(ConfigError, match=r"mqtt_topic: this key needs the section \[mqtt\]"):
        read(tmp_path, f'{WHEN}mqtt_topic = "x"\n')
