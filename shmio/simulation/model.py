"""The base class of models: a class that declares its registers and computes them step by step."""

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
    """Base class of all models. ``ModelRunner`` creates, seeds and steps them.

    Do not override ``__init__``. What a model computes must depend only on its inputs, its
    parameters, its time and ``random``: no clock, no other source of randomness, no thread. Then
    the same steps with the same inputs and seed give the same bytes.
    """

    declarations: ClassVar[Mapping[str, Declaration]] = {}
    """All declarations of this class and its bases, by attribute."""

    random: np.random.Generator
    """The only source of randomness, seeded with the source's seed."""

    def __init_subclass__(cls, **keywords: Any) -> None:
        """Check the declarations; ModelError names the class and what is wrong with them."""
        super().__init_subclass__(**keywords)
        if "__init__" in cls.__dict__:
            raise ModelError(f"model {cls.__qualname__}: a model has no __init__ of its own; prepare it in start()")
        found = {name: value for base in reversed(cls.__mro__) for name, value in vars(base).items()}
        cls.declarations = {name: value for name, value in found.items() if isinstance(value, Declaration)}
        for name in cls.declarations:
            if name in _OWN or name.startswith("_"):
                raise ModelError(f"model {cls.__qualname__}: {name}: choose another name, and give it this one as path")
        for kinds in ((Input, Output, InOut), (Parameter,)):
            place_declarations(cls.__qualname__, declared(cls, *kinds))

    @final
    def __init__(self, ports: Mapping[str, Port], ends: Mapping[str, Ends], seed: int) -> None:
        """Create the model. ``ModelRunner`` calls this.

        Args:
            ports: Inputs, outputs and parameters, by attribute.
            ends: In-out registers, by attribute.
            seed: The seed of ``random``.

        """
        self._ports = ports
        self._ends = ends
        self.random = np.random.default_rng(seed)

    def start(self) -> None:  # noqa: B027  not every model has something to prepare
        """Prepare the model. Called once before the first step; all declared values are available.

        In a restarted process the registers have the values that the previous one published last.
        """

    @abstractmethod
    def step(self, time_s: float, dt_s: float) -> None:
        """Compute the outputs of one step.

        Args:
            time_s: The simulation time at the end of the step, in s.
            dt_s: The length of the step, in s.

        """


def declared(model: type[Model], *kinds: type[Declaration]) -> list[Declaration]:
    """Return the model's declarations of these kinds, in the order of declaration."""
    return [declaration for declaration in model.declarations.values() if isinstance(declaration, kinds)]


@lru_cache(maxsize=256)
def layout_of(model: type[Model]) -> Layout:
    """Return the layout of the registers that a model declares, placed like those of a tag table.

    Args:
        model: The model's class.

    Raises:
        ModelError: The model declares no register.

    """
    registers = declared(model, Input, Output, InOut)
    if not registers:
        raise ModelError(
            f"model {model.__qualname__}: it declares no register; give it an Input, an Output or an InOut"
        )
    return place_declarations(model.__qualname__, registers)
