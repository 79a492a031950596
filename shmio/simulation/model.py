"""What a model is: a class that says what it reads and computes, and how."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from functools import lru_cache
from typing import Any, ClassVar, Final, final

import numpy as np

from shmio.errors import ModelError
from shmio.layout.model import Layout
from shmio.simulation.declarations import Declaration, InOut, Input, Output, Parameter, place_declarations
from shmio.simulation.ports import Ends, Port

_OWN: Final = frozenset({"declarations", "random", "start", "step"})


class Model(ABC):
    """Base of all models. A ``ModelRunner`` makes, seeds and steps it; its ``__init__`` is not to be overridden.

    Whatever it computes must follow from its inputs, its parameters, its time and ``random`` alone: no clock, no other
    source of chance, no thread. Then the same steps with the same inputs and seed give the same bytes.
    """

    declarations: ClassVar[Mapping[str, Declaration]] = {}
    """All that this class and those above it declare, by attribute."""

    random: np.random.Generator
    """The only source of chance, from the source's seed."""

    def __init_subclass__(cls, **keywords: Any) -> None:
        """Check the declarations; ModelError names the class and what is wrong with them."""
        super().__init_subclass__(**keywords)
        if "__init__" in cls.__dict__:
            raise ModelError(f"model {cls.__qualname__}: a model has no __init__ of its own; prepare it in start()")
        found = {name: value for base in reversed(cls.__mro__) for name, value in vars(base).items()}
        cls.declarations = {name: value for name, value in found.items() if isinstance(value, Declaration)}
        for name in cls.declarations:
            if name in _OWN or name.startswith("_"):
                raise ModelError(f"model {cls.__qualname__}: {name}: call it otherwise, and give it this name as path")
        for kinds in ((Input, Output, InOut), (Parameter,)):
            place_declarations(cls.__qualname__, declared(cls, *kinds))

    @final
    def __init__(self, ports: Mapping[str, Port], ends: Mapping[str, Ends], seed: int) -> None:
        """``ports``: of inputs, outputs and parameters, by attribute; ``ends``: of in-out registers."""
        self._ports = ports
        self._ends = ends
        self.random = np.random.default_rng(seed)

    def start(self) -> None:  # noqa: B027  not every model has something to prepare
        """Prepare; called once, before the first step, with all declared values at hand.

        In a process that takes the place of another, registers are as that one showed them last.
        """

    @abstractmethod
    def step(self, time_s: float, dt_s: float) -> None:
        """Compute what is shown at ``time_s``, the time of simulation at the end of a step of ``dt_s``."""


def declared(model: type[Model], *kinds: type[Declaration]) -> list[Declaration]:
    """What a model declares of these kinds, in the order in which it does."""
    return [declaration for declaration in model.declarations.values() if isinstance(declaration, kinds)]


@lru_cache(maxsize=256)
def layout_of(model: type[Model]) -> Layout:
    """The layout of the registers that a model declares, placed as those of a tag table; ModelError: it has none."""
    registers = declared(model, Input, Output, InOut)
    if not registers:
        raise ModelError(
            f"model {model.__qualname__}: it declares no register; give it an Input, an Output or an InOut"
        )
    return place_declarations(model.__qualname__, registers)
