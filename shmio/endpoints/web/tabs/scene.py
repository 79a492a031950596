"""The 3D tab: the bodies of the cell, and the registers that move them.

The page follows these registers in the same way as the tabs Plots and Registers.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from shmio.endpoints.web.page import Nothing, Tab, call
from shmio.endpoints.web.served import Served


class Scene(Tab):
    """Shows the cell that the configuration describes."""

    name: ClassVar[str] = "scene"

    @classmethod
    def offered(cls, served: Served) -> bool:
        """Return whether the configuration describes the cell."""
        return served.scene is not None

    @call("read", Nothing)
    async def get(self, _: Nothing) -> Mapping[str, Any] | None:
        """Return the bodies of the cell, and the registers that move them."""
        return self.page.served.scene
