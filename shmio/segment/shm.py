"""A POSIX shared-memory object: create, open, lock, map and unlink. Linux only.

This module uses posix-ipc. With ``multiprocessing.shared_memory``, a process that has attached to a
segment would unlink it at the process's end, even if others still use the segment.
"""

from __future__ import annotations

import errno
import fcntl
import grp
import mmap
import os
import pwd
import struct
from contextlib import suppress

import posix_ipc

from shmio.errors import SegmentError

DIRECTORY = "/dev/shm"  # noqa: S108  where Linux keeps POSIX shared memory, shm_overview(7)
_FLOCK = "@hhqqi4x"  # struct flock of 64-bit Linux: type, whence, start, length, pid


class SharedObject:
    """An open shared-memory object with its mapping and its byte locks.

    The locks are *open file description* locks (fcntl(2)). The kernel releases them when the
    process dies, for whatever reason. They belong to this Python object, not to the process: two
    objects in one process cannot lock the same byte.
    """

    def __init__(self, name: str, fd: int, *, writable: bool, private: bool = False) -> None:
        self.name = name
        self._path = f"{DIRECTORY}/{name}"
        self.writable = writable
        self.is_private = private
        """True if only this process can use the memory. The object's file then has only locks."""
        self.inode = os.fstat(fd).st_ino
        self._fd = fd
        self._held: set[int] = set()
        self._map: mmap.mmap | None = None

    @classmethod
    def create(cls, name: str, group: str | None = None) -> SharedObject:
        """Create an empty object with mode 0600; if ``group`` is not None, with this group and mode 0640.

        Raises:
            FileExistsError: An object of this name exists already.
        """
        try:
            memory = posix_ipc.SharedMemory(f"/{name}", posix_ipc.O_CREX, mode=0o600)
        except posix_ipc.ExistentialError:
            raise FileExistsError(name) from None
        except OSError as error:
            raise SegmentError(f"cannot create shared memory {name}: {error.strerror}") from None
        shared = cls(name, memory.fd, writable=True)
        if group is not None:
            try:
                os.fchown(memory.fd, -1, grp.getgrnam(group).gr_gid)
                os.fchmod(memory.fd, 0o640)
            except (KeyError, OSError) as error:
                shared.close()
                unlink(name)
                reason = "no such group" if isinstance(error, KeyError) else error.strerror
                raise SegmentError(f"instance.group: cannot give the segment to group {group!r}: {reason}") from None
        return shared

    @classmethod
    def private(cls, name: str) -> SharedObject:
        """Create an empty object that no other program can open, and that is freed after its last use."""
        return cls(name, os.memfd_create(name, os.MFD_CLOEXEC), writable=True, private=True)

    @classmethod
    def open(cls, name: str, *, writable: bool = False) -> SharedObject:
        """Open an existing object.

        Raises:
            FileNotFoundError: There is no object of this name.
            SegmentError: This user may not open the object, or does not trust its owner.
        """
        try:
            memory = posix_ipc.SharedMemory(f"/{name}", 0, read_only=not writable)
        except posix_ipc.ExistentialError:
            raise FileNotFoundError(name) from None
        except (posix_ipc.PermissionsError, PermissionError):
            raise SegmentError(
                f"no permission to open segment {name}: it belongs to another user; see instance.group"
            ) from None
        except (posix_ipc.Error, OSError, ValueError) as error:
            raise SegmentError(f"cannot open shared memory {name}: {error}") from None
        shared = cls(name, memory.fd, writable=writable)
        try:
            _require_trusted(name, os.fstat(memory.fd))
        except SegmentError:
            shared.close()
            raise
        return shared

    def again(self) -> SharedObject:
        """Open a private object once more, with locks of its own."""
        fd = os.open(f"/proc/self/fd/{self._fd}", os.O_RDWR | os.O_CLOEXEC)
        again = SharedObject(self.name, fd, writable=True, private=True)
        again._map = self._map
        return again

    def allocate(self, size: int) -> None:
        """Reserve memory for the first ``size`` bytes, so that no process gets SIGBUS later.

        Raises:
            SegmentError: There is no room in shared memory.
        """
        if self.is_private:
            self._map = _private_memory(self.name, size)
            return
        try:
            os.posix_fallocate(self._fd, 0, size)
        except OSError as error:
            if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.ENOMEM):
                raise
            free = os.statvfs(DIRECTORY)
            raise SegmentError(
                f"{DIRECTORY} has no room for the segment: {size / 1e6:.1f} MB needed, "
                f"{free.f_bavail * free.f_frsize / 1e6:.1f} MB free; enlarge it (docker: --shm-size) "
                "or lower instance.ring_mb"
            ) from None

    @property
    def size(self) -> int:
        """Present size of the object, in bytes."""
        if self.is_private:
            return 0 if self._map is None else len(self._map)
        return os.fstat(self._fd).st_size

    def map(self) -> mmap.mmap:
        """Map the whole object, read-only unless it was opened writable.

        All calls return the same mapping until the object grows. A mapping from before then stays
        valid as long as it is referenced.
        """
        if self._map is None or len(self._map) < self.size:
            access = mmap.PROT_READ | (mmap.PROT_WRITE if self.writable else 0)
            self._map = mmap.mmap(self._fd, self.size, mmap.MAP_SHARED, access)
        return self._map

    def try_lock(self, byte: int) -> bool:
        """Lock a byte until this object is closed; return False if another object has locked it."""
        try:
            fcntl.fcntl(self._fd, fcntl.F_OFD_SETLK, struct.pack(_FLOCK, fcntl.F_WRLCK, os.SEEK_SET, byte, 1, 0))
        except OSError as error:
            if error.errno in (errno.EAGAIN, errno.EACCES):
                return False
            raise
        self._held.add(byte)
        return True

    def unlock(self, byte: int) -> None:
        """Release the lock on a byte."""
        self._held.discard(byte)
        fcntl.fcntl(self._fd, fcntl.F_OFD_SETLK, struct.pack(_FLOCK, fcntl.F_UNLCK, os.SEEK_SET, byte, 1, 0))

    def locked(self, byte: int) -> bool:
        """Return whether another object has locked the byte. This works even if this object is read-only."""
        query = struct.pack(_FLOCK, fcntl.F_RDLCK, os.SEEK_SET, byte, 1, 0)
        answer = fcntl.fcntl(self._fd, fcntl.F_OFD_GETLK, query)
        kind: int = struct.unpack(_FLOCK, answer)[0]
        return kind != fcntl.F_UNLCK

    def taken(self, byte: int) -> bool:
        """Return whether any object, including this one, has locked the byte."""
        return byte in self._held or self.locked(byte)

    def current(self) -> bool:
        """Return whether the name still refers to this object.

        Return False if the name was removed, or belongs to a new object. A private object, which has
        no name, is always current.
        """
        if self.is_private:
            return True
        try:
            return os.fstat(self._fd).st_nlink > 0  # faster than the path, and each step of time asks
        except OSError:  # this object is closed
            with suppress(FileNotFoundError):
                return os.stat(self._path).st_ino == self.inode  # noqa: PTH116  programs that attach do not load pathlib
            return False

    @property
    def closed(self) -> bool:
        """True if :meth:`close` was called."""
        return self._fd < 0

    def close(self) -> None:
        """Release the mapping, the descriptor and the locks.

        The mapping remains as long as a view of it is referenced.
        """
        if self._fd < 0:
            return
        if self._map is not None:
            if not self.is_private:  # else other objects may use the mapping, which ends with the last of them
                with suppress(BufferError):  # a view is still referenced; the mapping ends with that
                    self._map.close()
            self._map = None
        # The mapping has a copy of the descriptor, which would keep the locks while a view is in use.
        unlock = struct.pack(_FLOCK, fcntl.F_UNLCK, os.SEEK_SET, 0, 0, 0)
        fcntl.fcntl(self._fd, fcntl.F_OFD_SETLK, unlock)
        os.close(self._fd)
        self._fd = -1


SERVICE_USER = "shmio"
"""The user of the service of the Debian package and of the image, whom every user trusts."""


def _require_trusted(name: str, status: os.stat_result) -> None:
    """Refuse an object that a user has created whom this process does not trust.

    Everyone may create files in /dev/shm, also one with the name of an instance, to show wrong values
    or to let readers crash. A trusted object belongs to root, to this user, to the service, or to a
    user who has given it to a group of this user, as ``instance.group`` does: only members of a group
    can do that. The group ``root`` does not count, because it is nobody's choice.
    """
    if status.st_uid in (0, os.geteuid()):
        return
    shared = status.st_mode & 0o040 and not status.st_mode & 0o022 and status.st_gid != 0
    if shared and status.st_gid in (os.getegid(), *os.getgroups()):
        return
    try:
        owner = pwd.getpwuid(status.st_uid).pw_name
    except KeyError:
        owner = str(status.st_uid)
    if owner == SERVICE_USER:
        return
    raise SegmentError(
        f"segment {name} belongs to user {owner}, so its values cannot be trusted; run the command as {owner}, share "
        f"the instance by instance.group, or, if it is not yours, remove it as root: rm {DIRECTORY}/{name}"
    )


def _private_memory(name: str, size: int) -> mmap.mmap:
    """Return private memory of this process. The kernel provides each page when it is first used.

    Raises:
        SegmentError: There is not enough memory.
    """
    try:
        memory = mmap.mmap(-1, size, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    except OSError as error:
        raise SegmentError(f"cannot allocate {size / 1e6:.1f} MB for segment {name}: {error.strerror}") from None
    # Of many rings, a short run uses only the first bytes. To clear 2 MB for each costs more than all page faults.
    with suppress(OSError):  # a kernel without huge pages
        memory.madvise(mmap.MADV_NOHUGEPAGE)
    return memory


def unlink(name: str) -> None:
    """Remove a name; do nothing if it does not exist."""
    try:
        posix_ipc.unlink_shared_memory(f"/{name}")
    except posix_ipc.ExistentialError:
        return


def names(prefix: str) -> list[str]:
    """Return the names of the shared-memory objects that start with ``prefix``."""
    with os.scandir(DIRECTORY) as entries:
        return sorted(entry.name for entry in entries if entry.name.startswith(prefix))
