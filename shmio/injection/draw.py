"""Random numbers that depend only on a seed and their purpose.

The generator has no state: it computes each number from the seed and from counters, such as the
number of the cycle. So neither an extra frame nor a restart of the process changes later numbers.
The mixing function is that of SplitMix64 (Steele, Lea, Flood: "Fast splittable pseudorandom number
generators", OOPSLA 2014).
"""

from __future__ import annotations

import hashlib
import math
from enum import IntEnum
from typing import Final

import numpy as np
import numpy.typing as npt

from shmio.injection._numbers import uniform

Words = npt.NDArray[np.uint64]
Floats = npt.NDArray[np.float64]

FEW: Final = 16
"""Up to this count of numbers, plain Python is faster than numpy.

Both compute the same numbers, except for the last bit of a Gaussian number.
"""

_MASK: Final = (1 << 64) - 1
_GOLDEN: Final = 0x9E3779B97F4A7C15
_FIRST, _SECOND = 0xBF58476D1CE4E5B9, 0x94D049BB133111EB


class Purpose(IntEnum):
    """Purpose of a random number. Each purpose has its own sequence of numbers."""

    CHANCE = 0
    VALUE = 1
    ANGLE = 2


class SeededRandom:
    """Generates the random numbers of one injection.

    In all methods, ``run`` is the number of the activation, and ``place`` is the number of the cycle
    or write within this activation. The same arguments always give the same numbers.
    """

    def __init__(self, seed: int, name: str) -> None:
        """Create the generator. For the same seed, different names give different numbers."""
        self.key = int.from_bytes(hashlib.sha256(f"{seed}/{name}".encode()).digest()[:8], "little")
        """The number that determines all random numbers: it stands for seed and name."""

    def words(self, run: int, place: int, purpose: Purpose, count: int) -> Words:
        """Return ``count`` random 64-bit integers: an array of shape (count,) and type uint64."""
        if count <= FEW:
            return np.array(self._few(run, place, purpose, count), np.uint64)
        base = self._base(run, place, purpose)
        counter = np.arange(1, count + 1, dtype=np.uint64)
        return _mix_all(counter * np.uint64(_GOLDEN) + np.full(count, base, np.uint64))

    def uniform(self, run: int, place: int, count: int, purpose: Purpose = Purpose.VALUE) -> Floats:
        """Return ``count`` random numbers x with 0 <= x < 1."""
        if count <= FEW:
            return np.array([(word >> 11) * 2.0**-53 for word in self._few(run, place, purpose, count)])
        return (self.words(run, place, purpose, count) >> np.uint64(11)).astype(np.float64) * 2.0**-53

    def gaussian(self, run: int, place: int, count: int) -> Floats:
        """Return ``count`` normally distributed numbers with mean 0 and standard deviation 1.

        They are computed by the method of Box and Muller, 1958.
        """
        if count <= FEW:
            radii = (1 - (word >> 11) * 2.0**-53 for word in self._few(run, place, Purpose.VALUE, count))
            angles = ((word >> 11) * 2.0**-53 for word in self._few(run, place, Purpose.ANGLE, count))
            pairs = zip(radii, angles, strict=True)
            return np.array([math.sqrt(-2 * math.log(one)) * math.cos(math.tau * other) for one, other in pairs])
        radius = np.sqrt(-2 * np.log(1 - self.uniform(run, place, count)))
        angle = self.uniform(run, place, count, Purpose.ANGLE)
        normal: Floats = radius * np.cos(math.tau * angle)
        return normal

    def _base(self, run: int, place: int, purpose: Purpose) -> int:
        return _mix(_mix(_mix(self.key + run & _MASK) + place & _MASK) + purpose & _MASK)

    def _few(self, run: int, place: int, purpose: Purpose, count: int) -> list[int]:
        base = self._base(run, place, purpose)
        return [_mix_word(base + number * _GOLDEN & _MASK) for number in range(1, count + 1)]

    def below(self, limit: int, run: int, place: int, count: int) -> npt.NDArray[np.intp]:
        """Return ``count`` random integers x with 0 <= x < ``limit``, which is at most 2^32."""
        high = self.words(run, place, Purpose.VALUE, count) >> np.uint64(32)
        return (high * np.uint64(limit) >> np.uint64(32)).astype(np.intp)

    def happens(self, probability: float, run: int, place: int) -> bool:
        """Return True with the probability ``probability``, from 0 to 1, else False."""
        return probability >= 1 or uniform(self.key, run, place, Purpose.CHANCE) < probability


def _mix(word: int) -> int:
    return _mix_word(word + _GOLDEN & _MASK)


def _mix_word(word: int) -> int:
    word = (word ^ word >> 30) * _FIRST & _MASK
    word = (word ^ word >> 27) * _SECOND & _MASK
    return word ^ word >> 31


def _mix_all(words: Words) -> Words:
    words = (words ^ words >> np.uint64(30)) * np.uint64(_FIRST)
    words = (words ^ words >> np.uint64(27)) * np.uint64(_SECOND)
    mixed: Words = words ^ words >> np.uint64(31)
    return mixed
