"""The bundle of a search: all files that its trials need, for workers without access to these files.

It has a reduced configuration, the files that the configuration names for its sources, the Python
files in the folders of models, the campaign's snapshot and recordings, and what the user adds. The
files keep their places relative to each other. The name of a bundle is its SHA-256.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path, PurePosixPath
from typing import Any, Final

import msgspec
import zstandard

from shmio.config.read import load, read_tables
from shmio.config.toml import toml_file
from shmio.errors import ConfigError, RemoteError
from shmio.local.snapshot_file import file_of
from shmio.simulation.fmu import is_fmu

MAX_BYTES: Final = 256 << 20
"""Maximum size of all files of a bundle together."""
MAX_FILES: Final = 10_000
MAX_UNPACKED_BYTES: Final = MAX_BYTES + (16 << 20)
"""Maximum size of a bundle with the files' paths."""
MAX_VISITED: Final = 100_000
"""Maximum number of entries of the folders that are searched for files."""
LEFT_OUT: Final = frozenset({"__pycache__", "node_modules", "site-packages"})
"""Names of folders in which no files are searched."""
INSTANCE_KEYS: Final = ("name", "ring_mb", "clock")
"""Keys of ``[instance]`` that matter to a trial."""
SNAPSHOTS: Final = "snapshots"
"""Folder of the snapshot beside the configuration in the bundle."""


class _Packed(msgspec.Struct):
    """What is in a bundle: the content of each file, by its path relative to the root."""

    files: dict[str, bytes]


class Bundle(msgspec.Struct, frozen=True):
    """A bundle, and where its files come from.

    Attributes:
        data: The bundle.
        root: Folder on this host that contains all files; their paths are relative to it.
        config: Path of the configuration.
        folder: Path of the campaign's folder.
        sizes: Size of each file in bytes, by its path.
        likes: For recordings that the campaign names by absolute paths, their paths relative to the
            campaign's folder.

    """

    data: bytes
    root: str
    config: str
    folder: str
    sizes: dict[str, int]
    likes: dict[str, str]

    @property
    def digest(self) -> str:
        """SHA-256 of the bundle, in hexadecimal digits."""
        return hashlib.sha256(self.data).hexdigest()

    def portable(self, tables: dict[str, Any]) -> dict[str, Any]:
        """Return a campaign's tables without absolute paths of this host."""
        expect = [{**one, "like": self.likes.get(one["like"], one["like"])} if "like" in one else one
                  for one in tables["expect"]]  # fmt: skip
        return {**tables, "expect": expect}


def make_bundle(config: Path, campaign: Path, tables: Mapping[str, Any], more: Iterable[Path] = ()) -> Bundle:
    """Collect the files of a search.

    Args:
        config: The ``supervisor.toml``.
        campaign: The campaign file.
        tables: The campaign's tables.
        more: Further files, and folders with all files in them.

    Raises:
        ConfigError: A file cannot be read, or they are too many or too large.

    """
    config, folder = config.resolve(), campaign.resolve().parent
    files: dict[Path, Path] = {}  # by their places in the bundle; they can be symbolic links
    reduced = _reduced(config, files)
    likes: dict[str, str] = {}
    for text in dict.fromkeys(one["like"] for one in tables["expect"] if "like" in one):
        place = Path(os.path.normpath(folder / text))
        files[place] = place
        if Path(text).is_absolute():
            likes[text] = os.path.relpath(place, folder)
    if "start" in tables:
        snapshot = file_of(load(config).snapshot_dir, tables["start"])
        files[config.parent / SNAPSHOTS / snapshot.name] = snapshot
    for path in more:
        place = Path(os.path.normpath(path.absolute()))
        if not place.exists():
            raise ConfigError(f"--send {path}: there is no such file or folder")
        files.update((one, one) for one in (_below(place, "--send") if place.is_dir() else [place]))
    files.pop(config, None)
    root = Path(os.path.commonpath([config.parent, folder, *(one.parent for one in files)]))
    packed = {config.relative_to(root).as_posix(): toml_file(reduced).encode()}
    left = MAX_BYTES - sum(map(len, packed.values()))
    for place, file in sorted(files.items()):
        try:
            with file.open("rb") as stream:
                content = stream.read(left + 1)
        except OSError as error:
            raise ConfigError(f"{file}: {error.strerror}") from None
        left -= len(content)
        if left < 0 or len(packed) >= MAX_FILES:
            raise ConfigError(
                f"--farm: the files for the workers are more than {MAX_FILES}, or larger than {MAX_BYTES >> 20} MB, "
                f"such as {file}; put the models into a folder of their own, and name it with the key folder"
            )
        packed[place.relative_to(root).as_posix()] = content
    packed = dict(sorted(packed.items()))
    return Bundle(
        zstandard.compress(msgspec.msgpack.encode(_Packed(packed))),
        str(root),
        config.relative_to(root).as_posix(),
        folder.relative_to(root).as_posix(),
        {path: len(content) for path, content in packed.items()},
        likes,
    )


def _reduced(config: Path, files: dict[Path, Path]) -> dict[str, Any]:
    """Return the tables of the configuration that a laboratory uses, and add the files that they name.

    Endpoints, alerts and emulators stay out, with their passwords and tokens.
    """
    tables = read_tables(config)
    home = config.parent

    def named(text: str, base: Path = home) -> str:
        """Add a file, and return its path relative to the configuration."""
        file = (base / text).resolve()
        files[file] = file
        return os.path.relpath(file, base)

    instance = {key: tables["instance"][key] for key in INSTANCE_KEYS if key in tables["instance"]}
    found: dict[str, Any] = {"instance": {**instance, "snapshot_dir": SNAPSHOTS, "audit": False}, "source": []}
    for table in tables["source"]:
        source = {key: value for key, value in table.items() if key != "realtime_priority"}
        for key in ("layout", "tags", "properties"):
            if key in source:
                paths = source[key]
                source[key] = named(paths) if isinstance(paths, str) else [named(one) for one in paths]
        model = source.get("model")
        if source["connector"] == "simulation" and isinstance(model, str):
            folder = (home / source.get("folder", ".")).resolve()
            source["folder"] = os.path.relpath(folder, home)
            if is_fmu(model):
                source["model"] = named(model, folder)
            elif _contains(folder, model):
                files.update((file, file) for file in _below(folder, f"source {source['name']!r}", ".py"))
        found["source"].append(source)
    if "injection" in tables:
        found["injection"] = tables["injection"]
    return found


def _contains(folder: Path, model: str) -> bool:
    """Return whether the folder has the module of a model. Otherwise it is installed."""
    top = model.partition(":")[0].partition(".")[0]
    return (folder / f"{top}.py").is_file() or (folder / top).is_dir()


def _below(folder: Path, what: str, suffix: str = "") -> Iterator[Path]:
    """Yield the files in a folder and the folders below, without hidden ones and virtual environments."""
    visited = 0
    for place, folders, names in os.walk(folder):
        if "pyvenv.cfg" in names:
            folders.clear()
            continue
        folders[:] = sorted(one for one in folders if one not in LEFT_OUT and not one.startswith("."))
        visited += len(folders) + len(names)
        if visited > MAX_VISITED:
            raise ConfigError(
                f"{what}: {folder} has more than {MAX_VISITED} files; put what the workers need into another folder"
            )
        for name in sorted(names):
            file = Path(place) / name
            if name.endswith(suffix) and not name.startswith(".") and file.is_file():
                yield file


def unpack(data: bytes, place: Path) -> int:
    """Write the files of a bundle into a new folder; return their number.

    Args:
        data: The bundle.
        place: The folder, which nobody else can write.

    Raises:
        RemoteError: The bundle is damaged or too large, or has a path outside of the folder.

    """
    try:
        content = bytearray()
        with zstandard.ZstdDecompressor().stream_reader(data) as stream:
            while part := stream.read(1 << 20):
                content += part
                if len(content) > MAX_UNPACKED_BYTES:
                    raise RemoteError(f"the bundle of files is larger than {MAX_UNPACKED_BYTES >> 20} MB")
        files = msgspec.msgpack.decode(content, type=_Packed).files
    except (zstandard.ZstdError, msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise RemoteError(f"the bundle of files is damaged: {error}") from None
    if len(files) > MAX_FILES:
        raise RemoteError(f"the bundle has {len(files)} files, more than {MAX_FILES}")
    place.mkdir(mode=0o700)
    for path, one in files.items():
        file = place_in(place, path)
        try:
            file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            with open(file, "xb", opener=_private) as stream:
                stream.write(one)
        except OSError as error:
            raise RemoteError(f"{file}: {error.strerror}: the bundle of files cannot be unpacked") from None
    return len(files)


def place_in(folder: Path, path: str) -> Path:
    """Return the place of a path inside a folder. The path ``.`` is the folder itself.

    Raises:
        RemoteError: The path is not in its shortest form, or leads out of the folder.

    """
    parts = PurePosixPath(path).parts
    if "\0" in path or path != ("/".join(parts) or ".") or any(part in ("..", "/") for part in parts):
        raise RemoteError(f"the bundle has the path {path!r:.200}, which does not lead into its folder")
    return folder.joinpath(*parts)


def _private(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NOFOLLOW, 0o600)
