"""Simulation models: small classes that compute a source's registers step by step. No I/O.

A model declares what it reads and computes, and computes it in ``step``: see
docs/how-to/write-a-model.md. ``ModelRunner`` runs it on the image of a block, ``ServedModel`` for
an instance elsewhere.
"""

from shmio.simulation.images import Ends
from shmio.simulation.model import InOut, Input, Model, Output, Parameter, layout_of, load
from shmio.simulation.runner import ModelRunner, ServedModel

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
