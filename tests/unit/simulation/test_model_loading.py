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


@pytest.mark.parametrize("name", ["trace", "json", "signal", "numpy", "time", "msgspec", "errors"])
def test_a_file_beside_the_configuration_precedes_an_installed_module(folder: Path, name: str) -> None:
    before = sys.modules.get(name)
    (folder / f"{name}.py").write_text(BELT)
    model = load(f"{name}:Belt", folder)
    assert model.__name__ == "Belt"
    assert model.code_files()[0] == folder / f"{name}.py"
    assert load(f"{name}:Belt", folder) is model, "it is imported once"
    assert sys.modules.get(name) in (before, sys.modules[model.__module__]), "others import the installed module"
    with pytest.raises(ConfigError, match=f"unknown class 'Blet' of {name}; did you mean 'Belt'?"):
        load(f"{name}:Blet", folder)


def test_a_package_beside_the_configuration_precedes_an_installed_one(folder: Path) -> None:
    (folder / "json").mkdir()
    (folder / "json/__init__.py").write_text("")
    (folder / "json/parts.py").write_text("from shmio.simulation import Output\nREAL = Output('LREAL')\n")
    (folder / "json/belt.py").write_text(f"from .parts import REAL\n{BELT}")
    assert load("json.belt:Belt", folder).__name__ == "Belt"
    with pytest.raises(ConfigError, match=r"there is no module json\.decoder that is installed or in"):
        load("json.decoder:JSONDecoder", folder)


def test_a_file_with_the_name_of_shmio_does_not_hide_shmio(folder: Path) -> None:
    (folder / "shmio.py").write_text("raise RuntimeError")
    assert load("shmio.simulation.loopback:Loopback", folder) is Loopback


def test_modules_of_two_folders_are_not_mixed_up(folder: Path) -> None:
    for name, text in (("one", BELT), ("two", BELT.replace("Belt", "Lift"))):
        (folder / name).mkdir()
        (folder / name / "plant_x.py").write_text(text)
    assert load("plant_x:Belt", folder / "one").__name__ == "Belt"
    assert load("plant_x:Lift", folder / "two").__name__ == "Lift"


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
