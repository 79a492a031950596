"""Alerts in a configuration: what they watch and use must exist."""

from __future__ import annotations

from pathlib import Path

import pytest

from shmio.errors import ConfigError
from shmio.plan.prepare import prepare

BLOCK = """DATA_BLOCK DB7 { S7_Optimized_Access := 'FALSE' } STRUCT
  Inputs : Array[0..9] of Byte; Level : Real; END_STRUCT; BEGIN END_DATA_BLOCK"""
SOURCE = '[instance]\nname = "alarmed"\n[[source]]\nname = "cell"\nconnector = "memory"\nlayout = "cell.db"\n'
WHEN = 'when = "cell/Level > 5"\n'


def check(folder: Path, alert: str) -> list[str]:
    """Return the names of the processes."""
    (folder / "cell.db").write_text(BLOCK)
    (folder / "supervisor.toml").write_text(f"{SOURCE}[[alert]]\n{alert}")
    return [job.name for job in prepare(folder / "supervisor.toml").plan.jobs]


@pytest.mark.parametrize(
    "alert", [WHEN, 'process = "cell"\n', 'source = "c*"\n', f'{WHEN}command = ["sh", "-c", "exit 1"]\n']
)
def test_sound_alerts(tmp_path: Path, alert: str) -> None:
    assert check(tmp_path, alert) == ["cell", "alerts"]


@pytest.mark.parametrize(
    ("alert", "fault"),
    [
        ('when = "cell/Level >"\n', "toml:8: alert[0].when: at character 13: expected a register or a number"),
        ('when = "cell/Lewel > 5"\n', "alert[0].when: cell/Lewel: DB7 has no such register; did you mean 'cell/Level'"),
        ('when = "cell/Inputs > 5"\n', "alert[0].when: cell/Inputs is an array"),
        ('process = "sell"\n', "alert[0].process: unknown process 'sell'; did you mean 'cell'?"),
        ('name = "x"\nprocess = "alerts"\n', "alert[0].process: unknown process 'alerts'; valid: cell"),
        ('source = ["cell", "other"]\n', "alert[0].source: unknown source 'other'; valid: cell"),
        (f'{WHEN}command = ["no-such-program"]\n', "alert[0].command: no-such-program: there is no such program"),
        (f'{WHEN}command = ["./cell.db"]\n', "not executable; run chmod +x"),
        (f'{WHEN}webhook = "https://h.example"\nwebhook_header_file = "none"\n', "none: No such file"),
        (f'{WHEN}webhook = "https://h.example"\nwebhook_header_file = "cell.db"\n', "chmod 600"),
        (f'{WHEN}webhook = "https://h.example"\nwebhook_ca = "cell.db"\n', "alert[0].webhook_ca: "),
    ],
)
def test_what_does_not_exist_is_named(tmp_path: Path, alert: str, fault: str) -> None:
    with pytest.raises(ConfigError) as raised:
        check(tmp_path, alert)
    assert fault in str(raised.value)
