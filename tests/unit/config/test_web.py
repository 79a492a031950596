"""The section ``[metrics]``: what it accepts, and what it refuses."""

from __future__ import annotations

from pathlib import Path

import pytest

from shmio.config import Metrics, load
from shmio.errors import ConfigError

LOOPBACK = 'listen = "127.0.0.1:9464"\n'


def read(folder: Path, text: str) -> Metrics:
    file = folder / "supervisor.toml"
    file.write_text(f'[instance]\nname = "a"\n[metrics]\n{text}')
    metrics = load(file).metrics
    assert metrics is not None
    return metrics


@pytest.mark.parametrize(
    "text",
    [
        f'{LOOPBACK}registers = ["cell/*"]\nhosts = ["cell.lan"]\n',
        'listen = "0.0.0.0:9464"\ninsecure = true\n',
        'listen = "0.0.0.0:9464"\ncertificate = "c.pem"\nkey = "k.pem"\n',
    ],
)
def test_sound_sections(tmp_path: Path, text: str) -> None:
    metrics = read(tmp_path, text)
    for name in (metrics.certificate, metrics.key):
        assert name is None or Path(name).parent == tmp_path


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ('listen = "0.0.0.0:9464"\n', "metrics.listen: other hosts can reach 0.0.0.0:9464 in plain text"),
        ('listen = "9464"\n', "metrics.listen: "),
        ("", "metrics.listen: this key is needed"),
        (f'{LOOPBACK}key = "k.pem"\n', "metrics.certificate: give both certificate and key"),
        (f'{LOOPBACK}registers = [""]\n', "metrics.registers[0]"),
        (f"{LOOPBACK}register = []\n", "metrics.register: "),
        (f'{LOOPBACK}roles = ["write"]\n', "metrics.roles: unknown role 'write'"),
        (f"{LOOPBACK}roles = []\n", "metrics.roles: nobody could use the figures"),
    ],
)
def test_faulty_sections_are_refused_by_key(tmp_path: Path, text: str, fault: str) -> None:
    with pytest.raises(ConfigError) as raised:
        read(tmp_path, text)
    assert fault in str(raised.value)


def test_figures_need_a_token_if_there_are_tokens(tmp_path: Path) -> None:
    token = (
        '[grpc]\nlisten = ["127.0.0.1:0"]\n[[grpc.token]]\nname = "a"\nroles = ["read"]\nsha256 = "' + "0" * 64 + '"\n'
    )
    for text, roles in (
        ("", ["read"]),
        (token, []),
        ('token_file = "metrics.token"\n', []),
        (f'roles = ["read"]\n{token}', ["read"]),
    ):
        metrics = read(tmp_path, f"{LOOPBACK}{text}")
        assert metrics.roles == roles, text
        assert metrics.token_file in (None, str(tmp_path / "metrics.token"))
