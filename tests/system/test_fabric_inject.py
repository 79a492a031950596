"""Injections into a mirror: the owner carries them out, and both hosts see the same."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import pytest

import shmio
from shmio.errors import CommandError, PathError
from shmio.local.attach import Attachment
from shmio.model.injection import Injection
from shmio.model.values import Quality
from shmio.testing.cell import BIN, PATIENCE_S, Cell, until
from shmio.testing.ports import reserved_port

TAGS = """
[registers]
speed = { type = "REAL" }
count = { type = "DINT" }
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
roles = ["write", "inject"]
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
armed = true
[[source]]
name = "own"
connector = "memory"
tags = "tags.toml"
[fabric]
server = "nats://{nats}"
cell = "plant1.line3.far"
"""
CAMPAIGN = """
duration_s = 1.5
[[injection]]
name = "too-fast"
target = "mirrored/speed"
operation = "set"
value = 99.0
when = "mirrored/count >= 0"
start_s = 0.5
for_s = 0.3
times = 1
[[expect]]
name = "seen"
formula = "eventually[0, 1.4] mirrored/speed > 90"
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
        (far.folder / "tags.toml").write_text('[registers]\nswitch = { type = "BOOL" }\n')
        near.up()
        far.up()
        yield near, far


@pytest.fixture
def attached(cells: tuple[Cell, Cell]) -> Iterator[tuple[Attachment, Attachment]]:
    near, far = cells
    with shmio.attach(near.instance, writable=True) as owner, shmio.attach(far.instance, writable=True) as mirror:
        until(lambda: mirror.get("mirrored/speed")[0].quality is Quality.GOOD, "the mirror is good")
        until(lambda: not mirror.injections(), "no injection is left of earlier tests")
        yield owner, mirror


def seen(cell: Attachment, path: str) -> tuple[object, str]:
    [reading] = cell.get(path)
    return reading.value, reading.provenance


def only(cell: Attachment) -> Injection[Any]:
    [found] = cell.injections()
    return found


def test_a_shadow_changes_what_both_hosts_see(
    cells: tuple[Cell, Cell], attached: tuple[Attachment, Attachment]
) -> None:
    owner, mirror = attached
    owner.set({"belt/speed": 1.5})
    with mirror.inject("mirrored/speed", name="test") as shadow:
        assert [str(one.kind) for one in shadow.set({"speed": 7.0})] == ["shadowed"]
        assert seen(owner, "belt/speed") == (7.0, "injected")
        assert seen(mirror, "mirrored/speed") == (7.0, "injected")
        assert only(owner).number == only(mirror).number == shadow.number
        assert only(mirror).name == "test"
        assert only(mirror).pid != only(owner).pid, "each host names its own process"
        assert "a program of another cell" in cells[0].output("shmio", "inject", "--list")
    until(lambda: seen(mirror, "mirrored/speed") == seen(owner, "belt/speed"), "over")
    assert not owner.injections()


def test_the_owners_injections_are_listed_and_lifted_at_the_mirror(attached: tuple[Attachment, Attachment]) -> None:
    owner, mirror = attached
    with owner.inject("belt/count", keep=True, name="of the owner") as shadow:
        shadow.set({"count": 4711})
    until(lambda: seen(mirror, "mirrored/count") == (4711, "injected"), "the mirror shows the injection")
    found = only(mirror)
    assert (found.number, found.name, found.cell) == (shadow.number, "of the owner", "plant1.line3.near")
    mirror.lift("mirrored", found.number)
    assert not owner.injections()
    with pytest.raises(PathError, match="no injection"):
        mirror.lift("mirrored", found.number)


def test_injections_that_exist_already_are_known_to_a_new_mirror(
    cells: tuple[Cell, Cell], attached: tuple[Attachment, Attachment]
) -> None:
    owner, mirror = attached
    with owner.inject("belt/count", name="before") as shadow:
        shadow.set({"count": 5})
        cells[1].output("shmio-supervisor", "restart", "mirrored")
        until(lambda: [one.number for one in mirror.injections()] == [shadow.number], "the list is known")
        until(lambda: seen(mirror, "mirrored/count") == (5, "injected"), "the provenance is known")
    until(lambda: not mirror.injections(), "the list follows")


def test_an_injection_ends_with_its_program(attached: tuple[Attachment, Attachment], cells: tuple[Cell, Cell]) -> None:
    owner, _ = attached
    program = (
        "import shmio, sys\n"
        f"with shmio.attach({cells[1].instance!r}, writable=True) as cell:\n"
        "    shadow = cell.inject('mirrored/speed')\n"
        "    print(shadow.number, flush=True)\n"
        "    sys.stdin.read()\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as child:
        assert child.stdout is not None
        number = int(child.stdout.readline())
        assert only(owner).number == number
        child.kill()
    until(lambda: not owner.injections(), "the owner has lifted the injection")


def test_the_command_ends_when_the_owner_lifts_its_injection(
    attached: tuple[Attachment, Attachment], cells: tuple[Cell, Cell]
) -> None:
    owner, mirror = attached
    command = [str(BIN / "shmio"), "inject", "mirrored/speed", "8"]
    with subprocess.Popen(
        command, cwd=cells[1].folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as popen:
        try:
            assert popen.stdout is not None
            number = int(popen.stdout.readline().partition(":")[0])
            cells[1].output("shmio-supervisor", "restart", "mirrored")
            until(lambda: seen(mirror, "mirrored/speed") == (8.0, "injected"), "it survives a restart of the mirror")
            owner.lift("belt", number)
            _, error = popen.communicate(timeout=PATIENCE_S)
        finally:
            popen.kill()
    assert popen.returncode == 1
    assert f"{number}: mirrored/speed/out was lifted" in error


def test_an_injection_ends_if_its_host_is_gone(cells: tuple[Cell, Cell]) -> None:
    near, far = cells
    with shmio.attach(near.instance, writable=True) as owner:
        with shmio.attach(far.instance, writable=True) as mirror:
            kept = mirror.inject("mirrored/speed", keep=True, name="kept")
            mirror.inject("mirrored/count", name="not kept")
            assert len(owner.injections()) == 2
            far.down()
            until(lambda: [one.name for one in owner.injections()] == ["kept"], "the owner lifts what nobody renews")
        far.up()
        with shmio.attach(far.instance) as mirror:
            until(lambda: [one.number for one in mirror.injections()] == [kept.number], "the new mirror shows it")
            assert (only(mirror).cell, only(mirror).pid) == ("plant1.line3.far", 0), "its program has no pid here"
            assert "a program of plant1.line3.far, kept" in far.output("shmio", "inject")
            owner.lift("belt", kept.number)
            until(lambda: not mirror.injections(), "the mirror sees the end")


def test_a_campaign_runs_on_the_far_host(cells: tuple[Cell, Cell], attached: tuple[Attachment, Attachment]) -> None:
    far = cells[1]
    (far.folder / "campaign.toml").write_text(CAMPAIGN)
    done = far.run("shmio-campaign", "run", "campaign.toml", "--json")
    assert done.returncode == 0, done.stdout + done.stderr
    assert not attached[0].injections()


def test_what_cannot_be_evaluated_at_the_owner_is_refused(attached: tuple[Attachment, Attachment]) -> None:
    _, mirror = attached
    freeze = {"name": "a", "target": "mirrored/speed", "operation": "freeze"}
    with pytest.raises(CommandError, match="own is no mirror"):
        mirror.declare([freeze | {"when": "own/switch"}])


def test_the_configuration_of_a_mirror_declares_no_injection(cells: tuple[Cell, Cell]) -> None:
    far = cells[1]
    file = far.folder / "supervisor.toml"
    text = file.read_text()
    declared = '[[injection]]\nname = "a"\ntarget = "mirrored/speed"\noperation = "freeze"\n'
    file.write_text(text + declared)
    done = far.supervisor("check")
    file.write_text(text)
    assert done.returncode == 1
    assert "injection[0].target" in done.stderr
    assert "plant1.line3.near" in done.stderr


def test_the_role_is_needed(cells: tuple[Cell, Cell], attached: tuple[Attachment, Attachment]) -> None:
    near, _ = cells
    owner, mirror = attached
    file = near.folder / "supervisor.toml"
    text = file.read_text()
    file.write_text(text.replace(', "inject"]', "]"))
    try:
        near.output("shmio-supervisor", "reload")

        def refused() -> bool:
            try:
                mirror.inject("mirrored/speed").close()
            except CommandError as error:
                return all(
                    word in str(error) for word in ("fabric.allow", "inject", "plant1.line3.near", "supervisor.toml")
                )
            return False

        until(refused, "the owner names what to change")
        assert not owner.injections()
    finally:
        file.write_text(text)
        near.output("shmio-supervisor", "reload")
    until(lambda: "denied" in {one["outcome"] for one in audited(near)}, "the audit log has the refusal")


def test_the_audit_names_the_far_cell(cells: tuple[Cell, Cell], attached: tuple[Attachment, Attachment]) -> None:
    _, mirror = attached
    before = len(audited(cells[0]))
    with mirror.inject("mirrored/speed") as shadow:
        shadow.set({"speed": 1.0})
    with mirror.declare([{"name": "a", "target": "mirrored/speed", "operation": "freeze"}]):
        pass
    wanted = {"inject", "lift", "declare", "feed"}
    until(lambda: {one["action"] for one in audited(cells[0])[before:]} >= wanted, "the audit log has the actions")


def test_the_far_audit_has_only_what_programs_there_did(
    cells: tuple[Cell, Cell], attached: tuple[Attachment, Attachment]
) -> None:
    owner, mirror = attached
    with owner.inject("belt/count", name="of the owner") as shadow:
        shadow.set({"count": 12})
        until(lambda: seen(mirror, "mirrored/count") == (12, "injected"), "the mirror shows the injection")
    until(lambda: not mirror.injections(), "the mirror shows its end")
    with mirror.inject("mirrored/speed", name="of the mirror"):
        pass

    def names() -> set[str]:
        return {one["what"].get("name", "") for one in audited(cells[1], str(os.getuid()))}

    until(lambda: "of the mirror" in names(), "the audit log has the far injection")
    assert "of the owner" not in names()


def audited(cell: Cell, who: str = "plant1.line3.far") -> list[dict[str, Any]]:
    """Return what a cell's audit log has of an actor; of the far cell, if you name none."""
    audit = [json.loads(line) for line in cell.output("shmio-supervisor", "audit", "--json").splitlines()]
    return [one for one in audit if one["who"] == who]
