"""The section ``[fabric]``: what it accepts, and what it refuses."""

from __future__ import annotations

from pathlib import Path

import pytest

from shmio.config import load
from shmio.config.fabric import matches_cell
from shmio.config.model import Fabric
from shmio.errors import ConfigError, RecordingError
from shmio.fabric.place import parse_place

EMBEDDED = 'server = "embedded"\n'
CELL = 'cell = "plant1.line3.a50"\n'
TLS = '[fabric.tls]\ncertificate = "c.pem"\nkey = "k.pem"\n'


def read(folder: Path, text: str) -> Fabric:
    file = folder / "supervisor.toml"
    file.write_text(f'[instance]\nname = "a"\n[fabric]\n{text}')
    fabric = load(file).fabric
    assert fabric is not None
    return fabric


@pytest.mark.parametrize(
    "text",
    [
        EMBEDDED,
        EMBEDDED + CELL,
        f'{EMBEDDED}listen = "0.0.0.0:4222"\n{TLS}',
        f'{EMBEDDED}listen = "0.0.0.0:4222"\ninsecure = true\n',
        'server = "nats://127.0.0.1:4222"\ncredentials = "a.creds"\n',
        'server = ["tls://a.example", "tls://b.example:4333"]\n',
        f'server = "nats://a.example"\n{TLS}',
        'server = "nats://a.example"\ninsecure = true\n',
        f'{EMBEDDED}{CELL}[[fabric.rule]]\nmatch = "c*"\nsend = "changes"\nmax_rate_hz = 10\n',
    ],
)
def test_sound_sections(tmp_path: Path, text: str) -> None:
    fabric = read(tmp_path, text)
    assert Path(fabric.directory) == tmp_path / "fabric"
    assert fabric.listen is None or fabric.embedded
    assert fabric.credentials in (None, str(tmp_path / "a.creds"))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (f'{EMBEDDED}listen = "0.0.0.0:4222"\n', r"fabric\.listen: .*plain text; add a \[fabric\.tls\]"),
        (f'{EMBEDDED}listen = "127.0.0.1:0"\n', r"fabric\.listen: .*no port"),
        (f'{EMBEDDED}credentials = "x"\n', r"fabric\.credentials: "),
        (f'{EMBEDDED}[fabric.tls]\nca = "ca.pem"\n', r"fabric\.tls: .*certificate and key"),
        (f'{EMBEDDED}[fabric.tls]\nkey = "k.pem"\n', r"fabric\.tls: .*both"),
        ('server = "nats://a.example"\n', r"fabric\.server: .*plain text .*a\.example:4222"),
        ('server = ["tls://a.example", "nats://b"]\n', r"fabric\.server\[1\]: .*plain text"),
        ('server = "tls://a"\nlisten = "127.0.0.1:4222"\n', r"fabric\.listen: .*embedded"),
        ('server = "http://127.0.0.1"\n', r"fabric\.server: .*not a NATS server"),
        ('server = "embeded"\nlisten = "127.0.0.1:4222"\n', r"fabric\.server: 'embeded' is not a NATS server"),
        ('server = "nats://127.0.0.1:99999"\n', r"fabric\.server: .*not a NATS server"),
        ('server = "nats://me:secret@127.0.0.1"\n', r"fabric\.server: .*password"),
        (f'{EMBEDDED}[[fabric.rule]]\nmatch = "*"\n', r"fabric\.rule: .*fabric\.cell"),
        (f'{EMBEDDED}{CELL}[[fabric.rule]]\nmatch = "*"\nsend = "nothing"\nmax_rate_hz = 1\n', r"rule\[0\]: .*nothing"),
        (f'{EMBEDDED}{CELL}[[fabric.rule]]\nmatch = "*"\nsend = "some"\n', r"fabric\.rule\[0\]\.send"),
    ],
)
def test_refused_sections(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        read(tmp_path, text)


@pytest.mark.parametrize("port", ["4222", "99999"])
def test_no_message_has_the_password_of_a_url(tmp_path: Path, port: str) -> None:
    url = f"nats://me:hunter2@127.0.0.1:{port}"
    with pytest.raises(ConfigError) as refused:
        read(tmp_path, f'server = "{url}"\n')
    with pytest.raises(RecordingError) as place:
        parse_place(f"{url}/plant1.line3.a50")
    with pytest.raises(RecordingError) as name:
        parse_place(f"{url}/plant1")
    for error in (refused, place, name):
        assert "hunter2" not in str(error.value)


def test_patterns_match_part_by_part() -> None:
    assert matches_cell("plant1.*.*", "plant1.line3.a50")
    assert matches_cell("plant?.line3.a*", "plant1.line3.a50")
    assert not matches_cell("plant1.*.*", "plant2.line3.a50")
    assert not matches_cell("*.a50", "plant1.line3.a50")
