"""Writes, reads, lists and deletes the files of snapshots.

A file has a header of 56 bytes (little-endian): the magic ``SHMIOSNP``, u32 version 1, u32 size of
the description, u64 size of the states, and the SHA-256 of description and states together. The
description follows as JSON, then the states as one MessagePack map from the name of each process to
bytes. A file gets its name only when it is complete; it then replaces an older file of that name.
"""

from __future__ import annotations

import fcntl
import hashlib
import heapq
import os
import re
import secrets
import shutil
import struct
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

import msgspec

from shmio.errors import SnapshotError
from shmio.local.state_requests import WORK, open_file, read_bounded, write_new
from shmio.model.snapshot import SnapshotInfo
from shmio.wording import unknown

SUFFIX: Final = ".snapshot"
VERSION: Final = 1
MAX_FILE_BYTES: Final = 512 << 20
MAX_HEAD_BYTES: Final = 1 << 20
MAX_LISTED: Final = 10_000
MAX_SUMMED_BYTES: Final = 64 << 20
"""Total size of the files whose checksums a list checks, the newest first, so that it takes little time."""
_MAGIC: Final = b"SHMIOSNP"
_HEADER: Final = struct.Struct("<8sIIQ32s")
_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,62}")
_STATES: Final = msgspec.msgpack.Decoder(dict[str, bytes])


class SnapshotHead(msgspec.Struct, forbid_unknown_fields=True):
    """The description of a snapshot. ``sources`` has the digest of each source's layout."""

    instance: str
    saved_s: float
    step: int
    done: int
    time_ns: int
    step_size_ns: int
    sources: dict[str, str]
    left_out: dict[str, str]


def check_name(name: str) -> None:
    """Raise SnapshotError if this cannot be the name of a snapshot."""
    if not _NAME.fullmatch(name):
        raise SnapshotError(f"{name!r:.80} cannot be a snapshot's name; use up to 63 letters, digits, '_', '-' and '.'")


def file_of(folder: Path, name: str) -> Path:
    """Return the path of a snapshot's file; raise SnapshotError if the snapshot's name is invalid."""
    check_name(name)
    return folder / f"{name}{SUFFIX}"


@contextmanager
def work_folder(folder: Path) -> Iterator[Path]:
    """Provide a work folder for states, inside the folder of snapshots, during a ``with`` block.

    Also remove work folders that killed programs have left. If the folder of snapshots did not exist
    and no snapshot is saved, remove it again: this program may run as another user than the
    instance, which could then not write to the folder.

    Raises:
        SnapshotError: The folder cannot be created.
    """
    new = not folder.exists()
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        _tidy(folder)
        work = folder / f".work-{secrets.token_hex(8)}"
        work.mkdir(mode=0o700)
        lock = os.open(work, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError as error:
        raise SnapshotError(f"{folder}: {error.strerror}") from None
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield work
    finally:
        shutil.rmtree(work, ignore_errors=True)
        os.close(lock)
        if new:
            with suppress(OSError):
                folder.rmdir()


def _tidy(folder: Path) -> None:
    for work in folder.iterdir():
        if not WORK.fullmatch(work.name):
            continue
        with suppress(OSError):
            lock = os.open(work, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(work)
            finally:
                os.close(lock)


def write_snapshot(file: Path, work: Path, head: SnapshotHead, states: Mapping[str, bytes]) -> SnapshotInfo:
    """Write a snapshot. If that fails, an older file of this name stays.

    Args:
        file: The new file.
        work: The work folder, in which the file is written first.
        head: The description.
        states: The states, by name of the process.

    Raises:
        SnapshotError: The states are too large, or the file cannot be written.
    """
    description, body = msgspec.json.encode(head), msgspec.msgpack.encode(dict(states))
    size = _HEADER.size + len(description) + len(body)
    if size > MAX_FILE_BYTES or len(description) > MAX_HEAD_BYTES:
        raise SnapshotError(f"the snapshot would have {size} bytes, more than {MAX_FILE_BYTES}")
    digest = hashlib.sha256(description + body).digest()
    header = _HEADER.pack(_MAGIC, VERSION, len(description), len(body), digest)
    new = work / file.name
    try:
        write_new(new, header, description, body, sync=True)
        new.rename(file)
        _sync_folder(file.parent)
    except OSError as error:
        raise SnapshotError(f"{file}: {error.strerror}; the snapshot was not saved") from None
    return _info(file, head, size)


def read_snapshot(file: Path) -> tuple[SnapshotInfo, SnapshotHead, dict[str, bytes]]:
    """Return a snapshot's information for programs, its description, and its states by process name.

    Raises:
        SnapshotError: There is no such snapshot, it is damaged, or another version has written it.
    """
    try:
        data = memoryview(read_bounded(file, MAX_FILE_BYTES))
    except OSError as error:
        raise _unreadable(file, error) from None
    head_size, body_size, digest = _sizes(file, bytes(data[: _HEADER.size]))
    if len(data) != _HEADER.size + head_size + body_size or hashlib.sha256(data[_HEADER.size :]).digest() != digest:
        raise SnapshotError(f"{file} is damaged: its checksum is wrong")
    head = _head(file, bytes(data[_HEADER.size : _HEADER.size + head_size]))
    try:
        states = _STATES.decode(data[_HEADER.size + head_size :])
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise SnapshotError(f"{file} is invalid: {error}") from None
    return _info(file, head, len(data)), head, states


def list_snapshots(folder: Path) -> list[SnapshotInfo]:
    """Return the snapshots of a folder, the oldest first; at most ``MAX_LISTED``, those of the newest files.

    If a snapshot is damaged, the ``problem`` of its entry says so. The checksums are checked for the newest
    files, up to ``MAX_SUMMED_BYTES`` in total; for the others, only the description and the size.

    Raises:
        SnapshotError: The folder cannot be read.
    """
    try:
        files = [file for file in folder.glob(f"*{SUFFIX}") if _NAME.fullmatch(file.stem)]
    except OSError as error:
        raise SnapshotError(f"{folder}: {error.strerror}") from None
    found, left = [], MAX_SUMMED_BYTES
    for file in heapq.nlargest(MAX_LISTED, files, _changed_ns):
        found.append(_listed(file, left))
        with suppress(OSError):
            left -= file.stat().st_size
    return sorted(found, key=lambda one: (one.saved_s, one.name))


def delete_snapshot(file: Path) -> None:
    """Delete a snapshot. Raise SnapshotError if there is none, or it cannot be deleted."""
    try:
        file.unlink()
    except OSError as error:
        raise _unreadable(file, error) from None


def _changed_ns(file: Path) -> int:
    try:
        return file.stat().st_mtime_ns
    except OSError:
        return 0


def _listed(file: Path, summed_bytes: int) -> SnapshotInfo:
    """Return the entry of a file in a list. Check its checksum if it has at most ``summed_bytes``."""
    try:
        with open_file(file) as stream:
            head_size, body_size, digest = _sizes(file, stream.read(_HEADER.size))
            description = stream.read(head_size)
            size = os.fstat(stream.fileno()).st_size
            if size != _HEADER.size + head_size + body_size:
                raise SnapshotError(f"{file} is damaged: it has {size} bytes")
            if size <= summed_bytes and hashlib.sha256(description + stream.read(body_size)).digest() != digest:
                raise SnapshotError(f"{file} is damaged: its checksum is wrong")
        head = _head(file, description)
        return _info(file, head, size)
    except OSError as error:
        return SnapshotInfo(file.stem, problem=f"{file}: {error.strerror}")
    except SnapshotError as error:
        return SnapshotInfo(file.stem, problem=str(error))


def _sizes(file: Path, header: bytes) -> tuple[int, int, bytes]:
    """Return the sizes of description and states, and their digest, from a file's first bytes."""
    if len(header) < _HEADER.size or header[: len(_MAGIC)] != _MAGIC:
        raise SnapshotError(f"{file} is not a snapshot")
    _, version, head_size, body_size, digest = _HEADER.unpack(header)
    if version != VERSION:
        raise SnapshotError(f"{file} has version {version} of the format, and this shmio knows version {VERSION}")
    if head_size > MAX_HEAD_BYTES or body_size > MAX_FILE_BYTES:
        raise SnapshotError(f"{file} is damaged: its sizes are wrong")
    return head_size, body_size, digest


def _head(file: Path, data: bytes) -> SnapshotHead:
    try:
        return msgspec.json.decode(data, type=SnapshotHead)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise SnapshotError(f"{file} is invalid: {error}") from None


def _info(file: Path, head: SnapshotHead, size: int) -> SnapshotInfo:
    name = file.name.removesuffix(SUFFIX)
    return SnapshotInfo(name, head.instance, head.saved_s, head.time_ns, head.step, size, head.left_out)


def _unreadable(file: Path, error: OSError) -> SnapshotError:
    if isinstance(error, FileNotFoundError):
        name = file.name.removesuffix(SUFFIX)
        names = [one.name for one in list_snapshots(file.parent)]
        return SnapshotError(f"{file.parent}: {unknown('snapshot', name, names)}")
    return SnapshotError(f"{file}: {error.strerror}")


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
