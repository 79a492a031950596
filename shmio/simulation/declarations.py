"""What a model declares: inputs, outputs, in-out registers and parameters."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cached_property
from typing import Any, ClassVar, Protocol

from shmio.errors import LayoutError, ModelError, ShmioError
from shmio.layout.model import Layout
from shmio.layout.structures import members
from shmio.layout.tags import place_tags
from shmio.layout.topic import canonical_path
from shmio.simulation.ports import Ends, Port


class DeclaringModel(Protocol):
    """A model, as its declarations see it."""

    _ports: Mapping[str, Port]
    _ends: Mapping[str, Ends]


class Declaration:
    """One declaration of a model. On the class it is this object, on a model its value.

    The value of a single register is a bool, int, float or str, see ``shmio.layout.values.codec``.
    An array's is a tuple, of tuples for several dimensions; a one-dimensional array of BYTE is
    bytes. A structure's is a dict of its members' values; setting it changes the members that are
    named.
    """

    kind: ClassVar[str]
    """The name of the kind in messages."""

    def __init__(
        self,
        type: str | Mapping[str, str],  # noqa: A002  it is what the tables call it
        initial: object = None,
        *,
        path: str = "",
        unit: str = "",
        comment: str = "",
    ) -> None:
        """Declare a value. Errors are raised as ModelError when the class is created.

        Args:
            type: The type as in a tag table: ``LREAL``, ``STRING[20]``, ``ARRAY[1..8] OF BOOL``,
                ``SafetyZone``; or the types of a structure's members, by name.
            initial: The initial value; default: that of the type. For an array a flat list, for a
                structure a dict.
            path: The path of the register; default: the attribute's name.
            unit: The unit, for the layout.
            comment: The comment, for the layout.

        """
        self.type = type
        self.initial = initial
        self.path = path
        self.unit = unit
        self.comment = comment
        self.name = ""

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name
        self.path = self.path or name

    def __get__(self, model: DeclaringModel | None, owner: type) -> Any:
        return self if model is None else model._ports[self.name].read()

    def __set__(self, model: DeclaringModel, value: object) -> None:
        raise AttributeError(f"{self.name} is {self.kind}: a model reads it and cannot set it")

    @cached_property
    def members(self) -> Mapping[str, str] | None:
        """The types of a structure's members, by their paths in it.

        None if it is not a structure.
        """
        return members(self.type) if isinstance(self.type, str) else self.type

    @cached_property
    def paths(self) -> Mapping[str, str]:
        """The path of each register by its member; a single register is under ``""``."""
        inside = {"": ""} if self.members is None else {member: f"/{member}" for member in self.members}
        return {member: canonical_path(self.path + end) for member, end in inside.items()}

    @property
    def tags(self) -> Mapping[str, object]:
        """The entries for a tag table; ValueRangeError for an invalid type."""
        if self.members is None:
            return {self.path: self._tag(self.type, self.initial)}
        initial = self.initial or {}
        if not isinstance(initial, Mapping) or initial.keys() - self.members.keys():
            raise ModelError(f"initial: expected a dict with some of {', '.join(self.members)}, found {initial!r}")
        return {f"{self.path}/{name}": self._tag(kind, initial.get(name)) for name, kind in self.members.items()}

    def _tag(self, kind: object, initial: object) -> Mapping[str, object]:
        comment = f"{self.comment} [{self.unit}]" if self.unit else self.comment
        return {"type": kind, "initial": list(initial) if isinstance(initial, tuple) else initial, "comment": comment}


class Input(Declaration):
    """A register that others write or a connection fills. The model reads it."""

    kind = "an input"


class Parameter(Declaration):
    """A constant that the configuration may set under the attribute's name.

    It is not a register.
    """

    kind = "a parameter"

    def __init__(self, type: str, initial: object = None, *, unit: str = "", comment: str = "") -> None:  # noqa: A002
        super().__init__(type, initial, unit=unit, comment=comment)


class Output(Declaration):
    """A register that only the model writes. It keeps its value until the model sets another."""

    kind = "an output"

    def __set__(self, model: DeclaringModel, value: object) -> None:
        model._ports[self.name].write(value)


class InOut(Declaration):
    """A register that others command and the model computes. See :class:`Ends`."""

    kind = "an in-out register"

    def __get__(self, model: DeclaringModel | None, owner: type) -> Any:
        return self if model is None else model._ends[self.name]

    def __set__(self, model: DeclaringModel, value: object) -> None:
        raise AttributeError(f"{self.name} is {self.kind}: set {self.name}.shown")


def place_declarations(model: str, declarations: Iterable[Declaration]) -> Layout:
    """Place declarations like a tag table; ModelError names the model and all errors."""
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
