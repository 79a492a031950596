"""Types of the C extension; see _numbers.c."""

from collections.abc import Sequence
from typing import Any, Protocol, final

import numpy as np
from typing_extensions import Buffer

Image = Buffer | np.ndarray[Any, Any]

class Decoder(Protocol):
    def decode(self, data: bytes, /) -> object: ...

@final
class Number:
    def __init__(self, code: str, offset: int, bit: int = 0, /) -> None: ...
    def decode(self, data: Buffer, /) -> bool | float: ...

def uniform(key: int, run: int, place: int, purpose: int, /) -> float: ...

Change = tuple[Number, int, float, int, int, int]
"""Number, kind (see operations.py), amount; for random kinds the key, the run, and the first cycle of the run."""

def change_all(image: Image, changes: tuple[Change, ...], cycle: int, /) -> None: ...
def evaluate(
    codes: bytes,
    operands: tuple[bool | float, ...],
    values: Sequence[bool | float | None],
    seen: dict[int, bool | int | float],
    /,
) -> bool | None: ...

Steps = tuple[bytes, tuple[bool | int | float, ...], tuple[tuple[str, Decoder], ...], dict[int, bool | int | float]]
"""The codes, operands and reads of a condition, and the last arguments of its edge functions."""

def evaluate_all(conditions: tuple[Steps | None, ...], images: dict[str, bytes | None], /) -> list[bool]: ...
