"""The base class of sources that play a recording."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import msgspec


class Replayed(ABC):
    """A source that has its layout and frames from a recording, and follows the instance clock."""

    Options: ClassVar[type[msgspec.Struct]]
    """Its own keys of ``[[source]]``. The struct must refuse unknown keys."""

    @abstractmethod
    def __init__(self, options: Any, name: Any) -> None:
        """Open the recording.

        Args:
            options: An instance of ``Options``.
            name: The name of the source.

        Raises:
            ConfigError: The recording cannot be played. The message begins with the key.

        """
