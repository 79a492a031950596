from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from shmio.errors import ConfigError
from shmio.simulation import load
from shmio.simulation.a50 import A50Cell
from shmio.simulation.loopback import Loopback


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    """Make a folder for modules. Modules imported from it are unloaded afterwards."""
    modules, path = set(sys.modules), list(sys.path)
    yield tmp_path
    sys.path[:] = path
    for name in set(sys.modules) - modules:
        if str(tmp_path) in str(getattr(sys.modules[name], "__file__", "")):
            del sys.modules[name]


def test_shipped_models_are_there() -> None:
    assert load("shmio.simulation.loopback:Loopback") is Loopback
    assert load("shmio.simulation.a50:A50Cell") is A50Cell


BELT = """
from shmio.simulation import Model, Output
class Belt(Model):
    position = Output("LREAL")
    def step(self, time_s, dt_s):
        self.position = time_s
"""


def test_a_model_of_the_folder_is_found(folder: Path) -> None:
    (folder / "plant_belt.py").write_text(BELT)
    assert load("plant_belt:Belt", folder).__name__ == "Belt"


def test_an_installed_module_comes_first(folder: Path) -> None:
    (folder / "json.py").write_text(BELT)
    with pytest.raises(ConfigError, match="unknown class 'Belt' of json"):
        load("json:Belt", folder)


@pytest.mark.parametrize(
    "text", ["", "Belt", "plant:", ":Belt", "plant.belt.Belt", "plant:Belt()", "../x:Belt", "a..b:C"]
)
def test_invalid_names_are_refused(text: str) -> None:
    with pytest.raises(ConfigError, match=r"^expected package\.module:Class or the file of an FMU \(\.fmu\), found "):
        load(text)


@pytest.mark.parametrize(
    ("source", "text", "message"),
    [
        (BELT, "plant_m:Blet", "unknown class 'Blet' of plant_m; did you mean 'Belt'?"),
        (BELT, "plant_n:Belt", "there is no module plant_n that is installed or in "),
        (BELT, "plant_m.deeper:Belt", "there is no module plant_m.deeper that is installed or in "),
        (BELT, "plant_m:Output", "plant_m:Output is not a subclass of shmio.simulation.Model"),
        (
            "import nowhere_at_all",
            "plant_m:Belt",
            r"plant_m cannot be imported: .*nowhere_at_all.* \(plant_m.py, line 1\)",
        ),
        ("x = (", "plant_m:Belt", r"plant_m cannot be imported: .*never closed \(plant_m.py, line 1\)"),
        ("a = 1\nb = a / 0", "plant_m:Belt", r"cannot be imported: ZeroDivisionError: .* \(plant_m.py, line 2\)"),
        ("raise SystemExit", "plant_m:Belt", r"cannot be imported: SystemExit.* \(plant_m.py, line 1\)"),
        (
            BELT.replace("LREAL", "LRAEL"),
            "plant_m:Belt",
            r"cannot be imported: model Belt: position: unknown type .*line 3",
        ),
        (
            BELT.replace("def step", "def stop"),
            "plant_m:Belt",
            r"plant_m:Belt has no method step\(self, time_s, dt_s\)",
        ),
    ],
)
def test_errors_name_the_module_and_line(folder: Path, source: str, text: str, message: str) -> None:
    (folder / "plant_m.py").write_text(source)
    with pytest.raises(ConfigError, match=message) as caught:
        load(text, folder)
    assert "\n" not in str(caught.value)
