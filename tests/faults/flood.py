"""Floods a whole cell with calls to unknown methods: ``python -m tests.faults.flood --for 60``.

Two threads each at a plain-text port, a TLS port and a UNIX socket send calls as fast as they are
answered. Their method names are not UTF-8, or unknown. Meanwhile two clients read: one stays
connected, the other connects anew for each call. An injection is kept all the time.
"""

from __future__ import annotations

import argparse
import secrets
import shutil
import ssl
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import grpc
import trustme

from shmio import client
from shmio.config import Address
from shmio.errors import ShmioError
from shmio.testing.cell import CONFIG, Cell
from shmio.testing.flood import WINDOW, Flood
from shmio.testing.ports import reserved_port
from shmio.wire.simlog_v1_pb2 import TopicDescriptor
from shmio.wire.simlog_v1_pb2_grpc import SimlogAPIStub

ROOT = Path(__file__).parents[2]
TOKEN: Final = "flood-0123456789abcdefghij"
REGISTER: Final = "cell/Outputs/100"  # of no meaning to the controller's program
CALL_S: Final = 60.0
"""Time-out of a call, long enough for a busy host."""
SETTLE_S: Final = 20.0
"""Maximum time between the flood and the last measurement of memory."""
MOST_LOG_BYTES: Final = 100_000
MOST_RSS_MB: Final = 500.0
MORE: Final = """
[grpc.tls]
certificate = "certificate.pem"
key = "key.pem"

[[grpc.address]]
listen = "{plain}"
roles = ["read"]
insecure = true

[[grpc.token]]
name = "flood"
roles = ["read", "write", "inject"]
token_file = "token"
"""


@dataclass
class Seen:
    """Results of a flood. ``open_calls`` and ``fresh_calls`` are pairs: calls tried, and calls answered."""

    flooded: int = 0
    lost: int = 0
    open_calls: tuple[int, int] = (0, 0)
    fresh_calls: tuple[int, int] = (0, 0)
    log_bytes: int = 0
    rss_mb: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Memory of the endpoint before, at its maximum, and after the flood."""
    restarted: bool = False
    injected: bool = False

    @property
    def faults(self) -> list[str]:
        """The promises that the endpoint broke, as text."""
        promises = {
            "the endpoint was restarted": not self.restarted,
            "the kept injection is gone": self.injected,
            "calls on an open channel failed": self.open_calls[0] == self.open_calls[1] > 0,
            "calls on fresh channels failed": self.fresh_calls[1] >= 0.9 * self.fresh_calls[0] > 0,
            "the log is not limited": self.log_bytes < MOST_LOG_BYTES,
            "memory is not limited": self.rss_mb[1] < MOST_RSS_MB,
            "no call of the flood was answered": self.flooded > 0,
        }
        return [fault for fault, kept in promises.items() if not kept]


def prepare(folder: Path, instance: str, plc: Address, plain: Address, secure: Address) -> tuple[Cell, ssl.SSLContext]:
    """Write the cell's folder; return the cell, and the TLS context of its clients."""
    shutil.copy(ROOT / "db201.db", folder)
    (folder / "token").write_text(TOKEN + "\n")
    (folder / "token").chmod(0o600)
    authority = trustme.CA()
    certificate = authority.issue_cert("localhost")
    certificate.private_key_pem.write_to_path(folder / "key.pem")
    certificate.cert_chain_pems[0].write_to_path(folder / "certificate.pem")
    (folder / "key.pem").chmod(0o600)
    authority.cert_pem.write_to_path(folder / "ca.pem")
    text = CONFIG.format(instance=instance, period_ms=20, plc=plc, grpc=secure)
    text = text.replace(f'listen = ["{secure}"]', f'listen = ["{secure}", "unix:s"]')
    (folder / "supervisor.toml").write_text(text + MORE.format(plain=plain))
    context = ssl.create_default_context()
    context.set_alpn_protocols(["h2"])
    authority.configure_trust(context)
    return Cell(folder, instance, plain), context


def run(
    cell: Cell, plain: Address, secure: Address, context: ssl.SSLContext, for_s: float, window: int = WINDOW
) -> Seen:
    """Flood a running cell, and return the results."""
    seen, pid = Seen(), cell.processes()["grpc"]["pid"]
    log = cell.folder / "logs"
    logged = _size(log)
    before_mb = most_mb = _rss_mb(pid)
    flood = Flood(window=window)

    with client.connect(str(plain), token=TOKEN, timeout_s=CALL_S) as lasting:
        with lasting.inject(REGISTER, keep=True, name="kept") as shadow:
            shadow.set({REGISTER: 7})
        with ExitStack() as floods:
            for target, trust in (
                ((plain.host, plain.port), None),
                ((secure.host, secure.port), context),
                (str(cell.folder / "s"), None),
            ):
                floods.enter_context(flood.upon(target, trust))
            until_s = time.monotonic() + for_s
            while time.monotonic() < until_s:
                seen.open_calls = _tried(seen.open_calls, lambda: lasting.read(REGISTER))
                seen.fresh_calls = _tried(seen.fresh_calls, lambda: _once(plain))
                most_mb = max(most_mb, _rss_mb(pid))
        time.sleep(min(SETTLE_S, for_s))
        seen.injected = any(one.name == "kept" for one in lasting.injections())
        seen.rss_mb = before_mb, most_mb, _rss_mb(pid)
    seen.flooded, seen.lost = flood.answered, flood.lost
    seen.log_bytes = _size(log) - logged
    process = cell.processes()["grpc"]
    seen.restarted = process["pid"] != pid or process["restarts"] > 0
    return seen


def _once(address: Address) -> None:
    """Make a call on a new connection."""
    with grpc.insecure_channel(str(address), [("grpc.use_local_subchannel_pool", 1)]) as channel:
        stub: Any = SimlogAPIStub(channel)  # type: ignore[no-untyped-call]
        stub.GetTopic(TopicDescriptor(path=REGISTER), timeout=CALL_S, metadata=[("authorization", f"Bearer {TOKEN}")])


def _tried(calls: tuple[int, int], call: Callable[[], object]) -> tuple[int, int]:
    try:
        call()
    except (ShmioError, grpc.RpcError):
        return calls[0] + 1, calls[1]
    return calls[0] + 1, calls[1] + 1


def _size(folder: Path) -> int:
    return sum(file.stat().st_size for file in folder.iterdir())


def _rss_mb(pid: int) -> float:
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS")) / 1e3


def main() -> int:
    """Start a cell and flood it; return 1 if a promise was broken."""
    parser = argparse.ArgumentParser(description="flood a cell with calls to unknown methods")
    parser.add_argument("--for", dest="for_s", type=float, default=60.0, metavar="SECONDS")
    parser.add_argument(
        "--window", type=int, default=WINDOW, metavar="CALLS", help="maximum number of open calls of a connection"
    )
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        plc, plain, secure = (stack.enter_context(reserved_port()) for _ in range(3))
        cell, context = prepare(Path(folder), f"flood-{secrets.token_hex(3)}", plc, plain, secure)
        cell.up()
        stack.callback(cell.down)
        seen = run(cell, plain, secure, context, arguments.for_s, arguments.window)
        print(seen)
        for fault in seen.faults:
            print(f"BROKEN: {fault}")
        if seen.faults:
            print(cell.logs()[-4000:])
    return bool(seen.faults)


if __name__ == "__main__":
    sys.exit(main())
