"""The section ``[opcua]``: what it accepts, and what it refuses."""

from __future__ import annotations

from pathlib import Path

import pytest

from shmio.config import OpcUa, load
from shmio.errors import ConfigError

KEYS = 'certificate = "c.pem"\nkey = "k.pem"\n'
ACCOUNT = '[[opcua.account]]\nname = "panel"\nroles = ["read"]\n'
SECRET = f'sha256 = "{"0" * 64}"\n'
CLIENT = '[[opcua.client]]\nsubject = "*"\nroles = ["read"]\n'


def read(folder: Path, text: str) -> OpcUa:
    file = folder / "supervisor.toml"
    file.write_text(f'[instance]\nname = "a"\n[opcua]\n{text}')
    opcua = load(file).opcua
    assert opcua is not None
    return opcua


@pytest.mark.parametrize(
    "text",
    [
        'listen = "127.0.0.1:4840"\n',
        'listen = "0.0.0.0:4840"\ninsecure = true\n',
        f'listen = "0.0.0.0:4840"\n{KEYS}',
        f'listen = "0.0.0.0:4840"\n{KEYS}{ACCOUNT}{SECRET}',
        f'listen = "0.0.0.0:4840"\n{KEYS}trusted = ["ca.pem"]\n{CLIENT}',
        f'listen = "127.0.0.1:4840"\nanonymous = []\n{ACCOUNT}token_file = "t"\n',
    ],
)
def test_sound_sections(tmp_path: Path, text: str) -> None:
    opcua = read(tmp_path, text)
    for name in (opcua.certificate, *opcua.trusted, *(account.token_file for account in opcua.account)):
        assert name is None or Path(name).parent == tmp_path


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ('listen = "0.0.0.0:4840"\n', "opcua.listen: other hosts can reach 0.0.0.0:4840 in plain text"),
        ('listen = "4840"\n', "opcua.listen: "),
        ('listen = "127.0.0.1:4840"\nkey = "k.pem"\n', "opcua.certificate: give both certificate and key"),
        ('listen = "127.0.0.1:4840"\ntrusted = ["ca.pem"]\n', "opcua.trusted: clients show certificates only"),
        (
            f'listen = "127.0.0.1:4840"\ninsecure = true\n{KEYS}trusted = ["ca.pem"]\n',
            "opcua.trusted: this key has no effect",
        ),
        (
            f'listen = "127.0.0.1:4840"\n{KEYS}{CLIENT}',
            "opcua.client: this section identifies clients by their certificates",
        ),
        (
            f'listen = "0.0.0.0:1"\ninsecure = true\n{ACCOUNT}{SECRET}',
            "opcua.account: other hosts would send passwords",
        ),
        (f'listen = "127.0.0.1:1"\n{ACCOUNT}', "opcua.account[0]: give either token_file"),
        (
            f'listen = "127.0.0.1:1"\n{ACCOUNT}sha256 = "12"\n',
            "opcua.account[0].sha256: expected 64 hexadecimal digits",
        ),
        (f'listen = "127.0.0.1:1"\n{ACCOUNT}{SECRET}{ACCOUNT}{SECRET}', "opcua.account[1].name: 'panel' is already"),
        ('listen = "127.0.0.1:1"\nanonymous = ["raed"]\n', "opcua.anonymous[0]: unknown role 'raed'"),
        ('listen = "127.0.0.1:1"\nurl = "x"\n', "opcua.url: "),
    ],
)
def test_faulty_sections_are_refused_by_key(tmp_path: Path, text: str, fault: str) -> None:
    with pytest.raises(ConfigError) as refused:
        read(tmp_path, text)
    assert fault in str(refused.value)
