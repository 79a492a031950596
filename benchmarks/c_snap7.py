"""Reads DB201 with the C client snap7, by way of python-snap7 2.1 (later versions are pure Python), in its own process.

:func:`fetched` installs python-snap7 2.1 once into ``build/``, apart from the python-snap7 that shmio needs. As a
script, the module takes host, port, PDU size and packet size. For each line of standard input, a number of seconds,
it reads DB201 for that time and prints the number of reads a second.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

REQUIREMENT = "python-snap7==2.1.*"
PLACE = Path(__file__).parents[1] / "build" / "c-snap7"
NUMBER, SIZE = 201, 2180  # as in plc.py, which is not imported: shmio's python-snap7 would come along


def fetched(*, download: bool) -> Path | None:
    """Return the folder of the packages. If they are not available, print why and return None."""
    if PLACE.exists():
        return PLACE
    if not download:
        print("the C client snap7 is left out: a quick run downloads nothing")
        return None
    part = PLACE.with_suffix(".part")
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-deps"]
    command += ["--only-binary", ":all:", "--upgrade", "--target", str(part), REQUIREMENT]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        reason = (done.stderr.strip().splitlines() or ["pip gave no reason"])[-1]
        print(f"the C client snap7 is left out: {REQUIREMENT} cannot be installed: {reason}")
        return None
    part.rename(PLACE)
    return PLACE


def main() -> None:
    import snap7.client  # noqa: PLC0415  the old one, where PYTHONPATH says
    from snap7.type import Parameter  # noqa: PLC0415

    host, port, pdu_size, packet_size = sys.argv[1], *map(int, sys.argv[2:])
    client: Any = snap7.client.Client()
    client.set_param(Parameter.PDURequest, pdu_size)
    client.connect(host, 0, 1, port)

    def read() -> bytes:
        if packet_size == 0:
            return bytes(client.db_read(NUMBER, 0, SIZE))
        parts = [client.db_read(NUMBER, at, min(packet_size, SIZE - at)) for at in range(0, SIZE, packet_size)]
        return b"".join(map(bytes, parts))

    print(json.dumps({"pdu_size": client.get_pdu_length(), "block": read().hex()}), flush=True)
    for line in sys.stdin:
        duration_s, count = float(line), 0
        begun_s = time.perf_counter()
        while (taken_s := time.perf_counter() - begun_s) < duration_s:
            read()
            count += 1
        print(count / taken_s, flush=True)
    client.disconnect()


if __name__ == "__main__":
    main()
