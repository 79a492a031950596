from __future__ import annotations

import pytest

from shmio.layout.topic import find
from shmio.layout.values.codec import codec
from shmio.layout.values.write import encode
from shmio.simulation import ModelRunner, layout_of
from shmio.simulation.loopback import Loopback

JOINTS = ["joints/R3200/Link1/R/position", "joints/Kuka.j1/R", "joints/Kuka.j2/R", "joints/R3.L2/R"]


def test_has_the_registers_that_existing_clients_know() -> None:
    layout = layout_of(Loopback)
    assert [r.path for r in layout.registers if r.type == "LREAL"] == JOINTS
    assert {path.partition("/Z1")[0] for path in layout.by_path if path not in JOINTS} == {"safetyzones"}


@pytest.mark.parametrize(("path", "new"), [*((path, -0.125) for path in JOINTS), ("safetyzones/Z1/level", 2.5)])
def test_a_written_value_comes_out_at_the_next_step(path: str, new: float) -> None:
    runner = ModelRunner(Loopback)
    register = find(runner.layout, path)
    read = codec(register, "little").decode
    before = runner.step(50_000_000, 50_000_000)
    assert runner.write(encode(register, new, "little")) == [""]
    assert runner.image == before
    assert read(before) == 0
    after = runner.step(100_000_000, 50_000_000)
    assert read(after) == new
    others = [r for r in runner.layout.registers if r.path != path]
    assert [codec(r, "little").decode(after) for r in others] == [codec(r, "little").decode(before) for r in others]
