"""Two instances that the fabric joins: the far one mirrors a source of the near one."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

import shmio
from shmio.model.values import OutcomeKind, Quality
from shmio.segment import instances
from shmio.testing.cell import Cell, until
from shmio.testing.ports import reserved_port

TAGS = """
[registers]
speed = { type = "REAL", comment = "of the belt" }
count = { type = "DINT", writable = true }
"""
NEAR = """
[instance]
name = "{instance}n"
[[source]]
name = "belt"
connector = "memory"
tags = "tags.toml"
period_ms = 20
writable = ["**"]
[fabric]
server = "embedded"
listen = "{nats}"
cell = "plant1.line3.near"
[[fabric.allow]]
sender = "plant1.line3.far"
roles = ["write"]
"""
FAR = """
[instance]
name = "{instance}f"
[[source]]
name = "mirrored"
connector = "fabric"
cell = "plant1.line3.near"
source = "belt"
writable = ["speed"]
[fabric]
server = "nats://{nats}"
cell = "plant1.line3.far"
"""


@pytest.fixture(scope="module")
def cells(tmp_path_factory: pytest.TempPathFactory, shared_instance: str) -> Iterator[tuple[Cell, Cell]]:
    tmp_path, instance = tmp_path_factory.mktemp("cells"), shared_instance
    with reserved_port() as nats, ExitStack() as stack:
        found = []
        for mark, text in (("n", NEAR), ("f", FAR)):
            folder = tmp_path / mark
            folder.mkdir()
            (folder / "supervisor.toml").write_text(text.format(instance=instance, nats=nats))
            found.append(Cell(folder, f"{instance}{mark}", nats))
            stack.callback(found[-1].supervisor, "down")
        near, far = found
        (near.folder / "tags.toml").write_text(TAGS)
        near.up()
        far.up()
        yield near, far


def test_a_mirror_shows_what_the_owner_has_and_passes_writes_on(cells: tuple[Cell, Cell]) -> None:
    near, far = cells
    with shmio.attach(near.instance, writable=True) as owner, shmio.attach(far.instance, writable=True) as mirror:
        [outcome] = owner.set({"belt/speed": 1.5})
        assert outcome.kind is OutcomeKind.WRITTEN
        until(lambda: mirror.get("mirrored/speed")[0].value == 1.5, "the mirror has the owner's value")

        def shows_the_same_frame() -> bool:
            """The owner publishes each 20 ms, so it may do so between the two readings."""
            [reading], [own] = mirror.get("mirrored/speed"), owner.get("belt/speed")
            assert (reading.quality, reading.provenance) == (Quality.GOOD, own.provenance)
            return reading.source_time == own.source_time

        until(shows_the_same_frame, "the mirror has the owner's frame with its time")
        [reading] = mirror.get("mirrored/speed")
        assert reading.register.comment == "of the belt"

        [outcome] = mirror.set({"mirrored/speed": 2.5})
        assert (outcome.kind, outcome.text) == (OutcomeKind.WRITTEN, "")
        assert owner.get("belt/speed")[0].value == 2.5
        until(lambda: mirror.get("mirrored/speed")[0].value == 2.5, "the mirror shows its own write")
        [outcome] = owner.set({"belt/count": 3})
        assert outcome.kind is OutcomeKind.WRITTEN, "the owner's table makes it writable at the owner"
        with pytest.raises(shmio.errors.CommandError, match=r"count is not writable.*`writable`"):
            mirror.set({"mirrored/count": 4})


def test_the_start_of_a_second_cell_of_the_same_name_fails(cells: tuple[Cell, Cell], tmp_path: Path) -> None:
    near, _ = cells
    text = NEAR.replace('server = "embedded"\nlisten = "{nats}"', 'server = "nats://{nats}"')
    (tmp_path / "supervisor.toml").write_text(text.format(instance=near.instance, nats=near.grpc))
    (tmp_path / "tags.toml").write_text(TAGS)
    second = Cell(tmp_path, f"{near.instance}n", near.grpc)
    done = second.supervisor("up", "--detach")
    assert done.returncode == 1, done.stdout
    assert f"fabric already has a cell plant1.line3.near: instance {near.instance} on host" in done.stderr
    assert second.instance not in instances()
    assert near.status()["state"] == "running"


def test_a_mirror_is_bad_while_the_owner_is_away(cells: tuple[Cell, Cell]) -> None:
    near, far = cells
    with shmio.attach(far.instance) as mirror:
        until(lambda: mirror.get("mirrored/count")[0].quality is Quality.GOOD, "the mirror is good")
        near.down()
        until(lambda: mirror.get("mirrored/count")[0].quality is Quality.BAD, "the mirror is bad")
        near.up()
        until(lambda: mirror.get("mirrored/count")[0].quality is Quality.GOOD, "the mirror is good again")


def test_a_mirror_follows_a_change_of_the_layout(cells: tuple[Cell, Cell]) -> None:
    near, far = cells
    with shmio.attach(far.instance) as mirror:
        until(lambda: mirror.get("mirrored/count")[0].quality is Quality.GOOD, "the mirror is good")
        (near.folder / "tags.toml").write_text(TAGS + 'torque = { type = "REAL" }\n')
        near.output("shmio-supervisor", "reload")

        def has_torque() -> bool:
            try:
                return mirror.get("mirrored/torque")[0].quality is Quality.GOOD
            except shmio.errors.PathError:
                return False

        until(has_torque, "the mirror has the new register")


def test_faults_in_the_configuration_of_a_mirror_are_named(cells: tuple[Cell, Cell]) -> None:
    _, far = cells
    file = far.folder / "supervisor.toml"
    text = file.read_text()
    try:
        file.write_text(text.replace('source = "belt"', 'source = "bolt"'))
        done = far.supervisor("check")
        assert done.returncode == 1
        assert "source[0].source" in done.stderr
        assert "did you mean 'belt'" in done.stderr
        file.write_text(text.replace('cell = "plant1.line3.near"', 'cell = "plant1.line3.neer"'))
        assert "did you mean 'plant1.line3.near'? (or start that cell first" in far.supervisor("check").stderr
        file.write_text(re.sub(r"nats://\S+:\d+", "nats://127.0.0.1:1", text))
        said = far.output("shmio-supervisor", "check")
        assert "source mirrored at plant1.line3.near/belt: " in said
        line = 1 + text.splitlines().index('cell = "plant1.line3.near"')
        assert (
            f"supervisor.toml:{line}: warning: source[0].cell: the layout of plant1.line3.near/belt is the one that"
            in said
        )
    finally:
        file.write_text(text)
