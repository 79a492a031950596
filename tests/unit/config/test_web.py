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
    ],
)
def test_faulty_sections_are_refused_by_key(tmp_path: Path, text: str, fault: str) -> None:
    with pytest.raises(ConfigError) as raised:
        read(tmp_path, text)
    assert fault in str(raised.value)
