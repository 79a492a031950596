"""Reads the description of an FMU, and turns its variables into declarations of a model."""

from __future__ import annotations

import math
import platform
import re
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

from shmio.errors import ModelError
from shmio.layout.topic import encode_segment, shorten
from shmio.simulation.fmu.archive import DESCRIPTION, Archive
from shmio.simulation.model import Declaration, Input, Output, Parameter
from shmio.wording import printable

EXTRA: Final = "an FMU needs another library; run pip install 'shmio[fmu]'"
MAX_STRING: Final = 254
TYPES: Final = {
    "Real": "LREAL",
    "Integer": "DINT",
    "Float32": "REAL",
    "Float64": "LREAL",
    "Int8": "SINT",
    "UInt8": "USINT",
    "Int16": "INT",
    "UInt16": "UINT",
    "Int32": "DINT",
    "UInt32": "UDINT",
    "Int64": "LINT",
    "UInt64": "ULINT",
    "Boolean": "BOOL",
    "String": f"STRING[{MAX_STRING}]",
}
"""The register's type for each type of variable. Variables of other types are left out."""
_KINDS: Final[dict[str, type[Input] | type[Output] | type[Parameter]]] = {
    "input": Input,
    "output": Output,
    "parameter": Parameter,
}
_REALS: Final = frozenset({"Real", "Float32", "Float64"})
_IDENTIFIER: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_MAX_COMMENT: Final = 1000
_MAX_UNIT: Final = 64


class Variable(NamedTuple):
    """An input, output or parameter of an FMU.

    ``fmi_type`` is the type of its value. A single value has the shape ``()``. ``initial`` is the
    value with which the FMU begins; None if it is unknown.
    """

    name: str
    causality: str
    fmi_type: str
    reference: int
    shape: tuple[int, ...]
    initial: object

    @property
    def size(self) -> int:
        """Number of values: the elements of an array, else 1."""
        return math.prod(self.shape)


class Description(NamedTuple):
    """What shmio needs to know about an FMU. ``parsed`` is FMPy's ``ModelDescription``."""

    parsed: Any
    version: int
    variables: tuple[Variable, ...]
    declarations: Mapping[str, Declaration]
    """The declarations of the variables, by name."""
    varies_step: bool
    """True if steps may have different lengths."""
    returns_early: bool
    start_s: float
    """The FMU's time at its start."""
    lacks: tuple[str, ...]
    """The capabilities that a snapshot needs and the FMU lacks."""


def describe(archive: Archive) -> Description:
    """Read the description of an FMU, without running any of its code.

    Raises:
        ModelError: The description is invalid, or shmio cannot run this FMU on this machine.

    """
    parsed = _parse(archive.description)
    cosimulation = parsed.coSimulation
    if cosimulation is None:
        raise ModelError("it is not for co-simulation; export it for co-simulation (FMI 2.0 or 3.0)")
    version = parsed.fmiMajorVersion
    identifier = str(cosimulation.modelIdentifier)
    if not _IDENTIFIER.fullmatch(identifier):
        raise ModelError(f"its modelIdentifier {shorten(printable(identifier))!r} is not an identifier")
    _check_platform(archive.names, version, identifier)
    experiment = parsed.defaultExperiment
    found = dict(_variables(parsed, version))
    return Description(
        parsed,
        version,
        tuple(found),
        {variable.name: declaration for variable, declaration in found.items()},
        cosimulation.canHandleVariableCommunicationStepSize,
        cosimulation.mightReturnEarlyFromDoStep,
        _number(experiment.startTime, 0.0) if experiment is not None else 0.0,
        tuple(
            name[:-5] + ("state" if version == 2 else "State")
            for name in ("canGetAndSetFMUstate", "canSerializeFMUstate")
            if not getattr(cosimulation, name)
        ),
    )


def _parse(xml: bytes) -> Any:
    """Parse the description with FMPy.

    Raises:
        ModelError: FMPy is missing, or the description is invalid.

    """
    try:
        from defusedxml import DefusedXmlException  # noqa: PLC0415  only FMUs need these libraries
        from defusedxml.ElementTree import ParseError, fromstring  # noqa: PLC0415
        from fmpy.model_description import ValidationError, read_model_description  # noqa: PLC0415
    except ImportError:
        raise ModelError(EXTRA) from None
    try:
        root = fromstring(xml, forbid_dtd=True)
    except DefusedXmlException:
        raise ModelError(f"{DESCRIPTION} has a document type or entities, which is not allowed") from None
    except (ParseError, ValueError, LookupError) as error:
        raise ModelError(f"{DESCRIPTION}: {shorten(printable(str(error)))}") from None
    version = root.get("fmiVersion", "")
    if version != "2.0" and not version.startswith("3.0"):
        raise ModelError(f"it has the FMI version {shorten(printable(version))!r}; expected 2.0 or 3.0")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / DESCRIPTION  # given only this file, FMPy reads no description of the sources
        file.write_bytes(xml)
        try:
            return read_model_description(str(file))
        except ValidationError as error:
            problems = "; ".join(error.problems)
            raise ModelError(f"{DESCRIPTION} is invalid: {shorten(printable(problems), 400)}") from None
        except Exception as error:  # noqa: BLE001  FMPy raises Exception, and any other for odd values
            text = f"{type(error).__name__}: {error}"
            raise ModelError(f"{DESCRIPTION} is invalid: {shorten(printable(text), 400)}") from None


def _check_platform(names: frozenset[str], version: int, identifier: str) -> None:
    """Check that the archive has a library for this machine.

    Raises:
        ModelError: The archive has no such library.

    """
    import fmpy  # noqa: PLC0415  only FMUs need it

    tuple_of = {2: fmpy.platform, 3: fmpy.platform_tuple}
    if f"binaries/{tuple_of[version]}/{identifier}.so" in names:
        return
    parts = [name.split("/") for name in names]
    there = sorted({part[1] for part in parts if len(part) == 3 and part[0] == "binaries" and part[1]})
    raise ModelError(
        f"it has no library for {tuple_of[version]} (Linux, {platform.machine()}); "
        f"it has: {shorten(printable(', '.join(there))) or 'none'}"
    )


def _variables(parsed: Any, version: int) -> Iterator[tuple[Variable, Declaration]]:
    """Yield the inputs, outputs and parameters, with their declarations."""
    for variable in parsed.modelVariables:
        kind = _KINDS.get(variable.causality)
        type_ = ("Integer" if version == 2 else "Int64") if variable.type == "Enumeration" else variable.type
        if kind is None or type_ not in TYPES or variable.alias is not None:
            continue
        element = TYPES[type_]
        shape = tuple(variable.shape or ())
        bounds = ", ".join(f"0..{size - 1}" for size in shape)
        try:
            initial = _start(variable.start, type_, math.prod(shape) if shape else None)
            limits = None if kind is Output else _limits(variable, type_)
            comment = printable(" ".join((variable.description or "").split()))[:_MAX_COMMENT]
            unit = printable(_inherited(variable, "unit") or "")[:_MAX_UNIT]
            array = f"ARRAY[{bounds}] OF {element}" if shape else element
            declaration = kind(array, initial, unit=unit, comment=comment, limits=limits)
        except (ValueError, OverflowError) as error:
            name = shorten(printable(variable.name))
            raise ModelError(f"{DESCRIPTION}: variable {name}: {shorten(printable(str(error)))}") from None
        declaration.path = encode_segment(variable.name)
        start = tuple(initial) if isinstance(initial, list) else initial
        yield Variable(variable.name, variable.causality, type_, variable.valueReference, shape, start), declaration


def _start(text: str | None, type_: str, count: int | None) -> object:
    """Return the start value; a list for an array of ``count`` elements.

    None if there is no start value that a register can have. The FMU then begins with its own value.
    """
    if text is None:
        return None
    if type_ == "String":  # FMPy gives only the first one of an array
        fits = count is None and len(text) <= MAX_STRING and all(ord(character) < 256 for character in text)
        return text if fits else None
    values = [_value(one, type_) for one in ([text] if count is None else text.split())]
    if not all(map(math.isfinite, values)):
        return None
    if count is None:
        return values[0]
    return values * count if len(values) == 1 else values


def _value(text: str, type_: str) -> float:
    if type_ == "Boolean":
        return text in ("true", "1")
    return float(text) if type_ in _REALS else int(text)


def _limits(variable: Any, type_: str) -> tuple[float, float] | None:
    low, high = _inherited(variable, "min"), _inherited(variable, "max")
    if type_ in ("Boolean", "String") or (low is None and high is None):
        return None
    return _number(low, -math.inf), _number(high, math.inf)


def _inherited(variable: Any, attribute: str) -> Any:
    """Return an attribute of the variable; if the variable has none, that of its declared type."""
    own = getattr(variable, attribute)
    return getattr(variable.declaredType, attribute) if own is None and variable.declaredType is not None else own


def _number(text: str | None, default: float) -> float:
    return default if text is None else float(text)
