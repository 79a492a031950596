"""The state of models in snapshots: it comes back as it was, runs no code, and names what it cannot hold."""

from __future__ import annotations

import random
from collections import deque
from contextlib import suppress
from dataclasses import dataclass, field
from enum import Enum, IntFlag
from typing import Any, NamedTuple

import msgspec
import numpy as np
import pytest

from shmio.errors import ModelError, SnapshotError
from shmio.plc import R_TRIG, TON, Program
from shmio.simulation import Input, Model, ModelRunner, Output
from shmio.simulation.state import decode_state, encode_state

HERE = {__name__}


class Phase(Enum):
    IDLE = "idle"
    RUN = "run"


class Flags(IntFlag):
    A = 1
    B = 2


class Point(NamedTuple):
    x: float
    y: float


@dataclass(slots=True)
class Part:
    number: int
    at: Point


@dataclass
class Belt:
    parts: list[Part] = field(default_factory=list)
    owner: Any = None


def again(value: object, model: object = None) -> Any:
    return decode_state(encode_state(value, model, HERE), model, HERE)


@pytest.mark.parametrize(
    "value",
    [
        None, True, -5, 1 << 200, -(1 << 63), 0.1, float("inf"), "é", b"\0", (1, (2.0, "x")), [1, [2]], {"a": {1: 2}},
        {(1, 2): {3}}, frozenset({4}), bytearray(b"xy"), deque([1, 2], 5), Phase.RUN, Point(1.0, 2.0),
        [Part(1, Point(0.0, 1.0))],
    ],
)  # fmt: skip
def test_a_value_comes_back_with_its_type(value: Any) -> None:
    found = again(value)
    assert found == value
    assert type(found) is type(value)


def test_arrays_scalars_and_generators_come_back_exactly() -> None:
    for array in (np.arange(6.0).reshape(2, 3), np.asfortranarray(np.ones((2, 3))), np.zeros((0, 2), np.int8),
                  np.array(["a", "bc"]), np.array([np.nan, -0.0], "<f4")):  # fmt: skip
        found = again(array)
        assert found.tobytes() == array.tobytes()
        assert (found.dtype, found.shape, found.flags.f_contiguous) == (
            array.dtype, array.shape, array.flags.f_contiguous,
        )  # fmt: skip
        assert found.flags.writeable
    assert type(again(np.float32(0.1))) is np.float32
    for kind in (np.random.PCG64, np.random.MT19937, np.random.Philox):
        generator = np.random.Generator(kind(3))
        generator.random(5)
        other = again(generator)
        assert (generator.normal(size=9) == other.normal(size=9)).all()
    python = random.Random(1)
    copy = again(python)
    assert python.random() == copy.random()


def test_what_was_one_object_stays_one_object() -> None:
    belt = Belt([Part(1, Point(0.0, 0.0))])
    belt.owner = [belt, belt.parts]
    found = again({"belt": belt, "first": belt.parts[0]})
    assert found["belt"].owner[0] is found["belt"]
    assert found["belt"].owner[1] is found["belt"].parts
    assert found["first"] is found["belt"].parts[0]


@pytest.mark.parametrize(
    ("value", "names"),
    [
        ({"lock": object()}, "lock"),
        ({"a": {"b": [lambda: 1]}}, r"a\.b\[0\]"),
        ({"file": open}, "file"),
        ({"flags": Flags.A | Flags.B}, "flags"),
        ({"odd": np.array([{}], object)}, "odd"),
        ({"kind": int}, "kind"),
    ],
)
def test_what_cannot_be_saved_is_named_with_the_remedy(value: object, names: str) -> None:
    with pytest.raises(SnapshotError, match=f"{names}.*save_state"):
        encode_state(value, None, HERE)


def test_arrays_that_share_memory_are_refused() -> None:
    whole = np.zeros(4)
    with pytest.raises(SnapshotError, match=r"whole and .*part share memory"):
        encode_state({"whole": whole, "part": whole[:2]}, None, HERE)
    with pytest.raises(SnapshotError, match="share memory"):
        encode_state({"a": {"b": whole}, "a.b": whole[:2]}, None, HERE)
    memory = bytearray(16)
    one, other = np.frombuffer(memory, "<f8"), np.frombuffer(memoryview(memory), np.uint8)
    for owners in ((one, other), (one, memory), (memory, other)):
        with pytest.raises(SnapshotError, match="share memory"):
            encode_state(list(owners), None, HERE)
    constant = bytes(16)
    assert encode_state([np.frombuffer(constant), np.frombuffer(constant), constant], None, HERE)


@pytest.mark.parametrize(
    "node",
    [
        ["object", "subprocess", "Popen", []],
        ["object", "os", "system", []],
        ["object", __name__, "Phase", []],
        ["object", __name__, "sys.modules", []],
        ["enum", __name__, "Part", "number"],
        ["named", __name__, "Point", [1]],
        ["same", 7],
        ["generator", "SeedSequence", []],
        ["array", "|O", [1], "C", b"12345678"],
        ["array", "<f8", [1 << 62, 4], "C", b""],
        ["array", "<f8", [-1], "C", b""],
        ["nothing"],
        [],
        {"a": 1},
        ["list", [[]]],
        ["int", 5],
        ["dict", [[["list", []], 1]]],
    ],
)
def test_hostile_data_are_refused(node: object) -> None:
    with pytest.raises(SnapshotError):
        decode_state(msgspec.msgpack.encode(node), None, HERE)


def test_deep_data_are_refused() -> None:
    with pytest.raises(SnapshotError):
        decode_state(b"\x92\xa5tuple\x91" * 5000 + b"\xc0", None, HERE)
    value: list[Any] = []
    value.append(value)
    assert again(value)[0] is not None
    for _ in range(200):
        value = [value]
    with pytest.raises(SnapshotError, match="deeper"):
        encode_state(value, None, HERE)


def test_damaged_data_raise_only_snapshot_errors() -> None:
    good = encode_state({"a": [1.5, (2, "x")], "b": Belt([Part(1, Point(0.0, 0.0))])}, None, HERE)
    for place in range(len(good)):
        for bits in (0x01, 0x80, 0xFF):
            bad = bytearray(good)
            bad[place] ^= bits
            with suppress(SnapshotError):
                decode_state(bytes(bad), None, HERE)


# -- models ------------------------------------------------------------------------------------------------------------


class Walk(Model):
    up = Input("LREAL", 1.0)
    at = Output("LREAL")

    def start(self) -> None:
        self.belt = Belt(owner=self)
        self.phase = Phase.IDLE

    def step(self, time_s: float, dt_s: float) -> None:
        self.belt.parts.append(Part(len(self.belt.parts), Point(time_s, self.random.normal())))
        self.phase = Phase.RUN
        self.at += self.up * self.belt.parts[-1].at.y


class Door(Program):
    closed = Input("BOOL", True)
    locked = Output("BOOL")
    count = Output("DINT")
    settled = TON(0.03)
    edge = R_TRIG()

    def start(self) -> None:
        self.more = [TON(0.05).of(self)]

    def scan(self, time_s: float, dt_s: float) -> None:
        self.locked = self.settled(self.closed)
        self.count += self.edge(self.more[0](self.closed))


def steps(runner: ModelRunner, first: int, last: int) -> list[bytes]:
    return [runner.step(number * 10_000_000, 10_000_000) for number in range(first, last)]


@pytest.mark.parametrize("model", [Walk, Door])
def test_another_runner_continues_with_the_same_bytes(model: type[Model]) -> None:
    runner = ModelRunner(model, seed=5)
    steps(runner, 1, 5)
    saved = runner.save()
    rest = steps(runner, 5, 20)
    assert len(set(rest)) > 1
    for other in (ModelRunner(model, seed=9), runner):
        other.prepare_restore(saved)()
        assert steps(other, 5, 20) == rest


class Hooked(Model):
    shown = Output("LREAL")

    def start(self) -> None:
        self.level = 0.0
        self.handle = object()

    def step(self, time_s: float, dt_s: float) -> None:
        self.level += 1
        self.shown = self.level

    def save_state(self) -> object:
        return self.level

    def restore_state(self, state: Any) -> None:
        self.level = float(state)


class Stuck(Hooked):
    save_state = Model.save_state


class Failing(Hooked):
    def restore_state(self, state: Any) -> None:
        raise ZeroDivisionError("no")


def test_a_model_may_save_and_restore_its_state_itself() -> None:
    runner = ModelRunner(Hooked)
    steps(runner, 1, 4)
    saved = runner.save()
    other = ModelRunner(Hooked)
    other.prepare_restore(saved)()
    assert steps(other, 4, 6) == steps(runner, 4, 6)
    with pytest.raises(SnapshotError, match=r"Stuck.*handle.*object"):
        ModelRunner(Stuck).save()
    failing = ModelRunner(Failing)
    with pytest.raises(ModelError, match=r"ZeroDivisionError.*test_state.py, line"):
        failing.prepare_restore(failing.save())()


def test_the_state_of_another_model_or_version_is_refused() -> None:
    saved = ModelRunner(Walk).save()
    with pytest.raises(SnapshotError, match="Walk"):
        ModelRunner(Door).prepare_restore(saved)
    parts = msgspec.msgpack.decode(saved)
    parts[1] = "0" * 64
    with pytest.raises(SnapshotError, match="code has changed"):
        ModelRunner(Walk).prepare_restore(msgspec.msgpack.encode(parts))
    with pytest.raises(SnapshotError, match="damaged"):
        ModelRunner(Walk).prepare_restore(saved[:-3])
