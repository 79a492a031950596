"""The base class of models, and their declarations."""

from __future__ import annotations

import sys
import traceback
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from contextlib import suppress
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, ClassVar, Final, Protocol, Self, final

import numpy as np

from shmio.errors import LayoutError, ModelError, ShmioError, SnapshotError
from shmio.layout.model import NUMBERS, Layout
from shmio.layout.simlog_structures import members
from shmio.layout.tags import parse_type, place_tags
from shmio.layout.topic import canonical_path, shorten
from shmio.simulation.images import Ends, Limits, Port
from shmio.wording import printable

_OWN: Final = frozenset({"declarations", "random", "restore_state", "save_state", "start", "step"})
_NOT_STATE: Final = frozenset({"_ends", "_ports", "random"})
"""Attributes that ``ModelRunner`` saves itself, or creates."""


# -- declarations --------------------------------------------------------------------------------------------


class _DeclaringModel(Protocol):
    """The attributes of a model that its declarations use."""

    _ports: Mapping[str, Port]
    _ends: Mapping[str, Ends]


class Declaration:
    """A declaration of a model, such as a register or a parameter.

    In the model's class, the attribute is this object. In a model object, the attribute is the
    value. The value of a single register is a bool, int, float or str (see
    ``shmio.layout.values.codec``). The value of an array is a tuple, nested for several dimensions,
    or bytes for a one-dimensional array of BYTE. The value of a structure is a dict; if you set it,
    members that the dict does not name stay unchanged.
    """

    kind: ClassVar[str]
    """The kind of declaration, for messages."""

    def __init__(
        self,
        type: str | Mapping[str, str],  # noqa: A002  tag tables use this name
        initial: object = None,
        *,
        path: str = "",
        unit: str = "",
        comment: str = "",
        limits: Limits | None = None,
    ) -> None:
        """Declare a value.

        If the declaration is invalid, creating the model's class raises ModelError.

        Args:
            type: The type as in a tag table, such as ``LREAL``, ``STRING[20]``, ``SafetyZone`` or
                ``ARRAY[1..8] OF BOOL``. For a structure, a dict with the types of its members.
            initial: The initial value; for an array a flat list, for a structure a dict. Default:
                the initial value of the type.
            path: The path of the register. Default: the name of the attribute.
            unit: The unit in the layout.
            comment: The comment in the layout.
            limits: The lowest and the highest value that may be given to the model: written by a
                client, by a connection, or as a parameter. Or a dict with all allowed whole numbers
                and their names. Not for outputs.

        """
        self.type = type
        self.initial = initial
        self.path = path
        self.unit = unit
        self.comment = comment
        self.limits = limits
        self.any_text = False
        """True if the register of a text may have any length in a layout, and be a STRING or a WSTRING."""
        self.name = ""

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name
        self.path = self.path or name

    def __get__(self, model: _DeclaringModel | None, owner: type) -> Any:
        return self if model is None else model._ports[self.name].read()

    def __set__(self, model: _DeclaringModel, value: object) -> None:
        raise AttributeError(f"{self.name} is {self.kind}, which a model can only read")

    @cached_property
    def members(self) -> Mapping[str, str] | None:
        """The types of a structure's members, by path within the structure.

        None if the declaration is not a structure.
        """
        return members(self.type) if isinstance(self.type, str) else self.type

    @cached_property
    def paths(self) -> Mapping[str, str]:
        """The path of each register, by member of the structure.

        The key of a single register is ``""``.
        """
        inside = {"": ""} if self.members is None else {member: f"/{member}" for member in self.members}
        return {member: canonical_path(self.path + end) for member, end in inside.items()}

    @property
    def tags(self) -> Mapping[str, object]:
        """The entries of a tag table that declare the same registers.

        Raises:
            ValueRangeError: The type is invalid.

        """
        if not isinstance(self.type, str | Mapping):
            raise ModelError(
                f"type: expected a type such as 'LREAL', or a dict with the types of the members, found {self.type!r}; "
                "the initial value comes after it, as in Parameter('LREAL', 1.0)"
            )
        if self.limits is not None:
            self._check_limits(self.limits)
        if self.members is None:
            return {self.path: self._tag(self.type, self.initial)}
        initial = self.initial or {}
        if not isinstance(initial, Mapping) or initial.keys() - self.members.keys():
            raise ModelError(f"initial: expected a dict with some of {', '.join(self.members)}, found {initial!r}")
        return {f"{self.path}/{name}": self._tag(kind, initial.get(name)) for name, kind in self.members.items()}

    def _tag(self, kind: object, initial: object) -> Mapping[str, object]:
        comment = f"{self.comment} [{self.unit}]" if self.unit else self.comment
        initial = list(initial) if isinstance(initial, tuple) else initial
        return {"type": kind, "initial": initial, "comment": comment, "unit": self.unit}

    def _check_limits(self, limits: Limits) -> None:
        if isinstance(self, Output):
            raise ModelError("limits: an output has no limits, because the model computes it")
        with suppress(ValueError):  # an invalid type is reported when it is placed
            if self.members is not None or parse_type(str(self.type))[0].base not in NUMBERS:
                raise ModelError("limits: only a number or an array of numbers can have limits")
        if isinstance(limits, tuple) and not limits[0] <= limits[1]:
            raise ModelError(f"limits: expected the lowest and the highest value, found {limits!r}")


class Input(Declaration):
    """A register that the model reads.

    Clients write the register, or it is connected to a register of another source.
    """

    kind = "an input"


class Parameter(Declaration):
    """A constant of the model, not a register. The configuration can set the constant by its name."""

    kind = "a parameter"

    def __init__(
        self,
        type: str,  # noqa: A002
        initial: object = None,
        *,
        unit: str = "",
        comment: str = "",
        limits: Limits | None = None,
    ) -> None:
        super().__init__(type, initial, unit=unit, comment=comment, limits=limits)


class Output(Declaration):
    """A register that only the model writes.

    The register keeps its value until the model sets another value.
    """

    kind = "an output"

    def __set__(self, model: _DeclaringModel, value: object) -> None:
        model._ports[self.name].write(value)


class InOut(Declaration):
    """A register that clients write and the model computes.

    In a model object, the attribute is an :class:`Ends`, which has both values.
    """

    kind = "an in-out register"

    def __get__(self, model: _DeclaringModel | None, owner: type) -> Any:
        return self if model is None else model._ends[self.name]

    def __set__(self, model: _DeclaringModel, value: object) -> None:
        raise AttributeError(f"{self.name} is {self.kind}; set {self.name}.shown")


def place_declarations(model: str, declarations: Iterable[Declaration]) -> Layout:
    """Return a layout of the declarations, which are placed like the entries of a tag table.

    Raises:
        ModelError: A declaration is invalid. The message names the model and all errors.

    """
    tags: dict[str, object] = {}
    for declaration in declarations:
        try:
            own = declaration.tags
        except ShmioError as error:
            raise ModelError(f"model {model}: {declaration.name}: {error}") from None
        if twice := own.keys() & tags.keys():
            raise ModelError(f"model {model}: {declaration.name}: the path {min(twice)!r} is used twice")
        tags.update(own)
    try:
        return place_tags(model, tags)
    except LayoutError as error:
        problems = [diagnostic.message for diagnostic in error.diagnostics if diagnostic.severity == "error"]
        raise ModelError(f"model {model}: {'; '.join(problems)}") from None


# -- the base class ------------------------------------------------------------------------------------------


class Model(ABC):
    """Base class of all models. ``ModelRunner`` creates, seeds and steps them.

    Do not override ``__init__``. The outputs must depend only on the inputs, the parameters, the
    time and ``random``. Do not use another clock, another source of randomness, or threads. Then
    the same steps with the same inputs and seed give the same bytes.
    """

    declarations: ClassVar[Mapping[str, Declaration]] = {}
    """All declarations of this class and its base classes, by attribute name."""

    reference: ClassVar[str] = ""
    """The model's name in messages: ``package.module:Class``, or the name of the file of an FMU."""

    state_modules: ClassVar[tuple[str, ...]] = ()
    """Names of further modules whose objects the model's attributes may contain when a snapshot is saved.

    The modules of the model's class and its base classes are always allowed.
    """

    notices: ClassVar[tuple[str, ...]] = ()
    """What the user should know about the model, for ``shmio-supervisor check``."""

    random: np.random.Generator
    """The model's only source of randomness, seeded with the ``seed`` of its source."""

    def __init_subclass__(cls, **keywords: Any) -> None:
        """Check the declarations when a subclass is created.

        Raises:
            ModelError: A declaration is invalid. The message names the class.

        """
        super().__init_subclass__(**keywords)
        cls.reference = f"{cls.__module__}:{cls.__qualname__}"
        if "__init__" in cls.__dict__:
            raise ModelError(f"model {cls.__qualname__}: a model cannot have its own __init__; use start()")
        found = {name: value for base in reversed(cls.__mro__) for name, value in vars(base).items()}
        cls.declarations = {name: value for name, value in found.items() if isinstance(value, Declaration)}
        for name in cls.declarations:
            if name in _OWN or name.startswith("_"):
                raise ModelError(f"model {cls.__qualname__}: {name}: this name is reserved; rename it, and set path")
        _check(cls)

    @classmethod
    def with_declarations(
        cls, reference: str, declarations: Mapping[str, Declaration], **attributes: object
    ) -> type[Self]:
        """Create a subclass for a model whose values are not attributes, such as an FMU.

        Args:
            reference: The model's name in messages.
            declarations: Declarations by name. A name may be any text.
            attributes: Attributes of the class.

        Raises:
            ModelError: A declaration is invalid. The message names the model.

        """
        made: type[Self] = type(reference, (cls,), {"__module__": cls.__module__, **attributes})
        made.reference = reference
        made.declarations = declarations
        for name, declaration in made.declarations.items():
            declaration.__set_name__(made, name)
        _check(made)
        return made

    @classmethod
    def with_parameters(cls, parameters: Mapping[str, object]) -> tuple[type[Self], Mapping[str, object]]:
        """Return the class for the parameters of a configuration, and the parameters as it declares them.

        A class may declare other registers for other parameters. An unknown or wrong value is kept.
        """
        return cls, parameters

    @final
    def __init__(self, ports: Mapping[str, Port], ends: Mapping[str, Ends], seed: int) -> None:
        """Create the model. ``ModelRunner`` calls this.

        Args:
            ports: Inputs, outputs and parameters, by attribute name.
            ends: In-out registers, by attribute name.
            seed: The seed of ``random``.

        """
        self._ports = ports
        self._ends = ends
        self.random = np.random.default_rng(seed)

    @classmethod
    def code_files(cls) -> list[Path]:
        """Return the files that contain the model's own code.

        A snapshot is restored only if these files are the same as when it was saved.
        """
        own = (base.__module__ for base in cls.__mro__ if not base.__module__.startswith(("shmio.", "abc", "builtins")))
        files = (getattr(sys.modules.get(name), "__file__", None) for name in dict.fromkeys(own))
        return [Path(file) for file in files if file]

    def start(self) -> None:  # noqa: B027  not every model needs it
        """Prepare the model. ``ModelRunner`` calls this method once, before the first step.

        All declared values are available. In a restarted process, the registers have the values
        that the previous process published last.
        """

    @abstractmethod
    def step(self, time_s: float, dt_s: float) -> None:
        """Compute the outputs of one step.

        Args:
            time_s: The simulation time at the end of the step, in s.
            dt_s: The length of the step, in s.

        """

    def save_state(self) -> object:
        """Return the model's state for a snapshot: by default, a dict of all its attributes.

        ``ModelRunner`` saves the registers and ``random`` itself. The state may contain numbers,
        texts, bytes, lists, tuples, dicts, sets, numpy arrays, and objects of classes of the
        model's modules. Override both this method and :meth:`restore_state` if the model has
        attributes of other types.
        """
        return {name: value for name, value in vars(self).items() if name not in _NOT_STATE}

    def restore_state(self, state: Any) -> None:
        """Continue from a state that :meth:`save_state` has returned, perhaps in another process.

        ``ModelRunner`` has already called :meth:`start`, and restored the registers and ``random``.
        """
        if not isinstance(state, dict) or not all(isinstance(name, str) for name in state) or _NOT_STATE & state.keys():
            raise SnapshotError("the state is not that of a model with the default save_state()")
        own = vars(self)
        for name in own.keys() - _NOT_STATE:
            del own[name]
        own.update(state)

    def _close(self) -> None:  # noqa: B027  the garbage collector suffices for most models
        """Release what :meth:`start` has acquired. ``ModelRunner`` calls this after the last step."""


def _check(model: type[Model]) -> None:
    """Check all declarations of a model.

    Raises:
        ModelError: A declaration is invalid.

    """
    for kinds in ((Input, Output, InOut), (Parameter,)):
        place_declarations(model.__qualname__, declared(model, *kinds))


def declared(model: type[Model], *kinds: type[Declaration]) -> list[Declaration]:
    """Return the model's declarations of these kinds, in the order of declaration."""
    return [declaration for declaration in model.declarations.values() if isinstance(declaration, kinds)]


@lru_cache(maxsize=256)
def layout_of(model: type[Model]) -> Layout:
    """Return a layout of a model's registers, which are placed like the entries of a tag table.

    Args:
        model: The model's class.

    Raises:
        ModelError: The model declares no register.

    """
    registers = declared(model, Input, Output, InOut)
    if not registers:
        raise ModelError(f"model {model.__qualname__} declares no register; give it an Input, an Output or an InOut")
    return place_declarations(model.__qualname__, registers)


def explain(error: BaseException, module: str) -> str:
    """Return a text with the error and the place where it occurred.

    The place is the last line of the traceback in ``module``, or the last line of all if none is in
    ``module``.
    """
    if isinstance(error, SyntaxError) and error.filename:
        return _line(f"{error.msg} ({Path(error.filename).name}, line {error.lineno})")
    frames = list(traceback.walk_tb(error.__traceback__))
    own = [place for place in frames if place[0].f_globals.get("__name__") == module]
    where = ""
    if frames:
        frame, line = (own or frames)[-1]
        where = f" ({Path(frame.f_code.co_filename).name}, line {line})"
    what = str(error) if isinstance(error, ShmioError) else f"{type(error).__name__}: {error}"
    return _line(f"{what}{where}")


def _line(text: str) -> str:
    return shorten(printable(" ".join(text.split())), 400)
