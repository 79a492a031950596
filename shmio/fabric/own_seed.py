"""The seed by which an embedded NATS server knows the processes of its own user.

The server's process makes it, in the folder of the user's control sockets. A process that connects without
credentials looks there for the seed of the address. So it works after restarts of either process, and other
users of the host do not have it.
"""

from __future__ import annotations

import os
import secrets
from contextlib import suppress
from pathlib import Path
from typing import Final

from shmio.config.address import Address
from shmio.control import runtime_file, runtime_folders
from shmio.errors import EndpointError
from shmio.files import replace_file
from shmio.libraries import library

INSTALL: Final = "pip install 'shmio[fabric]'"
MAX_BYTES: Final = 256
_FILE: Final = "nats-{}.seed"


class OwnSeed:
    """The seed of the server at an address, for the server's process."""

    def __init__(self, address: Address) -> None:
        """Read the file with the seed, or make a new one.

        Args:
            address: Where clients of this host reach the server.

        Raises:
            ControlError: There is no folder for the file.
            EndpointError: The file cannot be written.

        """
        self._file = Path(runtime_file(_name(address), "the seed of the NATS server"))
        self._seed = _read(self._file) or _new_seed()
        self.key = _public(self._seed)
        """The public NKey."""
        self.keep()

    def keep(self) -> None:
        """Write the file again if it is gone or changed.

        Raises:
            EndpointError: The file cannot be written.

        """
        if _read(self._file) == self._seed:
            return
        try:
            self._file.parent.mkdir(mode=0o700, exist_ok=True)
            replace_file(self._file, self._seed.encode() + b"\n", private=True)
        except OSError as error:
            raise EndpointError(f"{self._file}: {error.strerror}") from None

    def remove(self) -> None:
        """Remove the file, because the server stops."""
        if _read(self._file) == self._seed:
            with suppress(OSError):
                self._file.unlink()


def find_seed(host: str, port: int) -> str | None:
    """Return the seed for an embedded server of this user at an address; None if there is none."""
    name = _name(Address(host, port))
    return next((seed for folder in runtime_folders() if (seed := _read(folder / name)) is not None), None)


def nobodys_key() -> str:
    """Return a public NKey whose seed nobody has."""
    return _public(_new_seed())


def _new_seed() -> str:
    nkeys = library("nkeys", INSTALL)
    seed: bytes = nkeys.encode_seed(secrets.token_bytes(32), nkeys.PREFIX_BYTE_USER)
    return seed.decode()


def _public(seed: str) -> str:
    key: bytes = library("nkeys", INSTALL).from_seed(bytearray(seed, "ascii")).public_key
    return key.decode()


def _name(address: Address) -> str:
    return _FILE.format(Address("127.0.0.1", address.port) if address.host == "localhost" else address)


def _read(file: Path) -> str | None:
    """Return the seed in a file; None if there is none that only this user could write and read."""
    try:
        fd = os.open(file, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        return None
    with open(fd, "rb") as stream:  # noqa: PTH123  a descriptor
        found = os.fstat(fd)
        if found.st_uid != os.geteuid() or found.st_mode & 0o077:
            return None
        text = stream.read(MAX_BYTES).decode("ascii", "replace").strip()
    return text if text.startswith("SU") and text.isalnum() else None
