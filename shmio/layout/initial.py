"""Initial values of arrays, put together from the assignments after BEGIN."""

from __future__ import annotations

import re
from bisect import bisect_left
from itertools import groupby

from shmio.layout import calendar
from shmio.layout.lists import split_array
from shmio.layout.literal import default_text
from shmio.layout.model import Register

DTL_PARTS = ("YEAR", "MONTH", "DAY", "WEEKDAY", "HOUR", "MINUTE", "SECOND", "NANOSECOND")
_DTL = "DTL#{YEAR:04}-{MONTH:02}-{DAY:02}-{HOUR:02}:{MINUTE:02}:{SECOND:02}.{NANOSECOND:09}"


class InitialTexts:
    """The initial value of one register as source text; of an array, element by element.

    An array's text is kept sparse: an array may be large and its assignments few.
    """

    def __init__(self, register: Register) -> None:
        self._register = register
        self._whole = register.initial
        self._elements: dict[int, str] = {}
        self._parts: dict[tuple[int, ...], dict[str, int]] = {}  # of the DTLs assigned member by member

    def set(self, index: tuple[int, ...], text: str) -> None:
        """Assign one element, or the whole with ``()``."""
        self._parts.pop(index, None)
        if not index:
            self._whole = text
            self._elements.clear()
            self._parts.clear()
            return
        self._elements[self._flat(index)] = text

    def set_part(self, index: tuple[int, ...], part: str, text: str) -> bool:
        """Assign one member of a DTL; return whether the text is a whole number, as all its members are."""
        digits = text.replace("_", "")
        if not digits.isdecimal() or not digits.isascii() or len(digits) > 9:
            return False
        parts = self._parts.get(index)
        if parts is None:
            current = self._elements.get(self._flat(index)) if index else self._whole
            ns = calendar.parse_moment((current or "").rpartition("#")[2]) or 0
            moment = [int(field) for field in re.findall(r"[0-9]+", calendar.format_moment(ns, 9))]
            parts = dict(zip(DTL_PARTS, [*moment[:3], 0, *moment[3:]], strict=True))
        parts[part] = int(digits)
        self.set(index, _DTL.format(**parts))
        self._parts[index] = parts
        return True

    def _flat(self, index: tuple[int, ...]) -> int:
        flat = 0
        for i, (low, high) in zip(index, self._register.dims, strict=True):
            flat = flat * (high - low + 1) + i - low
        return flat

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
