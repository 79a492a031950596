"""The injections of a source in a snapshot."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Final

import msgspec
import numpy as np

from shmio.config import Declaration
from shmio.connectors.injection_layers import DeclaredLayer, DelayedWrite, Layer, Owner, declared
from shmio.errors import ConfigError, SnapshotError
from shmio.injection import Program
from shmio.injection.activation import Activation, State
from shmio.injection.operations import StoredImage
from shmio.layout.values.write import Write
from shmio.segment import Direction

_DECLARATION: Final = msgspec.json.Decoder(Declaration)


class DeclaredState(msgspec.Struct, array_like=True, forbid_unknown_fields=True):
    """The state of a declared injection. ``declaration`` is the declaration as JSON."""

    declaration: bytes
    seed: int
    state: State
    runs: int
    cycle: int
    time_ns: int
    met: bool | None
    seen: dict[int, bool | int | float]
    writes: int
    held: list[tuple[int, int, bytes, int, int]]
    images: list[tuple[int, int, int, bytes]]


class LayerState(msgspec.Struct, array_like=True, forbid_unknown_fields=True):
    """The state of an injection. ``declared`` is None if a client gives the injection's values."""

    number: int
    direction: int
    priority: int
    keep: bool
    name: str
    writer: int
    pid: int
    cover: bytes
    values: bytes
    declared: DeclaredState | None


def save_layer(layer: Layer) -> LayerState:
    """Return the state of an injection."""
    return LayerState(
        layer.id, int(layer.direction), layer.priority, layer.keep, layer.name, layer.owner.writer, layer.owner.pid,
        layer.cover.tobytes(), layer.values.tobytes(),
        _save_declared(layer) if isinstance(layer, DeclaredLayer) else None,
    )  # fmt: skip


def _save_declared(layer: DeclaredLayer) -> DeclaredState:
    now = layer.activation
    return DeclaredState(
        msgspec.json.encode(layer.program.declaration), layer.seed, now.state, now.runs, now.cycle, now.time_ns,
        now.met, layer.memory.to_save(), layer.writes, [(*one.write, one.cycle, one.time_ns) for one in layer.held],
        [(one.role, one.cycle, one.time_ns, one.image) for one in layer.operation.save()],
    )  # fmt: skip


def make_layer(saved: LayerState, size: int, compiled: Callable[[Declaration], Program]) -> Layer:
    """Create an injection from its state in a snapshot.

    Args:
        saved: The state.
        size: The size of the source's images in bytes.
        compiled: Compiles a declaration.

    Raises:
        SnapshotError: The state is damaged, or the declaration does not fit the instance.

    """
    owner = Owner(saved.writer, saved.pid)
    if saved.declared is not None:
        return _make_declared(saved, saved.declared, owner, size, compiled)
    if {len(saved.cover), len(saved.values)} != {size}:
        raise SnapshotError(f"injection {saved.name}: its state is damaged")
    try:
        direction = Direction(saved.direction)
    except ValueError:
        raise SnapshotError(f"injection {saved.name}: its state is damaged") from None
    cover, values = (np.frombuffer(data, np.uint8).copy() for data in (saved.cover, saved.values))
    return Layer(saved.number, direction, saved.priority, saved.keep, saved.name, owner, cover, values)


def _make_declared(
    saved: LayerState, state: DeclaredState, owner: Owner, size: int, compiled: Callable[[Declaration], Program]
) -> DeclaredLayer:
    try:
        program = compiled(_DECLARATION.decode(state.declaration))
    except (msgspec.MsgspecError, UnicodeDecodeError, ConfigError, RecursionError) as error:
        raise SnapshotError(f"injection {saved.name}: {error}") from None
    held = [DelayedWrite(Write(offset, mask, data), cycle, at) for offset, mask, data, cycle, at in state.held]
    wrong_write = any(not 0 <= w.offset <= w.offset + len(w.data) <= size for w, _, _ in held)
    if wrong_write or any(len(image) != size for _, _, _, image in state.images):
        raise SnapshotError(f"injection {saved.name}: its state is damaged")
    layer = declared(saved.number, program, owner, state.seed, keep=saved.keep)
    layer.activation = Activation(program.window, state.state, state.runs, state.cycle, state.time_ns, state.met)
    layer.memory.seen.update(state.seen)
    layer.writes = state.writes
    layer.held.extend(held)
    layer.operation.restore([StoredImage(*one) for one in state.images])
    return layer


def check_configured(layers: Sequence[Layer], wanted: Mapping[str, Declaration]) -> None:
    """Check that a snapshot has exactly the injections that the configuration declares.

    Raises:
        SnapshotError: The snapshot has others; the message names them.

    """
    found = {one.name: one.program.declaration for one in layers if isinstance(one, DeclaredLayer) and one.configured}
    if wrong := sorted(name for name in found.keys() | wanted.keys() if found.get(name) != wanted.get(name)):
        raise SnapshotError(f"the snapshot and the configuration declare different injections: {', '.join(wrong)}")
