"""Bundles: what is sent, what is not, and what a worker refuses."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import msgspec
import pytest
import zstandard

from shmio.errors import ConfigError, RemoteError
from shmio.falsification.farm import bundle as bundles
from shmio.falsification.farm.bundle import Bundle, make_bundle, unpack

CONFIG = """
[instance]
name = "farm-test"
clock = "stepped"
log_dir = "/nowhere"

[[source]]
name = "lift"
connector = "simulation"
model = "lift:Lift"
folder = "models"
parameters = {{ "héight" = 1.5, list = [1, -2.5], yes = true }}

[[source]]
name = "panel"
connector = "memory"
layout = ["{folder}/shared/panel.toml"]

[[source]]
name = "motor"
connector = "simulation"
model = "../../shared/motor.fmu"
folder = "models"

[[grpc.token]]
name = "boss"
roles = ["write"]
token_file = "secret.txt"
"""
TABLES: dict[str, Any] = {"expect": [{"name": "one", "always": "lift/height < 1"}]}


@pytest.fixture
def cell(tmp_path: Path) -> Path:
    for name, text in (
        ("cell/supervisor.toml", CONFIG.format(folder=tmp_path)),
        ("cell/secret.txt", "a secret"),
        ("cell/other.py", "nothing"),
        ("cell/models/lift.py", "class Lift: ..."),
        ("cell/models/parts/cable.py", "length = 1"),
        ("cell/models/data.csv", "1"),
        ("cell/models/.hidden/x.py", ""),
        ("cell/models/__pycache__/lift.py", ""),
        ("cell/models/venv/pyvenv.cfg", ""),
        ("cell/models/venv/lib/big.py", ""),
        ("shared/panel.toml", "[registers]"),
        ("shared/motor.fmu", "zip"),
        ("campaigns/like.mem", "recording"),
    ):
        file = tmp_path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    return tmp_path


def made(cell: Path, tables: dict[str, Any] = TABLES, *more: Path) -> Bundle:
    return make_bundle(cell / "cell/supervisor.toml", cell / "campaigns/campaign.toml", tables, more)


def test_a_bundle_has_what_the_sources_name_and_no_secrets(cell: Path, tmp_path: Path) -> None:
    like = {"name": "two", "like": "like.mem", "register": "lift/height"}
    bundle = made(cell, {"expect": [*TABLES["expect"], like]}, cell / "cell/models/data.csv")
    assert [*bundle.sizes] == [
        "campaigns/like.mem",
        "cell/models/data.csv",
        "cell/models/lift.py",
        "cell/models/parts/cable.py",
        "cell/supervisor.toml",
        "shared/motor.fmu",
        "shared/panel.toml",
    ]
    assert (bundle.root, bundle.config, bundle.folder) == (str(cell), "cell/supervisor.toml", "campaigns")
    place = tmp_path / "private/place"
    place.parent.mkdir()
    assert unpack(bundle.data, place) == 7
    assert {one.relative_to(place).as_posix() for one in place.rglob("*") if one.is_file()} == {*bundle.sizes}
    assert place.stat().st_mode & 0o077 == 0
    tables = tomllib.loads((place / bundle.config).read_text())
    assert set(tables) == {"instance", "source"}, "no endpoint, and no folder of this host"
    assert tables["instance"]["clock"] == "stepped"
    assert "log_dir" not in tables["instance"]
    assert tables["source"][0]["parameters"] == {"héight": 1.5, "list": [1, -2.5], "yes": True}
    assert tables["source"][1]["layout"] == ["../shared/panel.toml"]
    assert tables["source"][2]["model"] == "../../shared/motor.fmu"
    assert made(cell).digest == made(cell).digest != bundle.digest


def test_absolute_paths_of_recordings_become_relative(cell: Path) -> None:
    tables = {"expect": [{"name": "two", "like": str(cell / "campaigns/like.mem"), "register": "lift/height"}]}
    bundle = made(cell, tables)
    assert "campaigns/like.mem" in bundle.sizes
    assert bundle.portable(tables)["expect"][0]["like"] == "like.mem"
    assert tables["expect"][0]["like"].startswith("/"), "the search's own tables stay"


@pytest.mark.parametrize(
    "path", ["../x", "/tmp/x", "a/../../x", "..", ".", "", "a//b", "a/./b", "a/", "\0", "a" * 300, "x" + "/y" * 3000]
)
def test_paths_outside_of_the_folder_are_refused(tmp_path: Path, path: str) -> None:
    data = zstandard.compress(msgspec.msgpack.encode({"files": {path: b"evil"}}))
    with pytest.raises(RemoteError):
        unpack(data, tmp_path / "place")
    assert [one for one in tmp_path.rglob("*") if one.is_file()] == []


def test_damaged_and_huge_bundles_are_refused(cell: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = made(cell).data
    for number, bad in enumerate(
        [b"", b"x" * 100, data[:-5], zstandard.compress(b"\xc1"), data[:9] + b"~" + data[10:]]
    ):
        with pytest.raises(RemoteError, match="damaged"):
            unpack(bad, tmp_path / f"bad{number}")
    monkeypatch.setattr(bundles, "MAX_UNPACKED_BYTES", 1 << 20)
    with pytest.raises(RemoteError, match="larger than 1 MB"):
        unpack(zstandard.compress(bytes(50 << 20)), tmp_path / "huge")
    both = zstandard.compress(msgspec.msgpack.encode({"files": {"a": b"1", "a/b": b"2"}}))
    with pytest.raises(RemoteError, match="cannot be unpacked"):
        unpack(both, tmp_path / "both")


def test_too_much_is_refused_before_it_is_sent(cell: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match="--send"):
        made(cell, TABLES, cell / "nothing")
    (cell / "shared/motor.fmu").unlink()
    with pytest.raises(ConfigError, match=r"motor\.fmu: No such file"):
        made(cell)
    (cell / "shared/motor.fmu").write_bytes(bytes(2500))
    monkeypatch.setattr(bundles, "MAX_BYTES", 2500)
    with pytest.raises(ConfigError, match="key folder"):
        made(cell)
    monkeypatch.undo()
    monkeypatch.setattr(bundles, "MAX_VISITED", 3)
    with pytest.raises(ConfigError, match="more than 3 files"):
        made(cell)
