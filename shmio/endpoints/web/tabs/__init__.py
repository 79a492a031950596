"""The tabs of a page. Each module has the calls of one tab, and sends the data that the tab follows."""

from typing import Final

from shmio.endpoints.web.page import Tab
from shmio.endpoints.web.tabs.cells import CellsTab
from shmio.endpoints.web.tabs.configuration import Configuration
from shmio.endpoints.web.tabs.injections import Injections
from shmio.endpoints.web.tabs.log import Log
from shmio.endpoints.web.tabs.overview import Overview
from shmio.endpoints.web.tabs.plots import Plots
from shmio.endpoints.web.tabs.recordings import RecordingsTab
from shmio.endpoints.web.tabs.registers import Registers
from shmio.endpoints.web.tabs.scene import Scene
from shmio.endpoints.web.tabs.time import Time

TABS: Final[tuple[type[Tab], ...]] = (
    Overview,
    CellsTab,
    Registers,
    Plots,
    Scene,
    Injections,
    Time,
    RecordingsTab,
    Configuration,
    Log,
)
"""All tabs, in the order in which a page shows them."""
