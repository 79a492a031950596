"""Two cells at one broker, with the commands of the page on MQTT."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from shmio.config import Address
from shmio.testing.ports import reserved_port
from tests.system.page import printed, shell
from tests.unit.endpoints.mqtt.harness import listening

ROOT = Path(__file__).parents[2]
BLOCK = re.compile(r"^```sh\n(.*?)^```$", re.DOTALL | re.MULTILINE)
CELLS = ("north", "south")


@pytest.fixture
def broker() -> Iterator[Address]:
    with reserved_port() as address:
        yield address


@pytest.fixture
def folder(tmp_path: Path, instance: str, broker: Address) -> Iterator[Path]:
    """Copy the examples to a folder, with names and a port of this test."""
    shutil.copytree(ROOT / "examples", tmp_path / "examples")
    for cell in CELLS:
        file = tmp_path / "examples/two-cells" / cell / "supervisor.toml"
        text = file.read_text()
        assert text.count("127.0.0.1:1883") == text.count(f'name = "{cell}"') == 1
        file.write_text(
            text.replace("127.0.0.1:1883", str(broker))
            .replace(f'"{cell}"', f'"{instance}-{cell}"')
            .replace("+/south", f"+/{instance}-south")
        )
    yield tmp_path
    for cell in CELLS:
        shell(f"shmio-supervisor down -c examples/two-cells/{cell}/supervisor.toml", tmp_path)


def test_the_page_on_two_cells_runs_as_shown(folder: Path, broker: Address, instance: str) -> None:
    page = (ROOT / "docs/how-to/use-mqtt.md").read_text().replace("127.0.0.1:1883", str(broker))
    begin, end = BLOCK.findall(page)
    shown = [line.rpartition(" ")[0] for line in printed(begin, folder).splitlines()[-2:]]
    assert sorted(shown) == [f"plant/{cell}/sim/joints/Kuka.j1/R/out" for cell in CELLS]
    with listening(broker, "plant/#", f"spBv1.0/plant/NDEATH/{instance}-south", protocol=4) as listener:
        found: dict[str, bytes] = {}
        expected = {"plant/north/sim/joints/Kuka.j1/R/out": b"1.5", "plant/south/sim/joints/Kuka.j1/R/out": b"2.5"}
        while {topic: found.get(topic) for topic in expected} != expected:
            message = listener.message()
            found[message.topic] = bytes(message.payload)
        printed(end, folder)
        while listener.message().topic != f"spBv1.0/plant/NDEATH/{instance}-south":
            pass
