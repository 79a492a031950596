"""The pytest plugin: the marker ``shmio`` and the fixture ``cell``. See docs/how-to/test-a-cell.md.

pytest imports this module in each run, so it imports shmio only when a test uses the fixture.
"""

from __future__ import annotations

import shutil
import signal
import threading
from collections.abc import Generator, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from shmio.testing.cell_under_test import CellUnderTest

_MARKER = "shmio(file, real_time=False): the configuration of the instance that the fixture cell starts"
_CELL = pytest.StashKey["CellUnderTest"]()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the plugin's option."""
    text = "copy the recording, the plots and the logs of a failed test with a cell into a folder of DIR"
    parser.getgroup("shmio").addoption("--shmio-keep", metavar="DIR", type=Path, help=text)


def pytest_configure(config: pytest.Config) -> None:
    """Add the marker."""
    config.addinivalue_line("markers", _MARKER)


@pytest.fixture
def cell(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[CellUnderTest]:
    """Run an instance of the configuration in the marker ``shmio``, in a folder of its own."""
    from shmio.errors import ShmioError  # noqa: PLC0415
    from shmio.testing.cell_under_test import running_cell  # noqa: PLC0415

    marker = request.node.get_closest_marker("shmio")
    if marker is None or len(marker.args) != 1 or marker.kwargs.keys() - {"real_time"}:
        pytest.fail(
            'the fixture cell needs the marker @pytest.mark.shmio("supervisor.toml"), with the path of a configuration '
            "relative to the test's file, and at most the keyword real_time",
            pytrace=False,
        )
    file = request.path.parent / marker.args[0]
    folder = tmp_path_factory.mktemp("cell")
    running = running_cell(file, folder, request.node.nodeid, real_time=bool(marker.kwargs.get("real_time")))
    with _interrupted_by_sigterm(), ExitStack() as stack:
        try:
            cell = stack.enter_context(running)
        except ShmioError as error:
            raise pytest.fail.Exception(f"the instance of {file} does not start: {error}", pytrace=False) from None
        request.node.stash[_CELL] = cell
        yield cell


@contextmanager
def _interrupted_by_sigterm() -> Iterator[None]:
    """Let SIGTERM interrupt the test as Ctrl-C does, so that pytest stops the instance; leave other handlers alone."""
    if threading.current_thread() is not threading.main_thread() or signal.getsignal(signal.SIGTERM) != signal.SIG_DFL:
        yield
        return
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Keep the recording and the plots of a failed test, and name them in its report."""
    report = yield
    if call.when == "call" and report.failed and _CELL in item.stash:
        report.sections.append(("shmio", _kept(item, item.stash[_CELL])))
    return report


def _kept(item: pytest.Item, cell: CellUnderTest) -> str:
    """Return where the evidence is. Whatever goes wrong with it, the test's own result stays."""
    text = ""
    try:
        text = cell.keep()
        directory: Path | None = item.config.getoption("--shmio-keep")
        if directory is None:
            return text
        folder = directory / "".join(char if char.isalnum() or char in "._-" else "-" for char in item.nodeid)
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(cell.folder, folder, ignore=_links)
        return text.replace(str(cell.folder), str(folder))
    except Exception as error:  # noqa: BLE001  an error in a hook ends the whole session
        return f"{text}\nnot kept: {type(error).__name__}: {error}".lstrip()


def _links(folder: str, names: list[str]) -> list[str]:
    return [name for name in names if (Path(folder) / name).is_symlink()]
