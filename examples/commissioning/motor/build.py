"""Builds motor.fmu from motor.c and modelDescription.xml, with a C compiler and the FMI headers that FMPy has."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

import fmpy

HERE = Path(__file__).parent
HEADERS = Path(fmpy.__file__).parent / "c-code"


def main() -> None:
    """Write the FMU beside supervisor.toml."""
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "motor.so"
        compiler = shlex.split(os.environ.get("CC", "cc"))
        command = [*compiler, "-shared", "-fPIC", "-O2", f"-I{HEADERS}", "-o", str(library), str(HERE / "motor.c")]
        try:
            subprocess.run(command, check=True)
        except (OSError, subprocess.CalledProcessError) as error:
            sys.exit(f"motor.fmu: the C compiler failed: {error}; install one (Debian: apt install gcc libc6-dev)")
        with zipfile.ZipFile(HERE.parent / "motor.fmu", "w") as fmu:
            fmu.write(HERE / "modelDescription.xml", "modelDescription.xml")
            fmu.write(library, f"binaries/{fmpy.platform}/motor.so")


if __name__ == "__main__":
    main()
