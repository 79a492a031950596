"""Reads the scene, a file that describes a cell in 3D (key ``scene`` of ``[web]``, docs/reference/scene.md)."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

from msgspec import Meta

from shmio.config.faults import Faults
from shmio.config.model import AlongName, FormName, JointTypeName, Name, Section, Text, UnitName
from shmio.config.read import Structure, convert, parse, read_text

MAX_BODIES: Final = 500
"""Maximum number of bodies, including those of all copies."""
MAX_SHAPES: Final = 2_000
"""Maximum number of shapes, including those of all copies."""

Length = Annotated[float, Meta(gt=0, le=1e6)]
Coordinate = Annotated[float, Meta(ge=-1e6, le=1e6)]
Vector = tuple[Coordinate, Coordinate, Coordinate]
Size = tuple[Length, Length, Length]
Label = Annotated[str, Meta(max_length=80)]

_COLOR: Final = re.compile(r"#[0-9A-Fa-f]{6}")
_PLACEHOLDER: Final = re.compile(r"\{([A-Za-z0-9_-]+)\}")


class Shape(Section):
    """``[[body.shape]]``: a visible part of a body."""

    form: FormName
    size_mm: Size | None = None
    radius_mm: Length | None = None
    top_radius_mm: Annotated[float, Meta(ge=0, le=1e6)] | None = None
    length_mm: Length | None = None
    along: AlongName | None = None
    round_mm: Annotated[float, Meta(ge=0, le=1e6)] | None = None
    position_mm: Vector = (0.0, 0.0, 0.0)
    rotation_deg: Vector = (0.0, 0.0, 0.0)
    color: Text = "#a3adb8"


class Joint(Section):
    """``[body.joint]``: how the value of a register turns or moves the body."""

    type: JointTypeName
    register: Text
    axis: Vector = (0.0, 0.0, 1.0)
    unit: UnitName | None = None
    scale: Annotated[float, Meta(ge=-1e9, le=1e9)] = 1.0
    offset: Annotated[float, Meta(ge=-1e9, le=1e9)] = 0.0
    smooth_s: Annotated[float, Meta(ge=0, le=60)] = 0.0


class Body(Section):
    """``[[body]]``: a rigid body, placed relative to its parent."""

    name: Name
    parent: Text | None = None
    position_mm: Vector = (0.0, 0.0, 0.0)
    rotation_deg: Vector = (0.0, 0.0, 0.0)
    joint: Joint | None = None
    label: Label = ""
    shape: list[Shape] = []


class Template(Section):
    """``[[template]]``: a group of bodies, which each ``[[copy]]`` repeats."""

    name: Name
    body: list[Body] = []


class Copy(Section):
    """``[[copy]]``: a copy of the bodies of a template, at another place and moved by other registers."""

    name: Name
    template: Text
    parent: Text | None = None
    position_mm: Vector = (0.0, 0.0, 0.0)
    rotation_deg: Vector = (0.0, 0.0, 0.0)
    label: Label = ""
    values: Annotated[dict[Text, str], Meta(max_length=100)] = {}


class Floor(Section):
    """``[floor]``: the ground, at height 0."""

    size_mm: tuple[Length, Length]
    center_mm: tuple[Coordinate, Coordinate] = (0.0, 0.0)
    grid_mm: Annotated[float, Meta(ge=0, le=1e6)] = 1000.0


class Camera(Section):
    """``[camera]``: the initial viewpoint."""

    target_mm: Vector | None = None
    distance_mm: Length | None = None
    azimuth_deg: Annotated[float, Meta(ge=-360, le=360)] = -60.0
    elevation_deg: Annotated[float, Meta(ge=-89, le=89)] = 25.0


class Scene(Section):
    """The contents of a scene file."""

    body: list[Body] = []
    template: list[Template] = []
    copy: list[Copy] = []
    floor: Floor | None = None
    camera: Camera | None = None


_TABLES: Final[Mapping[str, type[Section]]] = {
    "body": Body,
    "body.joint": Joint,
    "body.shape": Shape,
    "template": Template,
    "template.body": Body,
    "template.body.joint": Joint,
    "template.body.shape": Shape,
    "copy": Copy,
    "floor": Floor,
    "camera": Camera,
}
_SEVERAL: Final = frozenset({"body", "body.shape", "template", "template.body", "template.body.shape", "copy"})


@dataclass(frozen=True)
class _Keys:
    """The keys of a form: those that it needs, and those that it may have."""

    needed: tuple[str, ...]
    free: tuple[str, ...] = ()


_KEYS: Final[Mapping[str, _Keys]] = {
    "box": _Keys(("size_mm",), ("round_mm",)),
    "cylinder": _Keys(("radius_mm", "length_mm"), ("top_radius_mm", "along", "round_mm")),
    "sphere": _Keys(("radius_mm",)),
}
_MEASURES: Final = ("size_mm", "radius_mm", "top_radius_mm", "length_mm", "along", "round_mm")
_UNITS: Final[Mapping[str, tuple[UnitName, ...]]] = {"revolute": ("deg", "rad"), "prismatic": ("mm", "m")}
"""The units that a register may have, by the type of its joint; the first unit is the default."""


def examine_scene(file: Path) -> tuple[Scene, Faults]:
    """Read a scene file, and collect the faults that can be found without knowing the registers.

    Returns:
        The scene, which is complete only if there are no faults; and the faults.

    Raises:
        ConfigError: The file cannot be read or is not TOML.

    """
    text = read_text(file, "; create it, or leave out this key")
    tables = parse(file, text)
    faults = Faults(file, tables, text)
    sound, _ = Structure(faults, Scene, _TABLES, _SEVERAL).sections(tables)
    if faults:
        return Scene(), faults
    scene = convert(sound, Scene)
    for key, body in bodies(scene):
        for index, shape in enumerate(body.shape):
            for fault in _shape_faults(shape, template=key.startswith("template")):
                faults.add(f"{key}.shape[{index}].{fault}")
        for fault in _joint_faults(body.joint) if body.joint else ():
            faults.add(f"{key}.joint.{fault}")
    return scene, faults


def bodies(scene: Scene) -> Iterator[tuple[str, Body]]:
    """Yield (key, body) of each body in the file, including the bodies of templates."""
    for index, body in enumerate(scene.body):
        yield f"body[{index}]", body
    for place, template in enumerate(scene.template):
        for index, body in enumerate(template.body):
            yield f"template[{place}].body[{index}]", body


def unit(joint: Joint) -> UnitName:
    """Return the unit of the register that moves a joint."""
    return joint.unit or _UNITS[joint.type][0]


def filled(text: str, values: Mapping[str, str]) -> str:
    """Return a text of a template in which each ``{name}`` is replaced by the copy's value of this name.

    Raises:
        KeyError: The copy has no value of this name.

    """
    return _PLACEHOLDER.sub(lambda match: values[match[1]], text)


def is_color(text: str) -> bool:
    """Return whether a text is a colour that shapes can have."""
    return _COLOR.fullmatch(text) is not None


def _shape_faults(shape: Shape, *, template: bool) -> Iterator[str]:
    keys = _KEYS[shape.form]
    for key in keys.needed:
        if getattr(shape, key) is None:
            yield f"{key}: this key is needed for form {shape.form!r}"
    for key in _MEASURES:
        if getattr(shape, key) is not None and key not in (*keys.needed, *keys.free):
            takers = ", ".join(form for form, other in _KEYS.items() if key in (*other.needed, *other.free))
            yield f"{key}: form {shape.form!r} has no such key; the key is for {takers}"
    if not (is_color(shape.color) or (template and _PLACEHOLDER.search(shape.color))):
        yield f'color: {shape.color!r} is not a colour; write it as "#RRGGBB", such as "#ff8800"'


def _joint_faults(joint: Joint) -> Iterator[str]:
    if not any(joint.axis):
        yield "axis: all its numbers are 0, so it has no direction; write, for example, [0, 0, 1]"
    known = _UNITS[joint.type]
    if unit(joint) not in known:
        yield f"unit: a {joint.type} joint cannot have the unit {joint.unit}; valid: {', '.join(known)}"
