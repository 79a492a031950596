"""FMUs for tests: built from C, against the headers of FMPy, and from Python by pythonfmu3."""

from __future__ import annotations

import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Final

import fmpy
from fmpy.fmi2 import FMU2Slave
from fmpy.fmi3 import FMU3Slave

HERE: Final = Path(__file__).parent
HEADERS: Final = Path(fmpy.__file__).parent / "c-code"
CLASSES: Final = {2: FMU2Slave, 3: FMU3Slave}


def build(name: str, folder: Path, change: Callable[[str], str] = str) -> Path:
    """Build an FMU of ``name.c`` and ``name.xml``, and return its file.

    Args:
        name: Name of the files. It ends in the version of FMI.
        folder: The folder for the FMU.
        change: Changes the description.

    """
    version = int(name[-1])
    # FMPy wants all functions: those that the file does not define return an error.
    names = [attribute for attribute in dir(CLASSES[version]) if attribute.startswith(f"fmi{version}")]
    stubs = folder / f"{name}-stubs.c"
    stubs.write_text("".join(f"__attribute__((weak)) int {one}(void) {{ return 3; }}\n" for one in names))
    library = folder / f"{name}.so"
    command = ["cc", "-shared", "-fPIC", "-O2", f"-I{HEADERS}", "-o", library, HERE / f"{name}.c", stubs, "-lm"]
    subprocess.run([str(part) for part in command], check=True, capture_output=True)
    file = folder / f"{name}.fmu"
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("modelDescription.xml", change((HERE / f"{name}.xml").read_text()))
        archive.write(library, f"binaries/{fmpy.platform if version == 2 else fmpy.platform_tuple}/{name}.so")
    return file


def edited(fmu: Path, file: Path, edit: Callable[[str], str]) -> Path:
    """Write an FMU with an edited description and all else of another one, and return its file."""
    with zipfile.ZipFile(fmu) as old, zipfile.ZipFile(file, "w") as new:
        for name in old.namelist():
            data = old.read(name)
            new.writestr(name, edit(data.decode()) if name == "modelDescription.xml" else data)
    return file


def build_oven(folder: Path) -> Path:
    """Build an FMU of ``oven.py`` by pythonfmu3, and return its file."""
    command = [sys.executable, "-m", "pythonfmu3", "build", "-f", HERE / "oven.py", "-d", folder]
    subprocess.run([str(part) for part in command], check=True, capture_output=True)
    return folder / "Oven.fmu"
