"""PLC programs in Python, for an emulated controller: see docs/how-to/write-a-plc-program.md.

A program declares its registers as a model does, and has a method ``scan``, which runs once in each
cycle. ``TON``, ``TOF``, ``TP``, ``R_TRIG`` and ``F_TRIG`` are the function blocks of IEC 61131-3.
"""

from shmio.plc.blocks import F_TRIG, R_TRIG, TOF, TON, TP
from shmio.plc.program import Program
from shmio.simulation.model import InOut, Input, Output, Parameter

__all__ = ["F_TRIG", "R_TRIG", "TOF", "TON", "TP", "InOut", "Input", "Output", "Parameter", "Program"]
