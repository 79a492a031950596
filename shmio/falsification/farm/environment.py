"""Compares what the results of a trial depend on besides its files: shmio, Python, packages, the machine.

As a program (``python -m``), it prints the environment of a configuration's trials as JSON. It loads
the models for that in a fresh process, so that only the packages that trials import count.
"""

from __future__ import annotations

import hashlib
import os
import platform
import subprocess
import sys
import tempfile
from functools import cache
from importlib.metadata import PackageNotFoundError, packages_distributions, version
from pathlib import Path
from typing import Final, NamedTuple

import msgspec

import shmio
from shmio.errors import ConfigError, ShmioError
from shmio.falsification.farm.bundle import Bundle, unpack
from shmio.lab import Laboratory, prepare_laboratory
from shmio.version import __version__

START_S: Final = 120.0
"""Maximum time in s to load the models."""
_BESIDES: Final = ("shmio", "Python", "machine")
"""Entries of an environment that are no packages."""


@cache
def own() -> dict[str, str]:
    """Return the part of this process's environment that all trials depend on."""
    code = hashlib.sha256()
    folder = Path(shmio.__file__).parent
    for file in sorted(folder.rglob("*.py")):
        code.update(f"{file.relative_to(folder)}\0".encode() + file.read_bytes())
    python = ".".join(platform.python_version_tuple()[:2])
    values = f"{__version__} (code {code.hexdigest()[:12]})", python, platform.machine()
    return dict(zip(_BESIDES, values, strict=True))


class Survey(NamedTuple):
    """The environment of trials, and why the models do not start from the files of a bundle; empty if they do."""

    environment: dict[str, str]
    problem: str


def environment_of(bundle: Bundle) -> Survey:
    """Return the environment of trials, and check that a bundle has all files to load the models.

    Raises:
        ConfigError: A file is missing.

    """
    with tempfile.TemporaryDirectory(prefix="shmio-") as folder:
        unpack(bundle.data, Path(folder) / "files")
        return _load(Path(folder) / "files" / bundle.config)


def _load(config: Path) -> Survey:
    """Load the models of a configuration in a process of their own."""
    command = [sys.executable, "-P", "-m", "shmio.falsification.farm.environment", str(config)]
    try:
        done = subprocess.run(command, cwd=config.parent, capture_output=True, timeout=START_S, check=False)
    except subprocess.TimeoutExpired:
        raise ConfigError(f"{config}: loading the models takes more than {START_S:g} s") from None
    try:
        return msgspec.json.decode(done.stdout, type=Survey)
    except msgspec.MsgspecError:
        last = done.stderr.decode(errors="replace").strip() or f"its process ended with status {done.returncode}"
        raise ConfigError(
            f"--farm: the files for the workers are not complete; name what is missing with --send: {last}"
        ) from None


def differences(wanted: dict[str, str], host: str) -> list[str]:
    """Return a text for each entry of an environment that is different on this host.

    Args:
        wanted: The environment of the trials.
        host: Name of the host of the search.

    """
    here = own()
    texts = []
    for name, there in wanted.items():
        found = here.get(name) if name in _BESIDES else _version(name)
        if found != there:
            texts.append(f"{name} is {found or 'not installed'} here, but {there} on {host}")
    return texts


def _version(package: str) -> str | None:
    try:
        return version(package)
    except (PackageNotFoundError, ValueError):
        return None


def _packages() -> dict[str, str]:
    """Return the versions of the packages of which this process has imported modules."""
    of_module = packages_distributions()
    tops = {name.partition(".")[0] for name in sys.modules}
    # Underscores begin modules that Python's start imports, such as setuptools' _distutils_hack.
    names = {of_module[top][0] for top in tops if len(set(of_module.get(top, ()))) == 1 and not top.startswith("_")}
    return {name: version(name) for name in sorted(names - {"shmio"})}


def main() -> int:
    """Print the environment of the configuration that is named by the only argument."""
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # what models print must not get into the answer
    try:
        instance = prepare_laboratory(Path(sys.argv[1]))
    except ShmioError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    problem = ""
    try:
        with Laboratory(instance) as lab, lab.attach() as cell:
            cell.step(0.001)
    except ShmioError as error:  # perhaps only because the models need the campaign's parameters
        problem = str(error)
    answers.write(msgspec.json.encode(Survey(own() | _packages(), problem)))
    answers.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
