"""Writes an instance as an FMU: a file with a description, a library, and the instance's files."""

from __future__ import annotations

import hashlib
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Iterator, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, Final, NamedTuple
from xml.sax.saxutils import quoteattr as _quoteattr

import msgspec

from shmio.config.toml import toml_file
from shmio.errors import ConfigError, LayoutError
from shmio.lab.fmu.exchange import Group, Values, groups_of
from shmio.lab.fmu.process import CONFIG, MANIFEST, Manifest, image_of
from shmio.lab.fmu.secrets import kept, read_instance, secret_files, without_secrets
from shmio.lab.laboratory import Laboratory, prepare_laboratory
from shmio.version import __version__

IDENTIFIER: Final = "shmio_cell"
MAX_BYTES: Final = 64 << 20
COMPILE_S: Final = 120
"""Time limit in s for the C compiler."""
SUFFIXES: Final = frozenset(
    {".toml", ".db", ".udt", ".scl", ".awl", ".s7dcl", ".csv", ".xlsx", ".ini", ".py", ".fmu", ".npy", ".json"}
)
"""Suffixes of the files that are copied from the configuration's folder to the FMU."""
_SKIPPED: Final = frozenset({"__pycache__", "node_modules", "logs", "dumps", "snapshots", "build", "dist"})
_NOT_XML: Final = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
_PLATFORMS: Final = {"x86_64": "linux64"}


def quoteattr(text: str) -> str:
    """Return text as a quoted value for XML; characters that XML 1.0 cannot contain become escape sequences."""
    return _quoteattr(_NOT_XML.sub(lambda match: f"\\u{ord(match[0]):04x}", text))


class Exported(NamedTuple):
    """The result of an export: the numbers of inputs and outputs, and what was left out.

    Attributes:
        inputs: Number of inputs.
        outputs: Number of outputs.
        left_out: Registers whose types FMI does not have.
        secret_keys: Keys of the configuration whose values may be secret.
        secret_files: Files that may have secrets, and other configurations.

    """

    inputs: int
    outputs: int
    left_out: list[str]
    secret_keys: list[str]
    secret_files: list[str]


def export_fmu(config: Path, file: Path, patterns: Sequence[str]) -> Exported:
    """Write an instance as an FMU for co-simulation by FMI 2.0.

    Args:
        config: The ``supervisor.toml``, whose sources must all be computed.
        file: The FMU; an existing file is replaced.
        patterns: Patterns of the registers to export; empty for all.

    Raises:
        ConfigError: The instance cannot be exported; the message says why.
        LayoutError: A layout cannot be compiled.
        PathError: A pattern matches no register.

    """
    machine = _PLATFORMS.get(platform.machine())
    if machine is None:
        raise ConfigError(f"FMI 2.0 has no name for Linux on {platform.machine()}; export on x86_64")
    with tempfile.TemporaryDirectory(prefix="shmio-export-") as folder:
        work = Path(folder)
        tables = read_instance(config) or {}
        secret = _copy(config.resolve(), tables, work / CONFIG)
        if tables:
            (work / CONFIG / config.name).write_text(toml_file(kept(tables)), encoding="utf-8")
        try:
            plan = prepare_laboratory(work / CONFIG / config.name)
        except (ConfigError, LayoutError) as error:
            prepare_laboratory(config)  # raises the same error if it is not for the lack of a file
            raise ConfigError(
                f"{error}; the FMU contains only files of {config.resolve().parent} with the endings "
                f"{', '.join(sorted(SUFFIXES))}; move the files that the instance needs "
                "into this folder, and give them one of these endings"
            ) from None
        with Laboratory(plan) as lab, lab.attach() as cell:
            groups, left_out = groups_of(lab, patterns)
            values = Values(groups)
            start = values.decode(values.encode({one.source: image_of(cell, one.source) for one in groups}))
        names = [name for one in groups for name in one.names]
        guid = "{" + hashlib.sha256("\n".join([*names, *(one.kind for one in groups)]).encode()).hexdigest()[:32] + "}"
        step_s = min(block.period_ns for block in plan.blocks) / 1e9
        description = "\n".join(_description(plan.instance, guid, groups, start, step_s)) + "\n"
        text, keys = without_secrets(kept(tables))
        (work / CONFIG / config.name).write_text(text, encoding="utf-8")
        manifest = Manifest(config.name, list(patterns), names)
        library = _compile(work, guid)
        _write(file, description, library, machine, manifest, work / CONFIG)
    inputs = sum(len(one.names) for one in groups if one.is_input)
    return Exported(inputs, len(names) - inputs, left_out, keys, secret)


def _copy(config: Path, tables: dict[str, Any], target: Path) -> list[str]:
    """Copy the files that an instance may need, but for those with secrets, which are returned.

    Raises:
        ConfigError: The files are too large, or cannot be read.

    """
    source, size, secret = config.parent, 0, list[str]()
    others = {file.resolve(): found for file in _files(source) if (found := _other_instance(file, config)) is not None}
    hidden = secret_files(tables, source).union(
        others, *(secret_files(found, file.parent) for file, found in others.items())
    )
    try:
        for file in _files(source):
            if file.resolve() in hidden:
                secret.append(str(file.relative_to(source)))
                continue
            size += file.stat().st_size
            if size > MAX_BYTES:
                raise ConfigError(
                    f"the files of {source} have more than {MAX_BYTES >> 20} MB; give the instance its own folder"
                )
            copy = target / file.relative_to(source)
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, copy)
    except OSError as error:
        raise ConfigError(f"{error.filename}: {error.strerror}") from None
    return secret


def _other_instance(file: Path, config: Path) -> dict[str, Any] | None:
    return read_instance(file) if file.suffix == ".toml" and file.resolve() != config else None


def _files(source: Path) -> Iterator[Path]:
    """Yield the files below a folder that an instance may need."""
    for folder, folders, files in os.walk(source):
        folders[:] = sorted(one for one in folders if one not in _SKIPPED and not one.startswith("."))
        for name in sorted(files):
            file = Path(folder) / name
            if file.suffix in SUFFIXES and not name.startswith(".") and file.is_file():
                yield file


def _compile(work: Path, guid: str) -> Path:
    """Compile the library.

    Raises:
        ConfigError: There is no C compiler, or the compiler fails.

    """
    source, library = work / "library.c", work / f"{IDENTIFIER}.so"
    source.write_bytes(resources.files("shmio.lab.fmu").joinpath("library.c").read_bytes())
    command = ["cc", "-std=c11", "-O2", "-shared", "-fPIC", "-fvisibility=hidden", f'-DSHMIO_GUID="{guid}"']
    try:
        done = subprocess.run(
            [*command, "-o", library, source], capture_output=True, text=True, check=False, timeout=COMPILE_S
        )
    except FileNotFoundError:
        raise ConfigError("the export needs a C compiler; install one (Debian: apt install gcc libc6-dev)") from None
    except subprocess.TimeoutExpired:
        raise ConfigError(f"the C compiler did not build the FMU's library within {COMPILE_S} s") from None
    if done.returncode:
        raise ConfigError(f"the C compiler cannot build the FMU's library: {done.stderr.strip()[-800:]}")
    return library


def _write(file: Path, description: str, library: Path, machine: str, manifest: Manifest, cell: Path) -> None:
    """Write the archive. It replaces an older file when it is complete.

    Raises:
        ConfigError: The file cannot be written.

    """
    new = file.with_name(f".{file.name}.{os.getpid()}")
    try:
        with zipfile.ZipFile(new, "x", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("modelDescription.xml", description)
            archive.write(library, f"binaries/{machine}/{IDENTIFIER}.so")
            archive.writestr(f"resources/{MANIFEST}", msgspec.json.encode(manifest))
            archive.writestr("resources/python", f"{sys.executable}\n")
            for one in sorted(cell.rglob("*")):
                if one.is_file() and "__pycache__" not in one.parts:
                    archive.write(one, f"resources/{CONFIG}/{one.relative_to(cell)}")
        new.rename(file)
    except OSError as error:
        new.unlink(missing_ok=True)
        raise ConfigError(f"{file}: {error.strerror}") from None


def _description(
    name: str, guid: str, groups: Sequence[Group], start: dict[str, list[Any]], step_s: float
) -> Iterator[str]:
    """Yield the lines of modelDescription.xml."""
    yield '<?xml version="1.0" encoding="UTF-8"?>'
    yield (
        f'<fmiModelDescription fmiVersion="2.0" modelName={quoteattr(name)} guid={quoteattr(guid)} '
        f'generationTool="shmio {__version__}" variableNamingConvention="flat">'
    )
    yield (
        f'  <CoSimulation modelIdentifier="{IDENTIFIER}" needsExecutionTool="true" '
        'canHandleVariableCommunicationStepSize="true" canNotUseMemoryManagementFunctions="true"/>'
    )
    units = sorted({one.register.unit for one in groups if one.kind == "Real" and one.register.unit})
    if units:
        yield "  <UnitDefinitions>"
        yield from (f"    <Unit name={quoteattr(unit)}/>" for unit in units)
        yield "  </UnitDefinitions>"
    yield '  <LogCategories><Category name="logStatusError"/></LogCategories>'
    yield f'  <DefaultExperiment startTime="0" stepSize="{step_s!r}"/>'
    yield "  <ModelVariables>"
    outputs: list[int] = []
    index = 0
    for one in groups:
        for place, path in enumerate(one.names):
            index += 1
            reference = one.first + place
            causality = "input" if one.is_input else "output"
            if not one.is_input:
                outputs.append(index)
            comment = f" description={quoteattr(one.register.comment)}" if one.register.comment else ""
            variability = "continuous" if one.kind == "Real" else "discrete"
            value = f" start={quoteattr(_text(start[one.kind][reference]))}" if one.is_input else ""
            unit = f" unit={quoteattr(one.register.unit)}" if one.kind == "Real" and one.register.unit else ""
            yield (
                f'    <ScalarVariable name={quoteattr(path)} valueReference="{reference}" causality="{causality}" '
                f'variability="{variability}"{comment}><{one.kind}{unit}{value}/></ScalarVariable>'
            )
    yield "  </ModelVariables>"
    yield "  <ModelStructure>"
    for tag in ("Outputs", "InitialUnknowns") if outputs else ():
        yield f"    <{tag}>"
        yield from (f'      <Unknown index="{one}"/>' for one in outputs)
        yield f"    </{tag}>"
    yield "  </ModelStructure>"
    yield "</fmiModelDescription>"


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return value if isinstance(value, str) else repr(value)
