"""Runs an FMU as a model."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, ClassVar, Final, Self

import msgspec

from shmio.errors import ModelError, ShmioError, SnapshotError
from shmio.layout.values.codec import nest
from shmio.simulation.fmu.archive import Archive, Extracted
from shmio.simulation.fmu.description import (
    DEFAULTS,
    NO_STRUCTURE,
    STRUCTURAL,
    Description,
    FmuOptions,
    Variable,
    describe,
    start_value,
)
from shmio.simulation.fmu.instance import FmuError, Group, Instance, Outputs
from shmio.simulation.model import Model

SUFFIX: Final = ".fmu"
REMEDY: Final = "; the FMU starts again when its source is restarted"
MAX_CALLS: Final = 10_000
"""Maximum number of calls of ``doStep`` in one step."""
MAX_TRIES: Final = 4
"""Number of times to try a step of one size before trying a smaller one."""
MAX_HALVINGS: Final = 30
MAX_REPEATS: Final = 1000
"""Number of times to try a discarded step if the FMU does not allow smaller steps."""


def is_fmu(text: str) -> bool:
    """Return whether a model's name is the path of an FMU, which ends in ``.fmu`` in upper or lower case."""
    return text.lower().endswith(SUFFIX)


def load_fmu(file: Path, options: FmuOptions = DEFAULTS) -> type[FmuModel]:
    """Return a model class for an FMU, without running any of the FMU's code.

    Args:
        file: The FMU.
        options: How to read it.

    Raises:
        ModelError: The file is not an FMU that shmio can run on this machine.

    """
    try:
        archive = Archive(file)
        return _model_of(archive, options, NO_STRUCTURE)
    except ModelError as error:
        raise ModelError(f"{file}: {error}") from None


def _model_of(archive: Archive, options: FmuOptions, structure: Mapping[str, int]) -> type[FmuModel]:
    description = describe(archive, options, structure)
    return FmuModel.with_declarations(
        archive.path.name, description.declarations, archive=archive, description=description,
        notices=description.notices, options=options, structure=structure,
    )  # fmt: skip


class _SavedFmu(msgspec.Struct, forbid_unknown_fields=True):
    fmu: bytes
    times: tuple[int | None, int, int, float]


class FmuModel(Model):
    """Base class of the models that run FMUs. :func:`load_fmu` makes a subclass for each FMU.

    The FMU's own time starts at the beginning of the first step. If a call to the FMU fails, all
    further steps fail for the same reason.
    """

    archive: ClassVar[Archive]
    description: ClassVar[Description]
    options: ClassVar[FmuOptions] = DEFAULTS
    structure: ClassVar[Mapping[str, int]] = NO_STRUCTURE
    """The values of structural parameters that the sizes of arrays depend on."""

    _instance: Instance | None = None
    _folder: Extracted | None = None
    _failure = ""
    _inputs: list[Group]
    _outputs: Outputs
    _begun_ns: int | None = None  # instance time at the FMU's start
    _done_ns = 0  # time since then that the FMU has computed
    _fixed_ns = 0  # length of all steps, if the FMU needs that
    _now_s = 0.0  # the FMU's own time

    @classmethod
    def with_parameters(cls, parameters: Mapping[str, object]) -> tuple[type[Self], Mapping[str, object]]:
        """Return the class whose arrays have the sizes that structural parameters state, and nested lists for matrices.

        Raises:
            ModelError: The sizes are not possible.

        """
        model: type[Any] = cls
        structure = {
            one.name: value
            for one in cls.description.variables
            if one.causality == STRUCTURAL and type(value := parameters.get(one.name)) is int
        }
        if structure != cls.structure:
            model = _model_of(cls.archive, cls.options, structure)
        variables = {one.name: one for one in model.description.variables}
        return model, {name: _declared(value, variables.get(name)) for name, value in parameters.items()}

    def start(self) -> None:
        """Load and initialise the FMU."""
        if self._failure:
            raise ModelError(self._failure)
        try:
            self._folder = self.archive.extract()
            self._instance = instance = Instance(self.description, self._folder.path)
            self._inputs, outputs, parameters, structure = (
                instance.group([one for one in self.description.variables if one.causality == causality], self._ports)
                for causality in ("input", "output", "parameter", STRUCTURAL)
            )
            self._outputs = Outputs(outputs)
            self._now_s = self.description.start_s
            instance.initialise(structure, parameters, self._inputs)
            instance.get(self._outputs)
        except ShmioError as error:
            raise self._fail(error) from None

    def step(self, time_s: float, dt_s: float) -> None:
        """Set the FMU's inputs, let it step to ``time_s``, and read its outputs."""
        if self._failure or self._instance is None:
            raise ModelError(self._failure)
        time_ns, dt_ns = round(time_s * 1e9), round(dt_s * 1e9)
        if self._begun_ns is None:
            self._begun_ns = time_ns - dt_ns
        passed_ns = time_ns - self._begun_ns
        try:
            self._instance.set(self._inputs)
            if self.description.varies_step:
                self._advance(self._instance, _point_s(passed_ns, dt_ns))
                self._done_ns = passed_ns
            else:
                self._advance_evenly(self._instance, passed_ns, dt_ns)
            self._instance.get(self._outputs)
        except FmuError as error:
            raise self._fail(error) from None
        except ShmioError as error:
            raise ModelError(str(error)) from None

    @classmethod
    def code_files(cls) -> list[Path]:
        """Return the path of the FMU, the only file of the model."""
        return [cls.archive.path]

    def save_state(self) -> object:
        """Return the FMU's own state, and the times that this class keeps."""
        if self._failure or self._instance is None:
            raise SnapshotError(self._failure or "the FMU has not started")
        if self.description.lacks:
            raise SnapshotError(f"the FMU cannot save its state: it lacks {' and '.join(self.description.lacks)}")
        times = (self._begun_ns, self._done_ns, self._fixed_ns, self._now_s)
        return {"fmu": self._instance.save(), "times": times}

    def restore_state(self, state: Any) -> None:
        """Restore the FMU's own state and the times from what :meth:`save_state` has returned."""
        if self._failure or self._instance is None:
            raise SnapshotError(self._failure or "the FMU has not started")
        if self.description.lacks:
            raise SnapshotError(f"the FMU cannot restore a state: it lacks {' and '.join(self.description.lacks)}")
        try:
            saved = msgspec.convert(state, _SavedFmu)
        except msgspec.ValidationError as error:
            raise SnapshotError(f"the state of the FMU is damaged: {error}") from None
        try:
            self._instance.restore(saved.fmu)
        except FmuError as error:
            raise self._fail(error) from None
        self._begun_ns, self._done_ns, self._fixed_ns, self._now_s = saved.times
        for group in self._inputs:
            group.forget()

    def _advance_evenly(self, instance: Instance, passed_ns: int, dt_ns: int) -> None:
        """Make steps of equal length up to a time since the FMU's start.

        Raises:
            ModelError: The time is not a multiple of the steps' length.

        """
        self._fixed_ns = self._fixed_ns or dt_ns
        if (passed_ns - self._done_ns) % self._fixed_ns:
            raise ModelError(
                f"the FMU makes steps of one length only, {self._fixed_ns / 1e6:g} ms as in its first step; "
                f"{(passed_ns - self._done_ns) / 1e6:g} ms is not a multiple of that, so choose a multiple"
            )
        while self._done_ns < passed_ns:
            self._advance(instance, _point_s(self._done_ns + self._fixed_ns, self._fixed_ns))
            self._done_ns += self._fixed_ns

    def _advance(self, instance: Instance, passed_s: float) -> None:
        """Make a step up to a time since the FMU's start, in parts if the FMU does not complete it at once."""
        target_s = self.description.start_s + passed_s
        size_s = target_s - self._now_s
        tries = halvings = 0
        for _ in range(MAX_CALLS):
            if self._now_s >= target_s or math.isclose(self._now_s, target_s):
                return
            is_last = target_s - self._now_s <= size_s * (1 + 1e-9)
            end_s = target_s if is_last else self._now_s + size_s
            reached_s = instance.do_step(self._now_s, end_s - self._now_s)
            if reached_s is not None and reached_s > self._now_s:
                self._now_s = min(reached_s, end_s)
                tries = halvings = 0
                continue
            tries += 1
            if self.description.varies_step and tries >= MAX_TRIES:
                size_s, tries, halvings = size_s / 2, 0, halvings + 1
            if tries >= MAX_REPEATS or halvings >= MAX_HALVINGS:
                break
        raise FmuError(f"it has discarded its step at {self._now_s:g} s repeatedly")

    def _fail(self, error: ShmioError) -> ModelError:
        self._failure = f"{error}{REMEDY}"
        return ModelError(self._failure)

    def _close(self) -> None:
        """End the FMU, and remove its files."""
        if self._instance is not None:
            self._instance.close()
            self._instance = None
            self._failure = self._failure or "the FMU has ended"
        if self._folder is not None:
            self._folder.remove()
            self._folder = None


def _declared(value: object, variable: Variable | None) -> object:
    """Return a parameter's value as declared: a matrix also from a flat list, or from the text of a start value."""
    if variable is None or not variable.shape:
        return value
    if isinstance(value, str) and variable.fmi_type != "String":
        with suppress(ValueError):
            value = start_value(value, variable)
    if isinstance(value, list) and len(value) == variable.size and not any(isinstance(one, list) for one in value):
        return nest(value, variable.shape)
    return value


def _point_s(passed_ns: int, dt_ns: int) -> float:
    """Return a time in s.

    For steps of equal length, this is the product that FMPy computes, so that the FMU gets the same
    numbers to the last bit.
    """
    count, rest = divmod(passed_ns, dt_ns) if dt_ns else (0, 1)
    return passed_ns / 1e9 if rest else count * (dt_ns / 1e9)
