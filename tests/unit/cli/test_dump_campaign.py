"""``shmio-dump campaign``: writes the recorded injections to a campaign file that repeats them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest

from shmio.cli.dump import main
from shmio.config.campaign import read_campaign
from shmio.model.values import NO_WRITER
from shmio.segment import EventKind, Record
from tests.unit.recording.build import Build, build, image

DRIFT: dict[str, Any] = {
    "name": "drift", "target": "cell/speed", "operation": "offset", "value": 2.5,
    "start_s": 0.5, "end_s": 0.9, "seed": 7,
}  # fmt: skip


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def declared(number: int, keys: dict[str, Any]) -> Record:
    document = msgspec.json.encode(keys)
    return Record(EventKind.INJECTED, keys["name"], 0, number, 0, 1, 0, 0, len(document), document, number)


def laid(number: int, direction: str, *ranges: tuple[int, int, int], name: str = "") -> Record:
    how = {"direction": direction, "priority": 3, "keep": False, "ranges": ranges}
    return Record(EventKind.INJECTED, name, 0, number, 0, 1, 0, 0, 0, msgspec.json.encode(how), number)


def given(number: int, count: int) -> Record:
    return Record(EventKind.SHADOWED, "", 0, 50, 0, 1, 0, 0, 2, count.to_bytes(2, "big"), number)


def lifted(number: int, reason: str = "lifted") -> Record:
    return Record(EventKind.LIFTED, reason, 0, 9, 0, 1, injection=number)


Derive = Callable[..., list[dict[str, Any]]]


@pytest.fixture
def derive(capsys: pytest.CaptureFixture[str]) -> Derive:
    """Record events after the given frames; return the declarations of the derived campaign."""

    def derive(*told: tuple[int, Record], options: tuple[str, ...] = (), said: str = "") -> list[dict[str, Any]]:
        for file in ("a.mem", "campaign.toml"):
            Path(file).unlink(missing_ok=True)
        with build(Path("a.mem")) as work:
            work.block("cell")
            for number in range(1, 101):
                work.frame(number, image(number))
                _tell(work, number, told)
        assert main(["campaign", "a.mem", "-o", "campaign.toml", *options]) == 0
        assert capsys.readouterr().err == said
        return [msgspec.to_builtins(one) for one in read_campaign(Path("campaign.toml"))]

    return derive


def _tell(work: Build, number: int, told: tuple[tuple[int, Record], ...]) -> None:
    for at, record in told:
        if at == number:
            work.tell(record, after=number)


def test_declaration_before_its_start_is_unchanged(derive: Derive) -> None:
    [one] = derive((10, declared(5, DRIFT)), (60, lifted(5, "over")))
    assert one == DRIFT


def test_start_and_end_come_from_the_recorded_events(derive: Derive) -> None:
    """A cycle takes 20 ms."""
    keys = {name: DRIFT[name] for name in ("name", "target", "operation", "value", "seed")}
    [one] = derive((10, declared(5, keys)), (60, lifted(5)))
    assert one == keys | {"start_s": 0.200000001, "end_s": 1.200000001}
    [one] = derive((10, declared(5, keys)), (60, lifted(5)), options=("--from-zero",))
    assert one == keys | {"end_s": 1.0}
    [one] = derive((30, declared(5, DRIFT)))
    assert one == DRIFT | {"start_s": 0.600000001}, "declared after its start time"


def test_texts_lists_and_names(derive: Derive) -> None:
    keys = DRIFT | {"operation": "set", "target": ["cell/row", 'cell/\u00fc "\\'], "value": [1, -2, 3]}
    again = keys | {"value": "16#FF", "target": "cell/count"}
    later = {"name": "later", "target": "cell/count", "operation": "freeze", "start_s": 0.6}
    found = derive((10, declared(7, later)), (10, declared(5, keys)), (20, declared(6, again)), (40, lifted(7)))
    assert found == [later | {"end_s": 0.800000001}, keys, again | {"name": "drift-2"}], "in the order of the events"


def test_values_of_a_client_become_set_operations(derive: Derive) -> None:
    found = derive(
        (10, laid(5, "out", (0, 2, 255), name="hand")),
        (10, given(5, 7)),
        (15, given(5, 7)),
        (20, given(5, 8)),
        (30, lifted(5, "the injection's client has ended")),
    )
    same = {"target": "cell/count", "operation": "set", "priority": 3}
    assert found == [
        same | {"name": "hand", "value": 7, "start_s": 0.200000001, "end_s": 0.400000001},
        same | {"name": "hand-2", "value": 8, "start_s": 0.400000001, "end_s": 0.600000001},
    ]


def test_injections_that_cannot_be_declared_are_reported(derive: Derive, capsys: pytest.CaptureFixture[str]) -> None:
    blind = declared(7, DRIFT | {"name": "blind"})._replace(writer=NO_WRITER)
    again = "no client created this injection, but the configuration or a replayed recording"
    limit = laid(5, "in", (0, 2, 255), name="limit")
    why = "a client gave its values over /in, and they depended on other writes"
    earlier = "it was created before the recording began"
    derive(
        (1, blind), (5, given(4, 1)), (5, given(4, 2)), (10, limit), (20, declared(6, DRIFT)),
        said="".join(f"not exactly reproduced: {x}\n" for x in (f"blind: {again}", f"4: {earlier}", f"limit: {why}")),
    )  # fmt: skip
    Path("campaign.toml").unlink()
    with build(Path("b.mem")) as work:
        work.block("cell")
        work.frame(1, image(1))
    assert main(["campaign", "b.mem", "-o", "campaign.toml"]) == 1
    assert capsys.readouterr().err == "b.mem: it has no injection that can be declared\n"
    assert not Path("campaign.toml").exists()
