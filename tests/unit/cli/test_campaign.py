"""``shmio inject --file``: files that it refuses before it injects anything.

Whole campaigns are in tests/system/test_campaign.py.
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import cast

import pytest

from shmio.cli.inject import run_campaign
from shmio.cli.user import main
from shmio.config import Declaration
from shmio.layout.model import Layout, Register
from shmio.model.cell import Cell
from shmio.model.clock import Clock, ClockMode
from shmio.model.injection import InjectionEvent
from shmio.segment import BlockSpec, ProcessSpec, Segment

LAYOUT = Layout("DB1", 1, 4, False, (Register("a", "INT", (), 0, None, 2, 1), Register("b", "INT", (), 2, None, 2, 1)))
GOOD = '[[injection]]\nname = "x"\ntarget = "cell/a"\noperation = "noise"\namplitude = 1\n'


@pytest.fixture
def segment(instance: str) -> Iterator[Segment]:
    spec = BlockSpec("cell", LAYOUT, 20_000_000, 10**9, 1 << 16)
    with Segment.create(instance, [spec], [ProcessSpec("cell", "source")]) as segment:
        yield segment
        segment.unlink()


@pytest.mark.parametrize(
    ("text", "error"),
    [
        (None, "c.toml: No such file or directory"),
        ("[[injection]\n", "c.toml: the file is not valid TOML"),
        ("", "c.toml: injection: this key is needed"),
        (GOOD.replace("amplitude = 1", ""), "injection[0].amplitude: this key is needed for operation 'noise'"),
        (GOOD.replace("cell/a", "cell/c"), "injection[0].target: cell/c: DB1 has no such register"),
        (GOOD + GOOD.replace('"x"', '"y"') + 'when = "a >"\n', "injection[1].when: at character 4: expected"),
        (GOOD + "for = 1\n", "injection[0].for: unknown key; did you mean 'for_s'?"),
    ],
)
def test_faulty_file_injects_nothing(
    segment: Segment, tmp_path: Path, text: str | None, error: str, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "c.toml"
    if text is not None:
        file.write_text(text)
    assert main(["inject", "--instance", segment.instance, "--seed", "1", "--file", str(file)]) == 1
    told = capsys.readouterr().err
    assert error in told
    assert told.count("\n") == 1
    assert segment.blocks["cell"].injections.read() == ()


class Still:
    """An instance whose time is paused, and whose campaigns end at once."""

    clock = Clock(ClockMode.VIRTUAL, time_ns=3_000_000_000)
    declared = ()

    def __iter__(self) -> Iterator[InjectionEvent]:
        return iter(())

    @contextmanager
    def declare(self, _declarations: Sequence[Declaration], *, keep: bool) -> Iterator[Still]:
        yield self


@pytest.mark.parametrize("clock", [Still.clock, Still.clock._replace(playing=True), Clock()])
@pytest.mark.parametrize("from_now", [True, False])
def test_campaign_by_time_notes_that_time_is_paused(
    tmp_path: Path, clock: Clock, from_now: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    (file := tmp_path / "c.toml").write_text(GOOD)
    cell = Still()
    cell.clock = clock
    options = Namespace(seed=1, file=file, from_now=from_now, keep=False, for_s=None, json=False)
    assert run_campaign(cast("Cell", cell), options) == 0
    stands = "time is paused at 3.000 s; start_s and end_s wait until shmio step moves time\n"
    assert capsys.readouterr().err == (stands if clock is Still.clock and from_now else "")


def test_file_and_values_exclude_each_other(segment: Segment, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inject", "--instance", segment.instance, "--file", "c.toml", "cell/a", "1"]) == 1
    assert capsys.readouterr().err == "give --file, or PATH VALUE, not both\n"


@pytest.mark.parametrize("seed", ["-1", "x", str(2**63)])
def test_invalid_seed_is_wrong_usage(seed: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["inject", "--file", "c.toml", "--seed", seed])
    assert ended.value.code == 2
    assert "--seed" in capsys.readouterr().err
