"""A process that plays a slow link: it relays to one address and delays each byte, without limiting the rate."""

from __future__ import annotations

import argparse

from common import tell, wait_for_parent

from shmio.config.address import Address
from shmio.testing.proxy import FaultProxy


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("target", type=Address.parse)
    parser.add_argument("round_trip_ms", type=float)
    arguments = parser.parse_args()
    one_way_s = arguments.round_trip_ms / 2000
    with FaultProxy(arguments.target, up_s=one_way_s, down_s=one_way_s) as proxy:
        tell(str(proxy.address))
        wait_for_parent()


if __name__ == "__main__":
    main()
