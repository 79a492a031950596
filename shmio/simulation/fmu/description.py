"""Reads the description of an FMU, and turns its variables into declarations of a model."""

from __future__ import annotations

import math
import platform
import re
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, NamedTuple

from shmio.errors import ModelError
from shmio.layout.topic import encode_segment, shorten
from shmio.simulation.fmu.archive import DESCRIPTION, Archive
from shmio.simulation.images import Limits
from shmio.simulation.model import Declaration, Input, Output, Parameter
from shmio.wording import printable

STRUCTURAL: Final = "structuralParameter"
NO_STRUCTURE: Final[Mapping[str, int]] = MappingProxyType({})
EXTRA: Final = "an FMU needs another library; run pip install 'shmio[fmu]'"
TEXT_LENGTH: Final = 254
MAX_TEXT_LENGTH: Final = 16_382
MAX_ELEMENTS: Final = 1 << 20
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
    "String": f"WSTRING[{TEXT_LENGTH}]",
}
"""The register's type for each type of variable. Variables of other types are left out."""
_KINDS: Final[dict[str, type[Input] | type[Output] | type[Parameter]]] = {
    "input": Input,
    "output": Output,
    "parameter": Parameter,
    STRUCTURAL: Parameter,
}
_REALS: Final = frozenset({"Real", "Float32", "Float64"})
_IDENTIFIER: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_MAX_COMMENT: Final = 1000
_MAX_UNIT: Final = 64
_MAX_NAMED: Final = 10
_MAX_REFERENCE: Final = (1 << 32) - 1
_BOOLEANS: Final = {"true": True, "1": True, "false": False, "0": False}
_SCHEMA: Final = re.compile(r"Element '(?P<element>\w+)'(?P<attribute>, attribute '\w+')?: (?P<what>.*)", re.DOTALL)
_OF_VALUES: Final = frozenset(
    {*TYPES, "Binary", "Clock", "Enumeration", "ScalarVariable", "Dimension", "Start", "Item", "DefaultExperiment"}
)
"""The elements that contain values of variables, or say what the values are."""


class FmuOptions(NamedTuple):
    """How to read an FMU.

    ``strict`` refuses a description with any formal defect. ``text_length`` is the number of characters, in UTF-16, of
    the registers of texts whose start values are not longer.
    """

    strict: bool = False
    text_length: int = TEXT_LENGTH


DEFAULTS: Final = FmuOptions()


class Variable(NamedTuple):
    """An input, output or parameter of an FMU.

    ``causality`` is ``output`` for another name of an input. ``fmi_type`` is the type of its value. A single value has
    the shape ``()``. ``initial`` is the value with which the FMU begins; None if it is unknown.
    """

    name: str
    causality: str
    fmi_type: str
    reference: int
    shape: tuple[int, ...]
    initial: object
    discrete: bool = False

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
    has_events: bool
    """True if the FMU has the event mode of FMI 3.0."""
    notices: tuple[str, ...]
    """What the user should know."""


def describe(
    archive: Archive, options: FmuOptions = DEFAULTS, structure: Mapping[str, int] = NO_STRUCTURE
) -> Description:
    """Read the description of an FMU, without running any of its code.

    Args:
        archive: The FMU.
        options: How to read it.
        structure: Values of structural parameters, which determine the sizes of arrays, by name.

    Raises:
        ModelError: The description is invalid, or shmio cannot run this FMU on this machine.

    """
    parsed, root, defect = _parse(archive.description, strict=options.strict)
    cosimulation = parsed.coSimulation
    if cosimulation is None:
        raise ModelError("it is not for co-simulation; export it for co-simulation (FMI 2.0 or 3.0)")
    version = parsed.fmiMajorVersion
    identifier = str(cosimulation.modelIdentifier)
    if not _IDENTIFIER.fullmatch(identifier):
        raise ModelError(f"its modelIdentifier {shorten(printable(identifier))!r} is not an identifier")
    _check_platform(archive.names, version, identifier)
    experiment = parsed.defaultExperiment
    elements = {one.get("name", ""): one for one in root.iterfind("ModelVariables/*")}
    found = dict(_variables(parsed, version, elements, options.text_length, structure))
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
        version == 3 and bool(cosimulation.hasEventMode),
        tuple(filter(None, (defect, _left_out(parsed)))),
    )


def _parse(xml: bytes, *, strict: bool) -> tuple[Any, Any, str]:
    """Parse the description.

    Returns:
        FMPy's description, the root element, and a formal defect that does not touch a value; "" if there is none.

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
            return read_model_description(str(file)), root, ""
        except ValidationError as error:
            problems = [printable(str(one)) for one in error.problems]
        except Exception as error:  # noqa: BLE001  FMPy raises Exception, and any other for odd values
            problems = [printable(f"{type(error).__name__}: {error}")]
        grave = [one for one in problems if strict or _touches_value(one)]
        try:
            parsed = None if grave else read_model_description(str(file), validate=False)
        except Exception:  # noqa: BLE001  as above
            grave = problems
        else:
            grave += _contradictions(parsed) if parsed is not None else []
        if grave:
            raise ModelError(f"{DESCRIPTION} is invalid: {shorten('; '.join(grave), 400)}")
    return (
        parsed,
        root,
        (
            f"{DESCRIPTION} breaks the standard, but no value depends on it: {shorten('; '.join(problems), 400)}; set "
            "strict = true to refuse such FMUs"
        ),
    )


def _touches_value(problem: str) -> bool:
    """Return whether the values of variables may be wrong because of a problem that the schema reports."""
    found = _SCHEMA.search(problem)
    if found is None or (found["attribute"] and "is not allowed" in found["what"]):
        return False  # a problem that _contradictions checks, or an attribute that nobody reads
    return found["element"] in _OF_VALUES or found["element"].endswith("Type")


def _contradictions(parsed: Any) -> list[str]:
    """Return what makes it uncertain which value a variable has."""
    found: list[str] = []
    names: set[str] = set()
    references: dict[int, str] = {}
    if not parsed.guid:
        found.append("it has no guid or instantiationToken")
    for one in parsed.modelVariables:
        if one.name in names:
            found.append(f"the variable name {printable(one.name)!r} is not unique")
        names.add(one.name)
        if parsed.fmiMajorVersion == 3 and one.alias is None:
            other = references.setdefault(one.valueReference, one.name)
            if other != one.name:
                found.append(
                    f"the variables {printable(other)!r} and {printable(one.name)!r} have the same valueReference"
                )
    return found


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


def _left_out(parsed: Any) -> str:
    """Return a notice of the inputs, outputs and parameters that become nothing in shmio; "" if there are none."""
    kinds: dict[str, list[str]] = {}
    for one in parsed.modelVariables:
        if one.causality not in _KINDS:
            continue
        if one.type in ("Binary", "Clock"):
            kinds.setdefault(f"of type {one.type}", []).append(one.name)
        elif one.alias is not None and _KINDS[one.causality] is Parameter:
            kinds.setdefault("that are other names of parameters", []).append(one.name)
    parts = []
    for kind, names in kinds.items():
        more = f" and {len(names) - _MAX_NAMED} more" if len(names) > _MAX_NAMED else ""
        parts.append(f"the variables {kind}: {', '.join(map(printable, names[:_MAX_NAMED]))}{more}")
    return f"shmio leaves out {'; '.join(parts)}" if parts else ""


def _variables(
    parsed: Any, version: int, elements: Mapping[str, Any], text_length: int, structure: Mapping[str, int]
) -> Iterator[tuple[Variable, Declaration]]:
    """Yield the inputs, outputs and parameters, with their declarations.

    ``elements`` are the elements of the variables in the description, by name.
    """
    for variable in parsed.modelVariables:
        kind = _KINDS.get(variable.causality)
        type_ = ("Integer" if version == 2 else "Int64") if variable.type == "Enumeration" else variable.type
        if kind is None or type_ not in TYPES:
            continue
        causality = variable.causality
        if variable.alias is not None:
            if kind is Parameter:
                continue
            kind, causality = Output, "output"  # two registers cannot both set one input
        own = variable if variable.alias is None else variable.alias
        element = elements.get(own.name)
        try:
            shape = _shape(variable, structure)
            bounds = ", ".join(f"0..{size - 1}" for size in shape)
            start = _texts(variable, element, version) if type_ == "String" else variable.start
            if shape != _shape(variable, NO_STRUCTURE) and start is not None and len(_words(start)) > 1:
                start = None  # it has the values of an array of another size
            initial = _start(start, type_, math.prod(shape) if shape else None)
            limits = None if kind is Output else _limits(variable, type_, element if version == 3 else None)
            items = _items(variable)
            if initial is None and items and not shape:
                initial = min(items)  # 0 may be none of them
            comment = " ".join((variable.description or "").split())
            if items:
                comment = f"{comment} ({', '.join(f'{number}: {name}' for number, name in items.items())})".lstrip()
            comment = printable(comment)[:_MAX_COMMENT]
            unit = printable(_inherited(variable, "unit") or "")[:_MAX_UNIT]
            if not 0 <= variable.valueReference <= _MAX_REFERENCE:
                raise ValueError(f"its valueReference {variable.valueReference} is no 32-bit number")
            base = _text_type(initial, text_length) if type_ == "String" else TYPES[type_]
            array = f"ARRAY[{bounds}] OF {base}" if shape else base
            declaration = kind(array, initial, unit=unit, comment=comment, limits=limits)
            declaration.any_text = type_ == "String"
        except (ValueError, OverflowError, TypeError) as error:
            name = shorten(printable(variable.name))
            raise ModelError(f"{DESCRIPTION}: variable {name}: {shorten(printable(str(error)))}") from None
        declaration.path = encode_segment(variable.name)
        start = tuple(initial) if isinstance(initial, list) else initial
        discrete = variable.variability == "discrete"
        yield Variable(variable.name, causality, type_, variable.valueReference, shape, start, discrete), declaration


def _shape(variable: Any, structure: Mapping[str, int]) -> tuple[int, ...]:
    """Return the sizes of an array; () for a single value.

    Raises:
        ValueError: It has too many elements.

    """
    shape = tuple(
        int(one.start if one.variable is None else structure.get(one.variable.name, one.variable.start))
        for one in variable.dimensions
    )
    if math.prod(shape) > MAX_ELEMENTS or any(size < 1 for size in shape):
        raise ValueError(f"an array of {' x '.join(map(str, shape))} elements; expected 1 to {MAX_ELEMENTS}")
    return shape


def _texts(variable: Any, element: Any, version: int) -> list[str] | None:
    """Return the start values of a text; FMPy gives only the first one of an array."""
    if version == 2 or element is None:
        return None if variable.start is None else [variable.start]
    return [one.get("value", "") for one in element.findall("Start")] or None


def _text_type(initial: object, least: int) -> str:
    """Return the type of a register for a text: it holds the start values, and at least ``least`` characters."""
    texts = initial if isinstance(initial, list) else [initial]
    units = max(len(text.encode("utf-16-le", "surrogatepass")) // 2 for text in (str(one or "") for one in texts))
    return f"WSTRING[{min(max(units, least), MAX_TEXT_LENGTH)}]"


def start_value(text: str, variable: Variable) -> object:
    """Return the value in a text such as ``1 2 3 4``, in the order and form of the description.

    Raises:
        ValueError: The text does not fit the variable.

    """
    return _start(text, variable.fmi_type, variable.size if variable.shape else None)


def _start(start: str | list[str] | None, type_: str, count: int | None) -> object:
    """Return the start value; a list for an array of ``count`` elements.

    None if there is no start value that a register can have. The FMU then begins with its own value.

    Raises:
        ValueError: An element is no value of the type, or the number of elements is another one.

    """
    if start is None:
        return None
    texts = [start] if count is None and isinstance(start, str) else _words(start)
    values = [_value(one, type_) for one in texts]
    if not all(isinstance(one, str) or math.isfinite(one) for one in values):
        return None
    if count is None and len(values) == 1:
        return values[0]
    if count is not None and len(values) == 1:
        return values * count
    if len(values) != count:
        raise ValueError(f"its start has {len(values)} values; expected {count or 1}")
    return values


def _words(start: str | list[str]) -> list[str]:
    return start if isinstance(start, list) else start.split()


def _value(text: str, type_: str) -> float | str:
    if type_ == "String":
        return text
    if type_ == "Boolean":
        if text not in _BOOLEANS:
            raise ValueError(f"{text!r} is no Boolean")
        return _BOOLEANS[text]
    return float(text) if type_ in _REALS else int(text)


def _limits(variable: Any, type_: str, element: Any) -> Limits | None:
    """Return the values that a variable may have; ``element`` has the range of unsigned integers, unlike FMPy."""
    low, high = _inherited(variable, "min"), _inherited(variable, "max")
    if element is not None and type_.startswith("UInt"):
        low, high = element.get("min", low), element.get("max", high)
    if type_ in ("Boolean", "String"):
        return None
    least, most = _number(low, -math.inf), _number(high, math.inf)
    if items := _items(variable):
        return {number: name for number, name in items.items() if least <= number <= most}
    return None if low is None and high is None else (least, most)


def _items(variable: Any) -> dict[int, str]:
    """Return the names of an enumeration's values; empty if it is none, or has no items."""
    if variable.type != "Enumeration" or variable.declaredType is None:
        return {}
    return {int(one.value): str(one.name) for one in variable.declaredType.items or ()}


def _inherited(variable: Any, attribute: str) -> Any:
    """Return an attribute of the variable; if the variable has none, that of its declared type."""
    own = getattr(variable, attribute)
    return getattr(variable.declaredType, attribute) if own is None and variable.declaredType is not None else own


def _number(text: str | None, default: float) -> float:
    return default if text is None else float(text)
