"""Random traces of three numbers, as frames of a source and as what rtamt reads."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt

from shmio.config import Expectation
from shmio.judging.judge import Golden, Judge
from shmio.judging.pieces import FAR_NS, Piece
from shmio.judging.source import Frames
from shmio.layout.model import Layout, Register

PERIOD_NS = 1_000_000_000
NAMES = ("x", "y", "z")
LAYOUT = Layout(
    "DB1", 1, 28, False,
    (
        *(Register(name, "LREAL", (), 8 * index, None, 8, 1) for index, name in enumerate(NAMES)),
        Register("on", "BOOL", (), 24, 0, 1, 1),
        Register("n", "INT", (), 26, None, 2, 1),
    ),
)  # fmt: skip
STALE_NS = 10 * PERIOD_NS


def image(values: Sequence[float], *, on: bool = False, n: int = 0) -> bytes:
    """Return an image of the layout."""
    return np.array(values, ">f8").tobytes() + bytes([on, 0]) + n.to_bytes(2, "big", signed=True)


def frames(values: npt.NDArray[np.float64], *, begin: int = 0, time: Sequence[int] | None = None) -> Frames:
    """Return frames with the values of x, y, z, of shape (n, 3)."""
    count = len(values)
    images = np.frombuffer(b"".join(image(row) for row in values.tolist()), np.uint8).reshape(count, LAYOUT.size)
    clock_ns = np.arange(begin, begin + count) * PERIOD_NS if time is None else np.array(time)
    return Frames(
        np.arange(begin + 1, begin + count + 1).astype(np.uint64),
        clock_ns,
        np.full(count, 2, np.uint8),
        np.zeros(count, np.uint32),
        images,
    )


def judge(*expectations: Expectation, golden: Golden | None = None) -> Judge:
    """Return a judge of the source ``cell``."""
    return Judge(expectations, {"cell": LAYOUT}, {"cell": STALE_NS}, golden)


def golden(*values: float) -> Golden:
    """Return a reader of a recording in which each signal has one of these values each second."""
    time = np.append(np.arange(len(values)) * PERIOD_NS, (len(values) - 1) * PERIOD_NS + 1)
    numbers = np.array([*values, np.nan])
    return lambda _file, signals: [Piece(time, numbers, numbers, FAR_NS)] * len(signals)


def some(whole: Frames, part: slice | npt.NDArray[np.int64]) -> Frames:
    """Return a part of frames."""
    raws = None if whole.raws is None else whole.raws[part]
    number, clock_ns, quality, delay_us, images, _ = whole
    return Frames(number[part], clock_ns[part], quality[part], delay_us[part], images[part], raws)


def portions(count: int, random: np.random.Generator, most: int) -> Iterator[slice]:
    """Cut n frames into random portions."""
    at = 0
    while at < count:
        size = int(random.integers(1, most + 1))
        yield slice(at, at + size)
        at += size
