"""Standard function blocks of IEC 61131-3: timers and edge detection.

Declare a block in the class body of a program. Each program object then has its own::

    class Door(Program):
        closed = Input("BOOL")
        locked = Output("BOOL")
        settled = TON(0.5)

        def scan(self, time_s, dt_s):
            self.locked = self.settled(self.closed)

Call each block once a scan. Timers use the program's time, which stands still while the controller is
stopped.
"""

from __future__ import annotations

import copy
import math
from typing import Protocol, Self, overload


class Clock(Protocol):
    """The clock of a program, which its function blocks read."""

    _now_ns: int


class FunctionBlock:
    """Base class of function blocks."""

    def __init__(self) -> None:
        self._clock: Clock | None = None
        self._name = ""
        self.q = False
        """The output Q, as the last call left it."""

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    @overload
    def __get__(self, program: None, owner: type) -> Self: ...
    @overload
    def __get__(self, program: Clock, owner: type) -> Self: ...
    def __get__(self, program: Clock | None, owner: type) -> Self:
        """Return the program's own block, which its first use creates."""
        if program is None:
            return self
        own = vars(program)[self._name] = self.of(program)  # from now on, it hides this object
        return own

    def of(self, program: Clock) -> Self:
        """Return a new block like this one, for ``program``.

        A program calls this for blocks that are not declared in its class body, such as a list of
        blocks that its ``start`` creates.
        """
        own = copy.copy(self)
        own._clock = program
        return own

    def _time_ns(self) -> int:
        if self._clock is None:
            name = type(self).__name__
            raise TypeError(f"{name}: declare the block in the class body, or use {name}(…).of(self)")
        return self._clock._now_ns


class _Timer(FunctionBlock):
    """Base class of timers."""

    def __init__(self, pt_s: float) -> None:
        """Declare a timer.

        Args:
            pt_s: The preset time PT, in s.

        """
        super().__init__()
        self.pt_s = pt_s
        self._in = False
        self._begun_ns: int | None = None
        self._et_ns = 0

    @property
    def pt_s(self) -> float:
        """The preset time PT, in s. If you change it while the timer runs, the new time applies at once."""
        return self._pt_ns / 1e9

    @pt_s.setter
    def pt_s(self, pt_s: float) -> None:
        if not (math.isfinite(pt_s) and pt_s >= 0):
            raise ValueError(f"{type(self).__name__}: PT must be a time of 0 s or more, not {pt_s!r}")
        self._pt_ns = round(pt_s * 1e9)

    @property
    def et_s(self) -> float:
        """The elapsed time ET, in s, at most PT."""
        return self._et_ns / 1e9

    def _elapse(self, now_ns: int) -> bool:
        """Set ET of a running timer. Return whether PT has elapsed."""
        begun_ns = now_ns if self._begun_ns is None else self._begun_ns
        self._et_ns = min(now_ns - begun_ns, self._pt_ns)
        return self._et_ns >= self._pt_ns


class TON(_Timer):
    """On-delay timer: Q becomes true once IN has been true for the time PT, and false as soon as IN is false."""

    def __call__(self, in_: object) -> bool:
        """Set IN, and return Q."""
        now_ns = self._time_ns()
        if not in_:
            self._begun_ns, self._et_ns, self.q = None, 0, False
            return self.q
        if self._begun_ns is None:
            self._begun_ns = now_ns
        self.q = self._elapse(now_ns)
        return self.q


class TOF(_Timer):
    """Off-delay timer: Q becomes true as soon as IN is true, and false once IN has been false for the time PT."""

    def __call__(self, in_: object) -> bool:
        """Set IN, and return Q."""
        now_ns = self._time_ns()
        if in_:
            self._in, self._begun_ns, self._et_ns, self.q = True, None, 0, True
            return self.q
        if self._in:
            self._in, self._begun_ns = False, now_ns
        if self._begun_ns is not None and self.q:
            self.q = not self._elapse(now_ns)
        return self.q


class TP(_Timer):
    """Pulse timer: when IN becomes true, Q is true for the time PT, whatever IN does in the meantime."""

    def __call__(self, in_: object) -> bool:
        """Set IN, and return Q."""
        now_ns = self._time_ns()
        if in_ and not self._in and self._begun_ns is None:
            self._begun_ns = now_ns
        self._in = bool(in_)
        self.q = self._begun_ns is not None and not self._elapse(now_ns)
        if self._begun_ns is not None and not self.q and not in_:
            self._begun_ns, self._et_ns = None, 0
        return self.q


class R_TRIG(FunctionBlock):  # noqa: N801  the standard's name
    """Rising edge: Q is true in a call in which CLK is true but was false in the previous call.

    As in the standard, CLK counts as false before the first call.
    """

    def __init__(self) -> None:
        super().__init__()
        self._last = False

    def __call__(self, clk: object) -> bool:
        """Set CLK, and return Q."""
        self.q, self._last = bool(clk) and not self._last, bool(clk)
        return self.q


class F_TRIG(FunctionBlock):  # noqa: N801  the standard's name
    """Falling edge: Q is true in a call in which CLK is false but was true in the previous call.

    As in the standard, CLK counts as true before the first call. So if CLK is false in the first
    call, Q is true.
    """

    def __init__(self) -> None:
        super().__init__()
        self._last = True

    def __call__(self, clk: object) -> bool:
        """Set CLK, and return Q."""
        self.q, self._last = not clk and self._last, bool(clk)
        return self.q
