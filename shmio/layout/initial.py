"""Initial values of arrays, put together from the assignments after BEGIN."""

from __future__ import annotations

from bisect import bisect_left
from itertools import groupby

from shmio.layout.literal import default_text, split_array
from shmio.layout.model import Register


class InitialTexts:
    """The initial value of one register as source text; of an array, element by element.

    An array's text is kept sparse: an array may be large and its assignments few.
    """

    def __init__(self, register: Register) -> None:
        self._register = register
        self._whole = register.initial
        self._elements: dict[int, str] = {}

    def set(self, index: tuple[int, ...], text: str) -> None:
        """Assign one element, or the whole with ``()``."""
        if not index:
            self._whole = text
            self._elements.clear()
            return
        flat = 0
        for i, (low, high) in zip(index, self._register.dims, strict=True):
            flat = flat * (high - low + 1) + i - low
        self._elements[flat] = text

    def __str__(self) -> str:
        if not self._elements:
            return self._whole or ""
        default = default_text(self._register.element)
        assigned = sorted(self._elements)
        runs: list[tuple[str, int]] = []
        position = 0
        for start, count, text in split_array(self._whole or "", self._register.shape):
            self._fill(runs, assigned, position, start, default)
            self._fill(runs, assigned, start, start + count, text)
            position = start + count
        self._fill(runs, assigned, position, self._register.count, default)
        merged = [(text, sum(n for _, n in group)) for text, group in groupby(runs, key=lambda run: run[0])]
        return f"[{', '.join(text if n == 1 else f'{n}({text})' for text, n in merged)}]"

    def _fill(self, runs: list[tuple[str, int]], assigned: list[int], start: int, stop: int, text: str) -> None:
        """Append the elements from ``start`` to ``stop``: ``text`` where nothing is assigned."""
        for flat in assigned[bisect_left(assigned, start) : bisect_left(assigned, stop)]:
            if flat > start:
                runs.append((text, flat - start))
            runs.append((self._elements[flat], 1))
            start = flat + 1
        if stop > start:
            runs.append((text, stop - start))
