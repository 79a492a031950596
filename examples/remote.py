"""Follow registers of an instance on this host or another, as numpy arrays, and optionally write one of them.

python examples/remote.py [--count N] [--write PATH=VALUE] HOST:PORT PATTERN...
"""

from __future__ import annotations

import argparse
import json
import sys

from shmio.client import connect
from shmio.errors import ShmioError


def main() -> int:
    """Print the registers that each update has. Return 1 if the endpoint refuses or is not there."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, help="stop after this number of updates")
    parser.add_argument("--write", metavar="PATH=VALUE", help="first write a register; VALUE is JSON")
    parser.add_argument("address", metavar="HOST:PORT")
    parser.add_argument("patterns", metavar="PATTERN", nargs="+", help="path, structure or glob")
    options = parser.parse_args()
    try:
        with connect(options.address) as cell:
            if options.write:
                path, _, value = options.write.partition("=")
                for outcome in cell.write({path: json.loads(value)}):
                    print(outcome.path, outcome.kind, outcome.text)
            for number, update in enumerate(cell.subscribe(*options.patterns), 1):
                print(f"{update.clock_ns / 1e9:10.3f} s  {update.source}: cycle {update.cycle}, {update.quality}")
                for path in update.changed:
                    print(f"    {path:<40} {update[path]}")
                sys.stdout.flush()
                if number == options.count:
                    break
    except ShmioError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(130)
