"""Installs a package with a connector into a virtual environment of its own, without a network."""

from __future__ import annotations

import shutil
import site
import subprocess
import sys
import venv
from pathlib import Path

PATIENCE_S = 110.0


class Environment:
    """A virtual environment that has one package more than the environment of the tests, and can import theirs."""

    def __init__(self, folder: Path, package: Path) -> None:
        """Make the environment in a folder, and install a copy of the package."""
        venv.create(folder, symlinks=True)
        self._python = folder / "bin" / "python"
        self.package = folder / "package"
        shutil.copytree(package, self.package, ignore=shutil.ignore_patterns("build", "*.egg-info", "__pycache__"))
        (own,) = (folder / "lib").glob("python*/site-packages")
        lines = [f"import site; site.addsitedir({path!r})\n" for path in site.getsitepackages()]
        (own / "tests.pth").write_text("".join(lines))
        offline = ["--no-index", "--no-build-isolation", "--no-deps", "--disable-pip-version-check"]
        self.run("-m", "pip", "install", "--quiet", *offline, str(self.package))
        assert next(own.glob("shmio_*.dist-info")), "the package is not installed in its own environment"

    def run(self, *arguments: str) -> str:
        """Run the environment's Python in the package's folder; return what it prints.

        Raises:
            AssertionError: It failed. The message has its output.

        """
        done = subprocess.run(
            [self._python, *arguments],
            cwd=self.package,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=PATIENCE_S,
            check=False,
        )
        assert done.returncode == 0, f"{sys.executable} {' '.join(arguments)}\n{done.stdout}"
        return done.stdout
