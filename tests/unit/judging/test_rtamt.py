"""Robustness is that of rtamt, an independent monitor, for random formulas on random traces."""

from __future__ import annotations

import warnings

import numpy as np
import numpy.typing as npt
import pytest

from shmio.injection.language import parse_formula
from shmio.judging.formula import Network, Registers, horizon_ns, signals
from shmio.judging.operators import Node
from shmio.judging.source import Source
from tests.unit.judging.traces import LAYOUT, NAMES, PERIOD_NS, STALE_NS, frames, portions, some

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    rtamt = pytest.importorskip("rtamt", reason="there is no rtamt for this Python")

SAMPLES = 60


def predicate(random: np.random.Generator) -> str:
    left, right = random.choice(NAMES, 2)
    return str(
        random.choice(
            [
                f"({left} >= {int(random.integers(-5, 6))})",
                f"({left} < {int(random.integers(-5, 6))})",
                f"({left} > {right})",
                f"({left} + 2 * {right} <= 3)",
                f"(abs({left} - {right}) <= 4)",
                f"({left} == {right})",
            ]
        )
    )


def formula(random: np.random.Generator, depth: int) -> str:
    if depth == 0 or random.random() < 0.1:
        return predicate(random)
    low = int(random.integers(0, 4))
    bounds = f"[{low},{low + int(random.integers(0, 6))}]"
    inner, other = formula(random, depth - 1), formula(random, depth - 1)
    return str(
        random.choice(
            [
                f"(not {inner})",
                f"({inner} and {other})",
                f"({inner} or {other})",
                f"({inner} implies {other})",
                f"(always{bounds}{inner})",
                f"(eventually{bounds}{inner})",
                f"(once{bounds}{inner})",
                f"(historically{bounds}{inner})",
                f"({inner} until{bounds} {other})",
                f"(once {inner})",
                f"(historically {inner})",
            ]
        )
    )


def with_edge(random: np.random.Generator, inner: str) -> str:
    """Return a formula about events, which are true at a sample but not between samples."""
    edge = f"{random.choice(['rise', 'fall'])}{predicate(random)}"
    return str(
        random.choice(
            [
                f"always[0,5]({edge} implies {inner})",
                f"historically[1,4]({edge} implies {inner})",
                f"eventually[2,6]({edge} and {inner})",
                f"once[0,9]({edge} and {inner})",
                f"{edge}",
            ]
        )
    )


def with_rtamt(text: str, values: npt.NDArray[np.float64]) -> list[float]:
    spec = rtamt.StlDiscreteTimeSpecification()
    for name in NAMES:
        spec.declare_var(name, "float")
    spec.spec = text
    spec.parse()
    data = {"time": list(range(SAMPLES)), **{name: values[:, i].tolist() for i, name in enumerate(NAMES)}}
    return [value for _, value in spec.evaluate(data)]


def with_shmio(text: str, values: npt.NDArray[np.float64], random: np.random.Generator, most: int) -> list[float]:
    """Return the truth at each sample that is known, of frames that come in random portions."""
    tree = parse_formula(text)
    registers = Registers({"cell": LAYOUT})
    source = Source("cell", tuple(signals(tree, registers)))
    inputs: dict[object, Node] = dict(zip(source.signals, source.inputs, strict=True))
    network = Network(registers, inputs.__getitem__)
    node = network.truth(tree)
    source.follow(LAYOUT, {name: LAYOUT.registers[i] for i, name in enumerate(NAMES)}, STALE_NS)
    whole = frames(values)
    found: dict[int, tuple[float, float]] = {}
    end_ns = SAMPLES * PERIOD_NS
    for part in [*portions(SAMPLES, random, most), None]:
        if part is not None:
            source.add(some(whole, part))
        source.turn(0, end_ns if part is None else None)
        network.turn()
        assert (node.out.low <= node.out.high).all()
        found.update(zip(node.out.time.tolist(), zip(node.out.low, node.out.high, strict=True), strict=True))
    times = sorted(found)
    truth = []
    for sample in range(SAMPLES - horizon_ns(tree) // PERIOD_NS):
        low, high = found[max(time for time in times if time <= sample * PERIOD_NS)]
        assert low == high
        truth.append(float(low))
    return truth


@pytest.mark.parametrize("seed", range(100))
def test_robustness_is_that_of_rtamt(seed: int) -> None:
    random = np.random.default_rng(seed)
    text = formula(random, 1 + seed % 4)
    if seed % 5 == 0:
        text = with_edge(random, text)
    values = np.round(random.normal(0, 4, (SAMPLES, 3)), 1 if seed % 2 else 0)
    theirs = with_rtamt(text, values)
    for most in (1, 7, SAMPLES):
        ours = with_shmio(text, values, random, most)
        assert ours
        np.testing.assert_allclose(ours, theirs[: len(ours)], rtol=0, atol=1e-12, err_msg=text)
