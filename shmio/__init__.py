"""shmio: shared-memory I/O for digital twins of multi-robot cells.

A local program begins with :func:`attach`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from shmio.segment.attach import attach

__version__ = "0.1.0"
__all__ = ["__version__", "attach"]


def __getattr__(name: str) -> Any:
    """Import ``attach`` when it is first asked for: most processes of an instance do without it."""
    if name == "attach":
        from shmio.segment.attach import attach  # noqa: PLC0415

        return attach
    raise AttributeError(f"module 'shmio' has no attribute {name!r}")
