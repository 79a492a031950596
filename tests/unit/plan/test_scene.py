"""The description of a cell in 3D: what a page draws of it, and what ``check`` refuses."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from shmio.config import load
from shmio.config.faults import Faults
from shmio.config.scene import MAX_BODIES
from shmio.errors import ConfigError
from shmio.layout.model import Layout, Register
from shmio.plan import scene as module
from shmio.plan.prepare import prepare
from shmio.plan.scene import check_scene

ROOT = Path(__file__).parents[3]
LAYOUT = Layout(
    "cell", 1, 14, False,
    (
        Register("a/pos", "REAL", (), 0, None, 4, 1),
        Register("b/pos", "REAL", (), 4, None, 4, 1),
        Register("bits", "BYTE", ((0, 1),), 8, None, 2, 2),
        Register("name", "STRING[2]", (), 10, None, 4, 1),
    ),
)  # fmt: skip
ARM = """
[[template]]
name = "arm"
[[template.body]]
name = "base"
label = "base of {name}"
[[template.body]]
name = "link"
parent = "base"
joint = { type = "revolute", axis = [0, 1, 0], register = "{path}/pos", scale = -1, offset = 90 }
shape = [{ form = "box", size_mm = [1, 2, 3], color = "{color}" }]
"""
COPY = """
[[copy]]
name = "NAME"
template = "arm"
position_mm = [1, 2, 3]
values = { path = "cell/NAME", name = "NAME", color = "#ff0000" }
"""
BODY = '[[body]]\nname = "x"\n'
JOINT = 'joint = { type = "prismatic", register = "cell/a/pos" }\n'


def checked(folder: Path, text: str, *, replayed: bool = False) -> tuple[Any, Faults]:
    (folder / "scene.toml").write_text(text)
    file = folder / "supervisor.toml"
    file.write_text('[instance]\nname = "a"\n[web]\nlisten = "127.0.0.1:8080"\nscene = "scene.toml"\n')
    faults = Faults(file, {})
    return check_scene(load(file), {"cell": LAYOUT}, faults, replayed=replayed), faults


def fault(folder: Path, text: str) -> str:
    _, faults = checked(folder, text)
    with pytest.raises(ConfigError) as caught:
        faults.raise_any()
    return str(caught.value)


def test_copies_have_bodies_and_registers_of_their_own(tmp_path: Path) -> None:
    tool = '[[body]]\nname = "tool"\nparent = "b/link"\njoint = { type = "prismatic", register = "bits/0.%X3" }\n'
    scene, faults = checked(tmp_path, tool + ARM + COPY.replace("NAME", "a") + COPY.replace("NAME", "b"))
    faults.raise_any()
    bodies = {body["name"]: body for body in scene["bodies"]}
    names = list(bodies)
    assert sorted(names) == ["a", "a/base", "a/link", "b", "b/base", "b/link", "tool"]
    for name, parent in (("a/base", "a"), ("a/link", "a/base"), ("b/link", "b/base"), ("tool", "b/link")):
        assert names[bodies[name]["parent"]] == parent
        assert bodies[name]["parent"] < names.index(name)
    assert bodies["a"]["parent"] == -1
    assert bodies["b/base"]["label"] == "base of b"
    joint = bodies["b/link"]["joint"]
    assert (joint["register"], joint["unit"], joint["scale"], joint["offset"]) == ("cell/b/pos", "deg", -1, 90)
    assert bodies["tool"]["joint"]["register"] == "cell/bits/0.%X3"
    assert bodies["a/link"]["shapes"][0]["color"] == "#ff0000"
    assert list(bodies["a"]["position_mm"]) == [1, 2, 3]


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        (f'{BODY}joint = {{ type = "revolute", register = "cell/a/poss" }}\n', 3, ["body[0].joint.register", "a/pos"]),
        (f'{BODY}joint = {{ type = "revolute", register = "cell/bits" }}\n', 3, ["array", "cell/bits/0"]),
        (f'{BODY}joint = {{ type = "revolute", register = "cell/name" }}\n', 3, ["STRING", "not a number"]),
        (f'{BODY}joint = {{ type = "revolute", register = "cell/a/pos/in" }}\n', 3, ["/in"]),
        (f'{BODY}[body.joint]\ntype = "revolve"\nregister = "x"\n', 4, ["revolve", "did you mean 'revolute'"]),
        (f'{BODY}[body.joint]\ntype = "revolute"\nregister = "cell/a/pos"\naxis = [0, 0, 0]\n', 6, ["direction"]),
        (f'{BODY}[body.joint]\ntype = "revolute"\nregister = "cell/a/pos"\nunit = "mm"\n', 6, ["unit", "deg, rad"]),
        (f"{BODY}[body.joint]\ntype = \"revolute\"\n", 3, ["body[0].joint.register: this key is needed"]),
        (f'{BODY}colour = "red"\n', 3, ["body[0].colour: unknown key"]),
        (f"{BODY}position_mm = [1, 2]\n", 3, ["length 3"]),
        (f"{BODY}position_mm = [1, nan, 2]\n", 3, ["position_mm"]),
        (f'{BODY}position_mm = [1, 2, "x"]\n', 3, ["a number"]),
        (f'{BODY}[[body.shape]]\nform = "sphere"\n', 3, ["body[0].shape[0].radius_mm", "needed"]),
        (f'{BODY}[[body.shape]]\nform = "sphere"\nradius_mm = 1\nlength_mm = 2\n', 6, ["length_mm", "cylinder"]),
        (f'{BODY}[[body.shape]]\nform = "sphere"\nradius_mm = 1\ncolor = "red"\n', 6, ["#RRGGBB"]),
        (f'{BODY}[[body.shape]]\nform = "box"\nsize_mm = [1, 1, 1]\nalong = "x"\n', 6, ["along", "for cylinder"]),
        (f'{BODY}[[body.shape]]\nform = "mesh"\n', 4, ["mesh", "box, cylinder, sphere"]),
        (f'{BODY}parent = "xx"\n[[body]]\nname = "xy"\n', 3, ["unknown body 'xx'", "did you mean"]),
        (f"{BODY}{BODY}", 4, ["'x' is already the name of body[0]"]),
        (f'{BODY}parent = "y"\n[[body]]\nname = "y"\nparent = "x"\n', 3, ["loop", "x on y on x"]),
        (f'{BODY}parent = "x"\n', 3, ["loop"]),
        (f"{ARM}{COPY.replace('arm', 'leg')}", 15, ["unknown template 'leg'"]),
        (f"{ARM}{COPY.replace('path =', 'paths =')}", 17, ["{path}"]),
        (f"{ARM}{COPY.replace('#ff0000', 'red')}", 17, ["#RRGGBB"]),
        (f"{ARM}{COPY}", 10, ["template[0].body[1].joint.register", "cell/NAME/pos", "in NAME/link"]),
        ("[body]\n", 1, ["double brackets"]),
    ],
)  # fmt: skip
def test_fault_names_line_and_remedy(tmp_path: Path, text: str, line: int, words: list[str]) -> None:
    found = fault(tmp_path, text)
    assert found.startswith(f"{tmp_path}/scene.toml:{line}: "), found
    assert all(word in found for word in words), found


def test_all_faults_are_found_at_once(tmp_path: Path) -> None:
    text = f'{BODY}position_mm = 3\n[[body]]\nnam = "y"\n'
    assert len(fault(tmp_path, text).splitlines()) == 2


@pytest.mark.parametrize("text", ["body = 3", "[[body", "\0", "copy = [1]", "template = [{ name = 3 }]"])
def test_other_text_is_refused(tmp_path: Path, text: str) -> None:
    assert "scene.toml" in fault(tmp_path, text)


KEYS = (
    "body", "template", "copy", "floor", "camera", "name", "parent", "joint", "shape", "type", "register", "form",
    "size_mm", "radius_mm", "position_mm", "axis", "values", "label", "color", "unit",
)  # fmt: skip
TEXTS = ("x", "y", "x/y", "arm", "box", "sphere", "revolute", "cell/a/pos", "{x}", "{", "#ff0000", "mm", "")
VALUES = st.recursive(
    st.sampled_from(TEXTS) | st.sampled_from((0, 1, -1e9, 1e308, True)) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from(KEYS), inner, max_size=6),
    max_leaves=40,
)


def toml(value: Any) -> str:
    if isinstance(value, dict):
        return f"{{{', '.join(f'{key} = {toml(item)}' for key, item in value.items())}}}"
    if isinstance(value, list):
        return f"[{', '.join(map(toml, value))}]"
    return json.dumps(value)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.dictionaries(st.sampled_from(KEYS[:5]), st.lists(VALUES, max_size=3) | VALUES, max_size=4))
def test_any_description_is_drawn_or_refused(tmp_path: Path, tables: dict[str, Any]) -> None:
    scene, faults = checked(tmp_path, "\n".join(f"{key} = {toml(value)}" for key, value in tables.items()))
    assert (scene is None) == bool(faults)
    assert msgspec.json.encode(scene)


def test_missing_file_is_named(tmp_path: Path) -> None:
    _, faults = checked(tmp_path, "")
    assert not faults
    (tmp_path / "scene.toml").unlink()
    check_scene(load(tmp_path / "supervisor.toml"), {}, faults, replayed=False)
    with pytest.raises(ConfigError, match=r"web\.scene: .*scene\.toml: No such file"):
        faults.raise_any()


def test_number_of_bodies_shapes_and_registers_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    many = "".join(f'[[body]]\nname = "x{number}"\n' for number in range(MAX_BODIES + 1))
    assert "more than 500 bodies" in fault(tmp_path, many)
    body = '[[template.body]]\nname = "y"\n' + '[[template.body.shape]]\nform = "sphere"\nradius_mm = 1\n' * 101
    copies = "".join(f'[[copy]]\nname = "c{number}"\ntemplate = "t"\n' for number in range(20))
    assert "more than 2000 shapes" in fault(tmp_path, f'[[template]]\nname = "t"\n{body}{copies}')
    monkeypatch.setattr(module, "MAX_REGISTERS", 0)
    assert "at most 0" in fault(tmp_path, BODY + JOINT)


def test_body_stands_still_in_a_recording_without_its_register(tmp_path: Path) -> None:
    scene, faults = checked(tmp_path, f"{BODY}{JOINT.replace('pos', 'speed')}", replayed=True)
    assert scene["bodies"][0]["joint"] is None
    assert not faults
    faults.add("other: fault")
    with pytest.raises(ConfigError, match=r"warning: body.* x stands still"):
        faults.raise_any()


def test_scene_of_the_demo_reaches_the_page() -> None:
    plan = prepare(ROOT / "supervisor.toml").plan
    (web,) = (job for job in plan.jobs if job.name == "web")
    moved = {body["joint"]["register"] for body in web.config["scene"]["bodies"] if body["joint"]}
    for robot in ("Robot_800", "Robot_825", "Robot_850"):
        assert {f"cell/{robot}/Axs{axis}_Pos" for axis in range(1, 7)} <= moved
    assert {"cell/NCAchse1_Pos", "cell/NCAchse2_Pos"} <= moved
