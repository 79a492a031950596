"""Simulation models: classes that compute a source's registers step by step.

A model declares its inputs and outputs, and computes the outputs in ``step``: see
docs/how-to/write-a-model.md. ``ModelRunner`` runs a model on the image of a block. ``ServedModel``
runs a model in a client, for an instance on another host.
"""

from shmio.simulation.images import Ends
from shmio.simulation.loading import load
from shmio.simulation.model import InOut, Input, Model, Output, Parameter, layout_of
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
