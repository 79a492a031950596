"""Simulation models: small classes that compute a source's registers step by step. No I/O.

A model declares what it reads and computes, and computes it in ``step``: see
docs/how-to/write-a-model.md. ``ModelRunner`` runs it on the image of a block, ``ServedModel`` for
an instance elsewhere.
"""

from shmio.simulation.declarations import InOut, Input, Output, Parameter
from shmio.simulation.loading import load
from shmio.simulation.model import Model, layout_of
from shmio.simulation.ports import Ends
from shmio.simulation.runner import ModelRunner
from shmio.simulation.served import ServedModel

__all__ = [
    "Ends",
    "InOut",
    "Input",
    "Model",
    "ModelRunner",
    "Output",
    "Parameter",
    "ServedModel",
    "layout_of",
    "load",
]
