"""Fixtures and hooks for all tests.

Each instance has its own name, and no test may leave anything behind.
"""

from __future__ import annotations

import gc
import inspect
import os
import secrets
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from types import CodeType, FunctionType, MethodType
from typing import Any, NamedTuple
from zlib import crc32

import pytest
from hypothesis import HealthCheck, settings
from xdist.scheduler import LoadScopeScheduling

from shmio.testing.mosquitto import missing

# Tests interrupt themselves and other processes with SIGINT. In the background, and in workers of xdist,
# Python starts with SIGINT ignored.
signal.signal(signal.SIGINT, signal.default_int_handler)
if "PYTEST_XDIST_WORKER" in os.environ:  # under nohup, SIGHUP is ignored, too; only the main process should
    signal.signal(signal.SIGHUP, signal.SIG_DFL)

# Neither a deadline nor the check of speed, as the host may be busy. Each run uses the same examples, with --fast
# fewer of them; --hypothesis-profile=search looks for new ones.
busy_host = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("repeat", busy_host, derandomize=True)
settings.register_profile("fast", busy_host, derandomize=True, max_examples=20)
settings.register_profile("search", busy_host, max_examples=1000)
settings.load_profile("repeat")

SHM = Path("/dev/shm")
PREFIX = f"test-{os.getpid()}-"


ONE_AFTER_THE_OTHER = (
    # these use the ports shown in the README
    (
        "tests/system/test_docs.py",
        "tests/unit/cli/test_supervisor_cell.py::test_configuration_from_init_runs",
    ),
    # its tests look whether an instance is left that was not there before
    ("tests/system/test_pytest_plugin.py",),
    # all tests of such a module use one instance, browser or server, which takes seconds to start
    ("tests/compatibility/test_client.py",),
    ("tests/compatibility/test_segment.py",),
    ("tests/conformance/test_opcua.py",),
    ("tests/native/test_reader.py",),
    ("tests/system/test_bits.py",),
    ("tests/system/test_cell.py",),
    ("tests/system/test_fabric_inject.py",),
    ("tests/system/test_inject.py",),
    ("tests/system/test_inject_grpc.py",),
    ("tests/system/test_one_name.py",),
    ("tests/system/test_fabric_mirror.py",),
    ("tests/system/test_overlay.py",),
    ("tests/system/test_running.py",),
    ("tests/system/test_step.py",),
    ("tests/system/test_web_browser.py",),
    ("tests/system/test_web_page_changes.py",),
    ("tests/system/test_write.py",),
    ("tests/unit/connectors/opcua/test_browse.py",),
    ("tests/unit/connectors/opcua/test_limits.py",),
    ("tests/unit/connectors/opcua/test_security.py",),
    ("tests/unit/connectors/opcua/test_siemens.py",),
    ("tests/unit/connectors/opcua/test_structures.py",),
)
"""Beginnings of the names of tests that share something; one xdist worker runs each group."""


START_PROCESSES = (
    "tests/compatibility/test_client.py",
    "tests/compatibility/test_segment.py",
    "tests/conformance/test_named_bits_processes.py",
    "tests/native/",
    "tests/system/",
    "tests/unit/cli/test_campaign_run.py",
    "tests/unit/cli/test_completion.py",
    "tests/unit/cli/test_schema.py::test_both_accept",
    "tests/unit/cli/test_schema.py::test_both_refuse_an_invalid_configuration",
    "tests/unit/cli/test_supervisor.py::test_up_detach_reports_faults",
    "tests/unit/client/test_generated.py",
    "tests/unit/connectors/fabric/test_source.py",
    "tests/unit/test_client_distribution.py::test_each_module",
    "tests/unit/endpoints/alerts/test_command.py",
    "tests/unit/endpoints/fabric/",
    "tests/unit/endpoints/mqtt/broker/",
    "tests/unit/endpoints/web/tabs/test_cells.py",
    "tests/unit/endpoints/web/test_uploads.py",
    "tests/unit/endpoints/web/test_dropped.py::test_page_",
    "tests/unit/fabric/archive/test_archive.py",
    "tests/unit/fabric/test_history.py",
    "tests/unit/fabric/test_registry.py",
    "tests/unit/falsification/farm/test_farm.py",
    "tests/unit/falsification/test_pool.py",
    "tests/unit/lab/",
    "tests/unit/plan/test_emulated_programs.py",
    "tests/unit/plan/test_sources_models.py",
    "tests/unit/simulation/fmu/test_fmu_",
    "tests/unit/simulation/fmu/test_howto.py",
    "tests/unit/simulation/test_a50.py::test_runs_as_a_source_on_db201",
    "tests/unit/simulation/test_howto.py",
)
"""Beginnings of the names of tests that start processes without one of STARTERS.

The fast tier leaves them out.
"""

STARTERS = {"ChildProcess", "Popen", "create_subprocess_exec", "fork", "forkpty", "pty", "subprocess"}
"""The fast tier leaves out tests with one of these names in their code, helpers or fixtures."""

SLOW = (
    "tests/unit/cli/test_dump_hostile.py",
    "tests/unit/cli/test_dump_rewriting.py::test_a_flipped_bit_anywhere",
    "tests/unit/cli/test_dump_rewriting.py::test_recover_of_a_file_cut_off_at_every_byte",
    "tests/unit/cli/test_common_signals.py",
    "tests/unit/config/test_faults.py::test_hostile_files",
    "tests/unit/connectors/fabric/test_loop.py::test_a_lost_connection",
    "tests/unit/connectors/fabric/test_loop.py::test_readers_can_follow",
    "tests/unit/connectors/replay/test_recording.py::test_damaged_chunk_is_bad",
    "tests/unit/connectors/s7/test_connector.py::test_references_wrap_around",
    "tests/unit/endpoints/grpc/services/test_publish.py::test_many_streams",
    "tests/unit/endpoints/grpc/services/test_publish.py::test_ten_thousand",
    "tests/unit/endpoints/grpc/server/test_call_guard.py::test_the_limits_hold",
    "tests/unit/endpoints/grpc/services/test_simlog_v1.py::test_a_client_that_does_not_read",
    "tests/unit/endpoints/grpc/services/test_simlog_v2_subscribers.py",
    "tests/unit/endpoints/grpc/shmio_v1/test_clock.py::test_a_stream_that_is_not_read",
    "tests/unit/endpoints/grpc/shmio_v1/test_events.py::test_a_client_that_does_not_read",
    "tests/unit/endpoints/grpc/test_inject_v2.py::test_a_subscriber_that_does_not_read",
    "tests/unit/endpoints/grpc/test_rude.py",
    "tests/unit/judging/test_rtamt.py",  # there is no rtamt for Python 3.13, on which the fast tests may run
    "tests/unit/layout/test_compiler.py::test_bounds_on_files",
    "tests/unit/layout/test_instances.py::test_many_",
    "tests/unit/layout/test_simlog_structures.py::test_a_table_cannot_hide_more_registers",
    "tests/unit/recorder/test_finalise.py::test_a_file_cut_anywhere",
    "tests/unit/recording/reading/test_reader.py::test_changed_bytes",
    "tests/unit/recording/test_check.py::test_no_",
    "tests/unit/recording/test_dump.py::test_batches_equal_frames",
    "tests/unit/segment/test_segment.py::test_a_damaged_segment",
)
"""Beginnings of the names of tests that start no process but take seconds.

The fast tier leaves them out.
"""

APART = (
    "tests/system/test_benchmarks.py",
    # whole examples and the stack, each with many processes; the tests of their parts run each time
    "tests/system/test_compose.py::test_prometheus_of_the_stack",
    "tests/system/test_five_sources.py",
    "tests/system/test_mtconnect_package.py",
    "tests/system/test_opcua_gateway.py",
    "tests/system/test_umati.py",
    # a load of each endpoint; test_turns.py, test_shares.py and the endpoints' own tests hold the limits
    "tests/system/test_one_client_too_many.py",
    # 20 busy loops would disturb the tests beside it; test_policy.py has recorded figures of such a load
    "tests/unit/supervisor/test_overload.py",
    # every byte of a file; the tests beside them cut and change it at chosen places
    "tests/unit/cli/test_dump_rewriting.py::test_recover_of_a_file_cut_off_at_every_byte",
    "tests/unit/recorder/test_finalise.py::test_a_file_cut_anywhere",
)
"""Beginnings of the names of tests that run only with --all, or if you name their file."""


def pytest_addoption(parser: pytest.Parser) -> None:
    tiers = parser.getgroup("tiers").addoption
    tiers("--fast", action="store_true", help="run only quick tests that start no process")
    tiers("--slow", action="store_true", help="run only the tests that --fast leaves out")
    tiers("--all", action="store_true", help="also run the tests that otherwise run only if you name them")
    tiers("--part", type=part, metavar="N/M", help="run only the tests in the Nth of M groups of files")


def part(text: str) -> tuple[int, int]:
    """Return the number of a group and the number of groups from the value of ``--part``."""
    number, groups = (int(one) for one in text.split("/"))
    if not 1 <= number <= groups:
        raise ValueError(text)
    return number, groups


def left_out(config: pytest.Config) -> tuple[str, ...]:
    """Return the beginnings of the names of tests that are not in the chosen tier."""
    if config.option.fast:
        return (*START_PROCESSES, *SLOW, *APART)
    if config.option.all:
        return ()
    return tuple(name for name in APART if not any(name.partition("::")[0] in given for given in config.args))


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave out files that have no test in the chosen tier and part, without importing them."""
    is_folder = collection_path.is_dir()
    name = collection_path.relative_to(config.rootpath).as_posix() + "/" * is_folder
    number, groups = config.option.part or (1, 1)
    in_part = is_folder or crc32(name.encode()) % groups == number - 1
    return name.startswith(left_out(config)) or not in_part or None


class StarterFinder:
    """Finds the tests that start a process, by the names in their code, helpers and fixtures."""

    def __init__(self) -> None:
        self._known: dict[object, bool] = {}

    def starts_process(self, item: pytest.Item) -> bool:
        """Return whether the test or one of its fixtures uses one of STARTERS."""
        if not isinstance(item, pytest.Function):
            return False
        test = getattr(item.obj, "hypothesis", None)
        used = [test.inner_test if test else item.obj]
        for fixtures in item._fixtureinfo.name2fixturedefs.values():
            used += [fixture.func for fixture in fixtures]
        return any(self._names(one) for one in used)

    def _names(self, used: object) -> bool:
        """Return whether a function or class uses one of STARTERS, itself or through a helper."""
        used = inspect.unwrap(used) if callable(used) else used
        if isinstance(used, MethodType):
            used = used.__func__
        if not (getattr(used, "__module__", None) or "").startswith(("tests.", "shmio.testing")):
            return False
        if used not in self._known:
            self._known[used] = False  # ends the recursion if two helpers use each other
            if isinstance(used, type):
                self._known[used] = any(self._names(one) for one in vars(used).values() if callable(one))
            elif isinstance(used, FunctionType):
                names = set(code_names(used.__code__))
                helpers = [used.__globals__[name] for name in names if callable(used.__globals__.get(name))]
                self._known[used] = not STARTERS.isdisjoint(names) or any(self._names(one) for one in helpers)
        return self._known[used]


def code_names(code: CodeType) -> Iterator[str]:
    """Yield the names that a function uses, including its nested functions."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from code_names(constant)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out the tests that are not in the chosen tier."""
    names, finder = left_out(config), StarterFinder()
    out = {item for item in items if item.nodeid.startswith(names)}
    if config.option.fast or config.option.slow:
        slow = {item for item in items if item.nodeid.startswith(START_PROCESSES + SLOW) or finder.starts_process(item)}
        out |= slow if config.option.fast else {*items} - slow
    if out:
        config.hook.pytest_deselected(items=list(out))
        items[:] = [item for item in items if item not in out]


NEW_PROCESS = {"os.exec", "os.fork", "os.forkpty", "os.posix_spawn", "os.system", "subprocess.Popen"}
"""Audit events that the interpreter raises when a process is started."""


class NoProcesses:
    """Fails each test that starts a process, and prevents the start."""

    def __init__(self) -> None:
        self._started: list[str] = []
        self._testing = False
        sys.addaudithook(self._audit)

    def _audit(self, event: str, arguments: tuple[object, ...]) -> None:
        if (
            self._testing and event in NEW_PROCESS and arguments[:1] != ("lscpu",)
        ):  # numpy.testing before 2 runs it when imported
            self._started.append(f"{event} {arguments[0] if arguments else ''}")
            raise RuntimeError("a test of the fast tier must not start a process")

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self) -> Iterator[None]:
        """Watch the test and its fixtures."""
        self._testing = True
        try:
            return (yield)
        finally:
            self._testing = False

    @pytest.hookimpl(trylast=True)
    def pytest_runtest_teardown(self) -> None:
        """Fail the test even if the code under test caught the exception."""
        started, self._started = self._started, []
        if started:
            pytest.fail(f"starts {started}, which the fast tier forbids: add the test to START_PROCESSES in {__file__}")


def pytest_configure(config: pytest.Config) -> None:
    """Watch for new processes in the fast tier."""
    if config.option.fast:
        settings.load_profile("fast")
        config.pluginmanager.register(NoProcesses())


class Scheduling(LoadScopeScheduling):  # type: ignore[misc]
    """Gives each xdist worker one test at a time, or one group of ONE_AFTER_THE_OTHER."""

    def _split_scope(self, nodeid: str) -> str:
        """Return the group of a test. The mark xdist_group has no effect with pytest 9.2."""
        return next((group[0] for group in ONE_AFTER_THE_OTHER if nodeid.startswith(group)), nodeid)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Scheduling:
    """Use Scheduling in place of the schedulers that --dist names."""
    return Scheduling(config, log)


def pytest_collection_finish() -> None:
    """Exclude existing objects from garbage collection, so that collecting after a test is fast."""
    gc.collect()
    gc.freeze()


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> None:
    """Exclude what the tests of a module imported, too, as soon as its fixtures have ended."""
    if nextitem is None or nextitem.path != item.path:
        gc.collect()
        gc.freeze()


def segments() -> set[str]:
    """Return this run's segments; other instances on this host do not count."""
    with os.scandir(SHM) as entries:
        return {entry.name for entry in entries if entry.name.startswith(f"shmio-{PREFIX}")}


def children() -> set[int]:
    found: set[int] = set()
    for task in Path("/proc/self/task").iterdir():
        try:
            found.update(int(pid) for pid in (task / "children").read_text().split())
        except OSError:
            continue  # the thread has just ended
    return found


def sockets() -> set[str]:
    found = set()
    with os.scandir("/proc/self/fd") as entries:
        for entry in entries:
            with suppress(OSError):  # it may have just been closed
                found.add(os.readlink(entry.path))  # noqa: PTH115  a Path takes five times as long
    return {target for target in found if target.startswith("socket:")}


def handlers() -> dict[signal.Signals, Any]:
    return {sign: signal.getsignal(sign) for sign in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}


class Resources(NamedTuple):
    """What this process has. The names are compared, not counted: what an earlier test left may end meanwhile."""

    segments: set[str]
    processes: set[int]
    sockets: set[str]
    threads: set[threading.Thread]

    @classmethod
    def now(cls) -> Resources:
        return cls(segments(), children(), sockets(), set(threading.enumerate()))

    def added(self) -> dict[str, set[Any]]:
        """Return what this process has now, and did not have before."""
        pairs = zip(self._asdict().items(), self.now(), strict=True)
        return {kind: left for (kind, before), now in pairs if (left := now - before)}


def ended_with_browser(left: dict[str, set[Any]]) -> dict[str, set[Any]]:
    """Return what is left without the threads of Playwright's event loop, which end with the module's browser."""
    threads = {one for one in left.get("threads", ()) if not one.name.startswith("asyncio_")}
    return {kind: found for kind, found in (left | {"threads": threads}).items() if found}


@pytest.fixture(autouse=True)
def nothing_left_behind(request: pytest.FixtureRequest) -> Iterator[None]:
    """Fail a test that leaves a segment, a process, a socket, a thread or a changed signal handler behind."""
    shares_browser = "browser" in request.fixturenames
    before = Resources.now()
    heeded = handlers()
    yield
    deadline = time.monotonic() + 20.0
    while (left := before.added()) and time.monotonic() < deadline:  # they may just be ending
        if shares_browser and not ended_with_browser(left):
            break
        if not gc.collect():
            time.sleep(0.005)
    if shares_browser:
        left = ended_with_browser(left)
    now = handlers()
    for sign, handler in heeded.items():
        signal.signal(sign, handler)  # protects the next test
    assert now == heeded, f"signal handlers left behind: {now}"
    assert not left, f"left behind: {left}"


def _named() -> Iterator[str]:
    name = PREFIX + secrets.token_hex(4)
    yield name
    (SHM / f"shmio-{name}").unlink(missing_ok=True)


@pytest.fixture
def instance() -> Iterator[str]:
    """Yield a unique instance name; after the test, remove the segment that a failing test left."""
    yield from _named()


@pytest.fixture
def runtime() -> Iterator[Path]:
    """Yield a folder for ``XDG_RUNTIME_DIR``.

    A socket's path has at most 107 bytes, and ``tmp_path`` may be longer.
    """
    with tempfile.TemporaryDirectory(prefix="shmio-run-") as folder:
        yield Path(folder)


@pytest.fixture(scope="module")
def shared_instance() -> Iterator[str]:
    """Yield a unique name for an instance that several tests of a module share."""
    yield from _named()


@pytest.fixture(params=["mosquitto", "embedded"])
def program(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Run the test twice: with mosquitto, and with the embedded broker, as if mosquitto were not installed."""
    if request.param == "mosquitto":
        if reason := missing():
            pytest.skip(reason)
    else:
        monkeypatch.setenv("SHMIO_MOSQUITTO", "")
    return str(request.param)
