"""Reads of all of DB201 a second: shmio's S7 client and ``db_read`` of two others, over links of increasing delay.

The others are python-snap7 and the C library snap7. Controller, link and clients are separate processes. Each client
keeps its session over all rounds.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import snap7
from c_snap7 import fetched
from common import Child, begin, interleave, per_second, report, table
from plc import NUMBER, SIZE, still_block
from snap7.type import Parameter

from shmio.config.address import Address
from shmio.connectors.s7 import S7Client, S7Options

OURS = "shmio"
SMALL = 96  # packetSize of the seed's plc.ini
ROUND_TRIPS_MS = (0, 1, 3)  # added to the loopback's own


def shmio_client(
    stack: ExitStack, address: Address, size: int, *, packet_size: int | None = None, jobs: int | None = None
) -> S7Client:
    options = S7Options(host=address.host, port=address.port, packetSize=packet_size, maxJobs=jobs)
    client = S7Client(options, NUMBER, size)
    client.connect()
    stack.callback(client.close)
    return client


def snap7_client(stack: ExitStack, address: Address, pdu_size: int) -> snap7.Client:
    """Connect python-snap7's client, which accepts the PDU size that the controller grants."""
    client = snap7.Client()
    client.set_param(Parameter.PDURequest, pdu_size)
    client.connect(address.host, 0, 1, address.port)
    stack.callback(client.disconnect)
    return client


def reader_in_parts(client: snap7.Client, packet_size: int) -> Callable[[], bytes]:
    """Make a function that reads the block as users of ``packetSize`` must: one ``db_read`` for each part."""

    def read() -> bytes:
        parts = [client.db_read(NUMBER, at, min(packet_size, SIZE - at)) for at in range(0, SIZE, packet_size)]
        return b"".join(parts)

    return read


def c_client(
    stack: ExitStack, address: Address, pdu_size: int, packet_size: int | None, packages: Path, round_s: float
) -> Callable[[], float]:
    """Start the C library's client, and make a sampler of its reads a second."""
    arguments = (address.host, address.port, pdu_size, packet_size or 0)
    child = stack.enter_context(Child("c_snap7.py", *arguments, packages=packages))
    if child.hello != {"pdu_size": pdu_size, "block": still_block().hex()}:
        raise SystemExit(
            f"C snap7: the PDU has {child.hello['pdu_size']} bytes where {pdu_size} are expected, "
            "or the block that was read differs from the controller's"
        )
    return lambda: float(child.ask(round_s))


def compare(
    address: Address,
    pdu_size: int,
    packet_size: int | None,
    title: str,
    rounds: int,
    round_s: float,
    packages: Path | None,
) -> None:
    """Time all clients with one controller over one link."""
    with ExitStack() as stack:
        ours = shmio_client(stack, address, SIZE, packet_size=packet_size)
        one_by_one = shmio_client(stack, address, SIZE, packet_size=packet_size, jobs=1)
        peer = snap7_client(stack, address, pdu_size)
        if (ours.pdu_size, peer.get_pdu_length()) != (pdu_size, pdu_size):
            raise SystemExit(f"PDU sizes are {ours.pdu_size} and {peer.get_pdu_length()}, not {pdu_size}")
        reads: dict[str, Callable[[], bytes | bytearray]] = {
            OURS: ours.read,
            f"{OURS}, one request at a time": one_by_one.read,
            "python-snap7 db_read": (
                (lambda: peer.db_read(NUMBER, 0, SIZE)) if packet_size is None else reader_in_parts(peer, packet_size)
            ),
        }
        for name, read in reads.items():
            if read() != still_block():
                raise SystemExit(f"{name}: the block that was read differs from the controller's")
        samplers = {name: per_second(read, round_s) for name, read in reads.items()}
        if packages is not None:
            samplers["C snap7 db_read"] = c_client(stack, address, pdu_size, packet_size, packages, round_s)
        report(title, "reads/s", interleave(samplers, rounds), OURS, "more", "python-snap7 db_read")


def measure_link(links: dict[str, Address], calls: int) -> None:
    """Print the delay that each link adds to one request, and to eight at once: both must be one round trip."""
    with ExitStack() as stack:
        single = {name: shmio_client(stack, address, 1, packet_size=1) for name, address in links.items()}
        eight = {name: shmio_client(stack, address, 8, packet_size=1) for name, address in links.items()}
        rows = []
        for name in links:
            one_ms, eight_ms = (statistics.median(_times_ms(client, calls)) for client in (single[name], eight[name]))
            rows.append([name, f"{one_ms:.2f}", f"{eight_ms:.2f}"])
    table(["round trips, median ms", "1 request", "8 at once"], rows)


def _times_ms(client: S7Client, calls: int) -> list[float]:
    times = []
    for _ in range(calls):
        begun_s = time.perf_counter()
        client.read()
        times.append((time.perf_counter() - begun_s) * 1000)
    return times


def main() -> None:
    quick = begin("S7: whole reads of DB201 (2,180 bytes) a second")
    rounds, round_s, calls = (2, 0.05, 10) if quick else (5, 0.4, 300)
    packages = fetched(download=not quick)
    for pdu_size in (480, 960):
        with ExitStack() as stack:
            address = Address.parse(stack.enter_context(Child("plc.py", "--pdu", pdu_size)).hello)
            links = {"loopback": address}
            for round_trip_ms in ROUND_TRIPS_MS[1 : 2 if quick else None]:
                link = stack.enter_context(Child("link.py", address, round_trip_ms))
                links[f"+{round_trip_ms} ms"] = Address.parse(link.hello)
            if pdu_size == 480:
                measure_link(links, calls)
            for name, place in links.items():
                compare(place, pdu_size, None, f"PDU {pdu_size}, {name}", rounds, round_s, packages)
            if pdu_size == 480:
                for name, place in links.items():
                    compare(place, pdu_size, SMALL, f"packetSize {SMALL}, {name}", rounds, round_s, packages)


if __name__ == "__main__":
    main()
