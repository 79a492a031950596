"""Ask simulation models what they declare, and check their connections."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Mapping
from typing import Final

import msgspec

from shmio.connectors.models.simulation import Answer, Request, Simulation
from shmio.errors import ConfigError, PathError, ShmioError, ValueRangeError
from shmio.layout.document import load_layout
from shmio.layout.image import initial_frame
from shmio.layout.model import Layout
from shmio.layout.topic import find, parse_topic, shorten
from shmio.layout.values.codec import codec

PATIENCE_S: Final = 60.0


def describe(key: str, options: Simulation.Options, layout: Layout | None) -> tuple[Layout, tuple[str, ...]]:
    """Return the layout of a model's block, and the inputs that can be connected.

    A separate process imports the model.

    Raises:
        ConfigError: The model cannot be imported or described; the message begins with ``key``.

    """
    request = Request(options, None if layout is None else layout.to_json().decode())
    command = [sys.executable, "-m", "shmio.connectors.models.simulation"]
    try:
        done = subprocess.run(
            command, input=msgspec.json.encode(request), capture_output=True, timeout=PATIENCE_S, check=False
        )
    except subprocess.TimeoutExpired:
        raise ConfigError(f"{key}.model: importing {options.model} takes more than {PATIENCE_S:g} s") from None
    try:
        answer = msgspec.json.decode(done.stdout, type=Answer)
    except msgspec.MsgspecError:
        last = done.stderr.decode(errors="replace").strip().rpartition("\n")[2]
        raise ConfigError(
            f"{key}.model: the process that imports {options.model} ended with status {done.returncode}: {last}"
        ) from None
    if answer.error:
        raise ConfigError(f"{key}.{answer.error}")
    return load_layout(answer.layout.encode()), answer.inputs


def check_connections(
    key: str,
    source: str,
    connections: Mapping[str, str],
    inputs: tuple[str, ...],
    layouts: Mapping[str, Layout],
) -> None:
    """Raise ConfigError unless each connection goes from a source's register to a fitting input."""
    for path, topic in connections.items():
        try:
            _check_connection(source, path, topic, inputs, layouts)
        except ShmioError as error:
            raise ConfigError(f"{key}.connections.{path}: {error}") from None


def _check_connection(
    source: str, path: str, text: str, inputs: tuple[str, ...], layouts: Mapping[str, Layout]
) -> None:
    if path not in inputs:
        raise PathError(f"the model has no such input; there are: {shorten(', '.join(inputs), 400) or 'none'}")
    topic = parse_topic(text, layouts, source)
    if topic.source not in layouts:
        raise PathError(f"{text}: no source {topic.source!r}; there are: {', '.join(layouts)}")
    if topic.direction == "in":
        raise PathError(f"{text}: an input reads an output of a source; leave out /in")
    register, own = find(layouts[topic.source], topic.path), find(layouts[source], path)
    value = codec(register).decode(bytes(layouts[topic.source].size))
    try:
        codec(own).encode_into(value, initial_frame(layouts[source])[0])
    except ValueRangeError:
        kinds = [f"{kind.type}{'[]' * len(kind.dims)}" for kind in (own, register)]
        raise ValueRangeError(f"{text} is {kinds[1]}, which does not fit an input of {kinds[0]}") from None
