"""``shmio-supervisor export-fmu``: exports an instance as an FMU for co-simulation."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from shmio.cli.common import say
from shmio.cli.target import config_file
from shmio.lab.fmu.archive import export_fmu as export
from shmio.wording import printable

SHOWN = 10


def export_fmu(arguments: argparse.Namespace) -> int:
    """Write the FMU, and print what it contains.

    Raises:
        ConfigError: The instance cannot be exported.
        LayoutError: A layout cannot be compiled.
        PathError: A pattern matches no register.

    """
    file: Path = arguments.output
    done = export(config_file(arguments), file, arguments.only)
    for names, why in (
        (done.left_out, "FMI 2.0 has no such types"),
        (done.secret_files, "they may have secrets"),
        (done.secret_keys, "their values may be secret, and the FMU asks for them"),
    ):
        if names:
            more = len(names) - SHOWN
            shown = ", ".join(names[:SHOWN]) + (f" and {more} more" if more > 0 else "")
            say(f"left out, because {why}: {shown}", sys.stderr)
    print(printable(f"wrote {file}: {done.inputs} inputs, {done.outputs} outputs"))
    return 0
