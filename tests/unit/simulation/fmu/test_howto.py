"""The page docs/how-to/use-an-fmu.md works as shown."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from shmio.layout.values.frame_codec import FrameCodec
from shmio.plan.prepare import prepare
from tests.fmus import build

PAGE = (Path(__file__).parents[4] / "docs/how-to/use-an-fmu.md").read_text()


def block(language: str) -> str:
    (found,) = re.findall(rf"^```{language}\n(.*?)^```$", PAGE, re.DOTALL | re.MULTILINE)
    return str(found)


def test_the_page_works_as_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    build("tank2", tmp_path).rename(tmp_path / "tank.fmu")
    (tmp_path / "supervisor.toml").write_text(block("toml"))
    assert prepare(tmp_path / "supervisor.toml").plan.warnings == ()
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(block("python"), names)
    (last,) = FrameCodec(names["runner"].layout).decode(names["image"])
    assert last["level"] == pytest.approx(1 + 2 * 0.8 / 3, abs=0.01)
