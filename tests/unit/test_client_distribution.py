"""The distribution shmio-client: its files suffice, and it demands what shmio demands."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
IMPORT_ALL = """
import importlib, pkgutil, sys
from pathlib import Path
sys.path[:0] = sys.argv[1:]
from client_alone import Refuser
sys.meta_path.insert(0, Refuser())
import shmio
assert Path(shmio.__file__).is_relative_to(sys.argv[1])
for module in pkgutil.walk_packages(shmio.__path__, "shmio."):
    if not module.name.endswith("_pb2_grpc"):
        importlib.import_module(module.name)
        print(module.name)
"""


def project(file: Path) -> dict[str, Any]:
    return dict(tomllib.loads(file.read_text())["project"])


def test_each_module_imports_without_the_rest_of_shmio(tmp_path: Path) -> None:
    for name in (ROOT / "packaging/client/files.txt").read_text().split():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(ROOT / name, tmp_path / name)
    done = subprocess.run(
        [sys.executable, "-P", "-c", IMPORT_ALL, tmp_path, ROOT / "tests/conformance"],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        cwd=tmp_path,
    )
    assert done.stderr == ""
    assert {"shmio.cli.user", "shmio.client.sync.client", "shmio.wire.shmio_v1_pb2"} <= set(done.stdout.split())


def test_version_and_bounds_are_those_of_shmio() -> None:
    whole, client = project(ROOT / "pyproject.toml"), project(ROOT / "packaging/client/pyproject.toml")
    for key in ("version", "requires-python", "license"):
        assert client[key] == whole[key]
    assert set(client["dependencies"]) <= set(whole["dependencies"])
    assert client["scripts"].items() <= whole["scripts"].items()
