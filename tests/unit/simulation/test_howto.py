"""The model on the page docs/how-to/write-a-model.md runs exactly as shown."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from shmio.layout.values.frame_codec import FrameCodec
from shmio.plan.prepare import prepare

PAGE = (Path(__file__).parents[3] / "docs/how-to/write-a-model.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", PAGE, re.DOTALL | re.MULTILINE)


def test_the_model_does_what_the_page_says() -> None:
    model, *_, test = blocks("python")
    names: dict[str, Any] = {}
    exec(model, names)
    exec(test, names)
    (last,) = FrameCodec(names["runner"].layout).decode(names["image"])
    assert last["lift/height"] == pytest.approx(1.0)  # 2 s at 0.5 m/s
    assert last["lift/gauge"] == pytest.approx(1.0)
    assert last["lift/stops"].tolist() == [False, False]
    for number in range(101, 251):
        image = names["runner"].step(number * 20_000_000, 20_000_000)
    assert FrameCodec(names["runner"].layout).decode(image)["lift/height"] == pytest.approx(2.5)


def test_the_configuration_passes_its_check(tmp_path: Path) -> None:
    (tmp_path / "plant.py").write_text(blocks("python")[0])
    file = tmp_path / "supervisor.toml"
    file.write_text(blocks("toml")[0])
    prepared = prepare(file)
    assert prepared.plan.warnings == ()
    paths = [register.path for register in prepared.layouts["lift"].registers]
    assert paths == ["speed", "lift/height", "lift/gauge", "lift/stops"]
