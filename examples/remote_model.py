"""Compute a source of connector "remote": a drive that follows a target. Docs: docs/how-to/remote-model.md.

python examples/remote_model.py [--ca CA.pem] [--token-file FILE] [--name NAME] HOST:PORT|unix:PATH SOURCE
"""

from __future__ import annotations

import argparse
import logging
import sys
from pathlib import Path

from shmio.client import Simulation, connect
from shmio.client.model import Values
from shmio.errors import ShmioError


class Drive:
    """Moves to its target at a limited speed."""

    position = 0.0

    def start(self, source: Simulation) -> None:
        """Continue from the position that the source showed last. Called each time the model has joined the source."""
        if source.computed:
            self.position = float(source.outputs["position"])
        print(f"joined {source.source}, the position is {self.position:g}", flush=True)

    def step(self, time_s: float, dt_s: float, inputs: Values) -> dict[str, object]:  # noqa: ARG002  it knows no time
        """Return the outputs at the end of a step."""
        most = inputs["speed"] * dt_s
        way = inputs["target"] - self.position
        self.position += max(-most, min(most, way))
        return {"position": self.position, "moving": abs(way) > most}


def main() -> int:
    """Compute until Ctrl-C. Return 1 if the endpoint refuses, or is not there for 10 s."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--ca", help="use TLS, and trust this authority (PEM)")
    parser.add_argument("--token-file", type=Path, help="file with the token, if the endpoint requires one")
    parser.add_argument("--name", default="remote_model.py", help="name of the model in messages")
    parser.add_argument("address", metavar="HOST:PORT|unix:PATH")
    parser.add_argument("source", metavar="SOURCE")
    options = parser.parse_args()
    logging.basicConfig(format="%(message)s")  # why steps fail
    drive = Drive()
    try:
        token = options.token_file and options.token_file.read_text().strip()
        with connect(options.address, ca=options.ca, token=token) as cell:
            cell.simulate(options.source, drive.step, start=drive.start, name=options.name)
    except (ShmioError, OSError) as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(130)
