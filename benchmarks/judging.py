"""The CPU time to judge one frame of DB201, for ten expectations and by the number of frames that come at once.

The last lines are one formula with a window of 100 samples, in shmio and in rtamt's monitor, which gets one sample at
a time and is not given any image to decode.
"""

from __future__ import annotations

import statistics
import time
import warnings
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
from common import begin, db201, interleave, table

from shmio.config import Expectation
from shmio.judging.judge import Judge
from shmio.judging.source import Frames
from shmio.layout.values.codec import codec

try:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import rtamt
except ImportError:  # it comes with the extra `test`
    rtamt = None

LAYOUT = db201()
PERIOD_NS = 20_000_000
COUNT = 1024
"""Number of different frames; then they come again, later."""
TEN: tuple[dict[str, Any], ...] = (
    {"formula": "always[0, 10000] eventually[0, 1] cell/Outputs/0.%X0"},
    {"formula": "always(rise(cell/Inputs/1 > 100) implies always[0, 2] cell/Inputs/0 < 300)"},
    {"formula": "always(cell/Robot_800/Axs1_Pos > 90 implies once[0, 5] cell/Outputs/0.%X0)"},
    {"when": "cell/Inputs/2 > 200", "within_s": 2, "then": "cell/Inputs/3 < 50"},
    {"stays": "cell/Inputs/4 < 128", "for_s": 0.02},
    {"never": "cell/Outputs/13.%X0 and abs(rate(cell/Robot_800/Axs1_Pos)) > 1e9"},
    {"always": "cell/Robot_825/Axs1_Pos - cell/Robot_850/Axs1_Pos < 1e9"},
    {"always": "quality(cell/Inputs/0) = good and age(cell/Inputs/0) < 0.1"},
    {"signal": "cell/Robot_800/Axs2_Pos", "max_rate": 1e9},
    {"signal": "raw(cell/Robot_800/Axs3_Pos)", "max_rate": 1e9},
)
FORMULA = "always[0, 100000] eventually[0, 2] cell/Robot_800/Axs1_Pos > 0"


def frames() -> list[Frames]:
    """Return frames whose registers change randomly, one by one."""
    random = np.random.default_rng(1)
    images = np.zeros((COUNT, LAYOUT.size), np.uint8)
    for register in LAYOUT.registers:
        if register.type == "REAL":
            for image, value in zip(images, random.normal(0, 100, COUNT), strict=True):
                data = bytearray(LAYOUT.size)
                codec(register, LAYOUT.byte_order).encode_into(float(value), data)
                np.bitwise_or(image, np.frombuffer(bytes(data), np.uint8), out=image)
    inputs = next(register for register in LAYOUT.registers if register.path == "Inputs")
    outputs = next(register for register in LAYOUT.registers if register.path == "Outputs")
    for register in (inputs, outputs):
        images[:, register.offset : register.offset + 16] = random.integers(0, 256, (COUNT, 16))
    number = np.arange(1, COUNT + 1).astype(np.uint64)
    whole = Frames(
        number, number.astype(np.int64) * PERIOD_NS, np.full(COUNT, 2, np.uint8), np.zeros(COUNT, np.uint32), images,
        images,
    )  # fmt: skip
    return [whole]


def judging(expectations: tuple[dict[str, Any], ...], portion: int) -> Callable[[], float]:
    """Make a sampler of the CPU time in ns to judge a frame, of ``COUNT`` frames in portions."""
    declared = [msgspec.convert({"name": f"e{at}", **keys}, Expectation) for at, keys in enumerate(expectations)]
    judge = Judge(declared, {"cell": LAYOUT}, {"cell": 10**9})
    (whole,) = frames()
    round_ = 0

    def sample() -> float:
        nonlocal round_
        begun_ns = time.thread_time_ns()
        for at in range(0, COUNT, portion):
            part = slice(at, at + portion)
            judge.add(
                "cell",
                Frames(
                    whole.number[part] + np.uint64(round_ * COUNT), whole.clock_ns[part] + round_ * COUNT * PERIOD_NS,
                    whole.quality[part], whole.delay_us[part], whole.images[part], whole.images[part],
                ),
            )  # fmt: skip
            judge.turn()
        round_ += 1
        return (time.thread_time_ns() - begun_ns) / COUNT

    sample()
    return sample


def with_rtamt() -> Callable[[], float]:
    """Make a sampler of the CPU time in ns for one sample in rtamt's monitor."""
    spec = rtamt.StlDiscreteTimeSpecification()
    spec.declare_var("x", "float")
    spec.spec = "historically(once[0, 100](x > 0))"  # looking back: it gives a result at once
    spec.parse()
    values = np.random.default_rng(1).normal(0, 100, COUNT).tolist()
    at = 0

    def sample() -> float:
        nonlocal at
        begun_ns = time.thread_time_ns()
        for value in values:
            spec.update(at, [("x", value)])
            at += 1
        return (time.thread_time_ns() - begun_ns) / COUNT

    return sample


def main() -> None:
    quick = begin("CPU time to judge a frame, µs")
    portions = (1, 8, 64, 512)
    contenders = {f"10 expectations, {count} frames at once": judging(TEN, count) for count in portions}
    contenders |= {f"1 formula, {count} frames at once": judging(({"formula": FORMULA},), count) for count in portions}
    if rtamt is not None:
        contenders["1 formula, rtamt"] = with_rtamt()
    samples = interleave(contenders, 2 if quick else 15)
    rows = [[name, f"{min(v) / 1000:.2f}", f"{statistics.median(v) / 1000:.2f}"] for name, v in samples.items()]
    table(["judged", "best", "median"], rows)


if __name__ == "__main__":
    main()
