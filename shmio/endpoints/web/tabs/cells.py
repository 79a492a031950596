"""The cells tab: all cells of the fabric, with links to their pages."""

from __future__ import annotations

from typing import ClassVar

from shmio.endpoints.web.page import FollowedTab
from shmio.endpoints.web.served import Served


class CellsTab(FollowedTab):
    """Shows all cells of the fabric."""

    name: ClassVar[str] = "cells"

    @classmethod
    def offered(cls, served: Served) -> bool:
        """Return whether the instance is part of a fabric."""
        return served.cells is not None

    async def _follow(self) -> None:
        cells = self.page.served.cells
        assert cells is not None  # noqa: S101  else the tab is not offered
        number = 0
        with cells.followed():
            while True:
                number = await cells.newer(number)
                self.page.push("cells", cells.described(self.page.host))
