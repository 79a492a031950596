"""TCP ports for tests. The kernel chooses them, so that tests contain no port numbers."""

from shmio.emulators.ports import reserved_port

__all__ = ["reserved_port"]
