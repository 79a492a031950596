"""What a source is that plays a recording, where others have a device or compute. What plays it is in ``replay``."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import msgspec


class Replayed(ABC):
    """A source that has its layout, frames and times from a recording, and lives on the instance's clock."""

    Options: ClassVar[type[msgspec.Struct]]
    """Its own keys of ``[[source]]``; refuses unknown ones."""

    @abstractmethod
    def __init__(self, options: Any, name: Any) -> None:
        """``options``: an instance of ``Options``; ``name``: the source's. ConfigError, beginning with the key."""
