"""What tells hosts of the same name apart."""

from __future__ import annotations

from pathlib import Path

import pytest

from shmio.fabric import machine as module


def test_it_is_made_of_the_machine_id_and_does_not_give_it_away(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "FILE", tmp_path / "machine-id")
    found = []
    try:
        for text in ("", "b" * 32, "c" * 32):
            module.FILE.write_text(f"{text}\n")
            module.machine.cache_clear()
            found.append(module.machine())
    finally:
        module.machine.cache_clear()
    assert found[0] == ""
    assert len({*found}) == 3
    assert "b" * 8 not in found[1]
