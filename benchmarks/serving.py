"""A process that serves a model to an instance by gRPC, until standard input ends."""

from __future__ import annotations

import argparse
import threading

from common import tell, wait_for_parent
from counting import Counting

from shmio.client import Simulation, connect
from shmio.simulation import ServedModel


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("target")
    parser.add_argument("source")
    arguments = parser.parse_args()
    model = ServedModel(Counting)

    def start(joined: Simulation) -> None:
        model.start(joined)
        tell("ready")

    with connect(arguments.target) as cell:
        thread = threading.Thread(target=cell.simulate, args=(arguments.source, model.step), kwargs={"start": start})
        thread.start()
        wait_for_parent()
    thread.join()


if __name__ == "__main__":
    main()
