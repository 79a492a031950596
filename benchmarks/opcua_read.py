"""OPC UA: values a second and CPU of the connector ``opcua``, beside asyncua's own client on the same server.

Server and clients are processes of their own, and the clients take turns, one at a time. The connector also puts
each value with its status and time into an image, and checks that the server is alive; asyncua's client only counts.
The server is asyncua's, or shmio's endpoint, which is faster.
``limit`` says which process ran, or waited for a core, more than 85 % of the time.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from typing import Any

from common import Child, CpuTime, begin, limits, table, waited_s

OURS, BARE = "shmio", "asyncua"
WARM_UP_S = 1.0

Row = dict[str, float]


def run(server: Child, reader: Child, duration_s: float, count: int) -> Row:
    """Measure one client for a time."""
    pids = reader.pid, server.pid
    changes, before, waited = server.ask(""), CpuTime.of(server.pid), [waited_s(pid) for pid in pids]
    found: dict[str, Any] = reader.ask(duration_s)
    used, changes = CpuTime.of(server.pid).since(before), server.ask("") - changes
    client_waited_s, server_waited_s = (waited_s(pid) - then for pid, then in zip(pids, waited, strict=True))
    seconds, values = found["s"], found["values"]
    return {
        "rate": values / seconds,
        "share": 100 * values / max(1, count * changes),
        "cpu": 100 * found["cpu_s"] / seconds,
        "cost": 1e6 * found["cpu_s"] / max(1, values),
        "server": 100 * (used.user_s + used.system_s) / seconds,
        "late": found["late"],
        "client waited": 100 * client_waited_s / seconds,
        "server waited": 100 * server_waited_s / seconds,
    }


def limit(row: Row) -> str:
    return limits({"client": (row["cpu"], row["client waited"]), "server": (row["server"], row["server waited"])})


def compare(
    title: str, peer: str, mode: str, count: int, change_ms: float, period_ms: float, rounds: int, round_s: float,
    sessions: Sequence[int],
) -> None:  # fmt: skip
    """Print a table of all clients. Each has a turn in each round, alone with the server."""
    names = [(f"{OURS}, {n} session{'s' * (n > 1)}", OURS, n) for n in sessions] + [(BARE, BARE, 1)]
    found: dict[str, list[Row]] = {name: [] for name, _, _ in names}
    with Child("opcua_peer.py", peer, count, change_ms) as server:
        for turn in range(rounds):
            for name, who, number in names[turn % len(names) :] + names[: turn % len(names)]:
                with Child("opcua_reader.py", who, mode, server.hello, count, period_ms, number) as reader:
                    time.sleep(min(WARM_UP_S, round_s))
                    found[name].append(run(server, reader, round_s, count))
    middle = {
        name: {key: statistics.median(one[key] for one in rows) for key in rows[0]} for name, rows in found.items()
    }
    bare = middle[BARE]
    rows = []
    for name, row in middle.items():
        ratios = (
            ["", ""] if name == BARE else [f"{row['rate'] / bare['rate']:.2f}", f"{row['cost'] / bare['cost']:.2f}"]
        )
        share = f"{row['share']:.0f}" if mode == "subscribe" else ""
        figures = [f"{row[key]:.{digits}f}" for key, digits in (("cpu", 0), ("cost", 1), ("server", 0), ("late", 0))]
        rows.append([name, f"{row['rate']:.0f}", share, *figures, *ratios, limit(row)])
    table(
        [title, "values/s", "% of changes", "client, % of a core", "µs a value", "server, % of a core", "late cycles",
         "rate to asyncua", "CPU to asyncua", "limit"],
        rows,
    )  # fmt: skip


def main() -> None:
    quick = begin("OPC UA: values a second of the connector and of asyncua's client")
    rounds, round_s = (1, 0.5) if quick else (3, 6.0)
    many, few = 10_000, 100 if quick else 1000
    fixed = rounds, round_s
    compare(f"{few} nodes of asyncua, polled without a pause", BARE, "poll", few, 1000, 0, *fixed, (1,))
    compare(f"{few} nodes of shmio, subscribed at 50 Hz", OURS, "subscribe", few, 20, 20, *fixed, (1,))
    if not quick:
        compare(f"{few} nodes of shmio, polled without a pause", OURS, "poll", few, 1000, 0, *fixed, (1,))
        compare(f"{few} nodes of asyncua, subscribed at 50 Hz", BARE, "subscribe", few, 20, 20, *fixed, (1,))
        for mode, how in (("poll", "polled"), ("subscribe", "subscribed")):
            compare(f"{many} nodes of asyncua, {how} every s", BARE, mode, many, 1000, 1000, *fixed, (1, 4))


if __name__ == "__main__":
    main()
