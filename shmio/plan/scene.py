"""Makes the scene for the web page from a scene file: copies templates, sorts bodies, checks registers."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import msgspec
from msgspec.structs import replace

from shmio.config import Config
from shmio.config.faults import Faults
from shmio.config.scene import (
    MAX_BODIES,
    MAX_SHAPES,
    Body,
    Copy,
    Joint,
    Scene,
    Shape,
    Template,
    examine_scene,
    filled,
    is_color,
    unit,
)
from shmio.errors import ConfigError, PathError
from shmio.layout.model import NUMBERS, Layout
from shmio.layout.topic import look_up, parse_topic
from shmio.wording import already_named, unknown

MAX_REGISTERS: Final = 200
"""Maximum number of registers that move bodies: the number that one web page can follow."""
_TYPES: Final = NUMBERS | {"BOOL"}


class _Placed(msgspec.Struct):
    """A body of the scene, with the key of its description and its parent's name."""

    key: str
    name: str
    parent: str | None
    body: Body
    label: str


def check_scene(
    config: Config,
    layouts: Mapping[str, Layout],
    faults: Faults,
    *,
    replayed: bool,
    is_unsure: Callable[[str], bool] = lambda _text: False,
) -> Any:
    """Return the scene of ``[web]`` for the web page, as JSON values; None if the configuration has none.

    Args:
        config: The checked configuration.
        layouts: The layout of each source, by source name.
        faults: The faults of the configuration, to which those of the scene are added.
        replayed: Whether a recording replaces the sources. The recording need not have all registers:
            a body whose register is missing stands still.
        is_unsure: Returns whether a text may name a source whose registers are unknown; it is then not checked.

    """
    if config.web is None or config.web.scene is None:
        return None
    try:
        scene, own = examine_scene(Path(config.web.scene))
    except ConfigError as error:
        faults.add(f"web.scene: {error}")
        return None
    if not own:
        drawn = _drawn_all(scene, layouts, own, is_unsure, replayed=replayed)
    faults.include(own)
    if own:
        return None
    return {
        "bodies": drawn,
        "floor": msgspec.to_builtins(scene.floor),
        "camera": msgspec.to_builtins(scene.camera),
    }


def _drawn_all(
    scene: Scene, layouts: Mapping[str, Layout], faults: Faults, is_unsure: Callable[[str], bool], *, replayed: bool
) -> list[dict[str, Any]]:
    """Return all bodies as the page draws them, parents first; ``parent`` is the parent's index, or -1."""
    placed = _expanded(scene, faults)
    ordered = [] if faults else _ordered(placed, faults)
    indices = {one.name: index for index, one in enumerate(ordered)}
    drawn = [
        _drawn(one, layouts, faults, is_unsure, replayed=replayed)
        | {"parent": -1 if one.parent is None else indices[one.parent]}
        for one in ordered
    ]
    registers = {body["joint"]["register"] for body in drawn if body["joint"]}
    if len(registers) > MAX_REGISTERS:
        faults.add(f"body: {len(registers)} registers move bodies, but at most {MAX_REGISTERS} may")
    return drawn


def _expanded(scene: Scene, faults: Faults) -> list[_Placed]:
    """Return the bodies of the file, and those of all copies."""
    placed = [
        _Placed(f"body[{index}]", body.name, body.parent, body, body.label) for index, body in enumerate(scene.body)
    ]
    templates = {template.name: (index, template) for index, template in enumerate(scene.template)}
    if len(templates) < len(scene.template):
        faults.add("template: two templates have the same name; rename one of them")
    for index, copy in enumerate(scene.copy):
        found = templates.get(copy.template)
        if found is None:
            faults.add(f"copy[{index}].template: {unknown('template', copy.template, templates)}")
            continue
        root = Body(name=copy.name, position_mm=copy.position_mm, rotation_deg=copy.rotation_deg)
        placed.append(_Placed(f"copy[{index}]", copy.name, copy.parent, root, copy.label))
        placed += _copied(f"copy[{index}]", copy, *found, faults)
        if len(placed) > MAX_BODIES:
            break
    if len(placed) > MAX_BODIES:
        faults.add(f"body: there are more than {MAX_BODIES} bodies, with those of copies")
    elif sum(len(one.body.shape) for one in placed) > MAX_SHAPES:
        faults.add(f"body: the bodies have more than {MAX_SHAPES} shapes, with those of copies")
    return placed


def _copied(key: str, copy: Copy, place: int, template: Template, faults: Faults) -> Iterator[_Placed]:
    for index, body in enumerate(template.body):
        try:
            own = replace(
                body,
                joint=body.joint and replace(body.joint, register=filled(body.joint.register, copy.values)),
                shape=[replace(shape, color=filled(shape.color, copy.values)) for shape in body.shape],
            )
            label = filled(body.label, copy.values)
        except KeyError as error:
            faults.add(f"{key}.values: template {template.name!r} needs a value for {{{error.args[0]}}}")
            return
        for shape in own.shape:
            if not is_color(shape.color):
                faults.add(f'{key}.values: {shape.color!r} is not a colour; write it as "#RRGGBB"')
        parent = copy.name if body.parent is None else f"{copy.name}/{body.parent}"
        yield _Placed(f"template[{place}].body[{index}]", f"{copy.name}/{body.name}", parent, own, label)


def _ordered(placed: list[_Placed], faults: Faults) -> list[_Placed]:
    """Return the bodies in an order in which each comes after its parent."""
    names: dict[str, _Placed] = {}
    for one in placed:
        first = names.setdefault(one.name, one)
        if first is not one:
            faults.add(f"{one.key}.name: {already_named(one.name, first.key)}")
    for one in placed:
        if one.parent is not None and one.parent not in names:
            faults.add(f"{one.key}.parent: {unknown('body', one.parent, names)}")
    if faults:
        return []
    done: dict[str, _Placed] = {}
    for one in placed:
        chain: dict[str, _Placed] = {}
        while one.name not in done:
            if one.name in chain:
                circle = [*list(chain)[list(chain).index(one.name) :], one.name]
                faults.add(
                    f"{one.key}.parent: the parents form a loop, in which each body hangs on the next: "
                    f"{' on '.join(circle)}"
                )
                return []
            chain[one.name] = one
            if one.parent is None:
                break
            one = names[one.parent]  # noqa: PLW2901  upwards to the root
        done |= reversed(chain.items())
    return list(done.values())


def _drawn(
    one: _Placed, layouts: Mapping[str, Layout], faults: Faults, is_unsure: Callable[[str], bool], *, replayed: bool
) -> dict[str, Any]:
    """Return a body as the page draws it."""
    body = one.body
    joint = None
    if body.joint is not None and not is_unsure(body.joint.register):
        try:
            joint = _moved(body.joint, layouts)
        except PathError as error:
            text = f"{one.key}.joint.register: {error}{_of(one)}"
            if replayed:
                faults.warn(f"{text}; {one.name} stands still")
            else:
                faults.add(text)
    return {
        "name": one.name,
        "label": one.label,
        "position_mm": body.position_mm,
        "rotation_deg": body.rotation_deg,
        "joint": joint,
        "shapes": [_shape(shape) for shape in body.shape],
    }


def _of(one: _Placed) -> str:
    return f" (in {one.name})" if one.key.startswith("template") else ""


def _shape(shape: Shape) -> dict[str, Any]:
    drawn: dict[str, Any] = msgspec.to_builtins(shape)
    return drawn


def _moved(joint: Joint, layouts: Mapping[str, Layout]) -> dict[str, Any]:
    """Return a joint as the page uses it, with the full path of its register.

    Raises:
        PathError: There is no such register, or it is not a number.

    """
    topic = parse_topic(joint.register, layouts, next(iter(layouts)) if len(layouts) == 1 else None)
    if topic.source not in layouts:
        raise PathError(f"{joint.register}: {unknown('source', topic.source, layouts)}")
    if topic.direction == "in":
        raise PathError(f"{joint.register}: an input of a source cannot be followed; leave out /in")
    register = look_up(layouts[topic.source], topic)
    path = f"{topic.source}/{register.path}"
    if register.dims:
        raise PathError(f"{path}: this is an array; name one element, such as {path}/{register.dims[0][0]}")
    if register.type not in _TYPES:
        raise PathError(f"{path}: {register.type} is not a number, so it cannot move a body")
    drawn: dict[str, Any] = msgspec.to_builtins(joint)
    return drawn | {"register": path, "unit": unit(joint)}
