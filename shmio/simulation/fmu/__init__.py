"""Runs FMUs as models: co-simulation FMUs of FMI 2.0 and 3.0, with the library FMPy.

``archive`` reads and extracts the file, ``description`` makes declarations of the variables,
``instance`` calls the running FMU, and ``model`` steps it. Reading an FMU runs none of its code; only
:meth:`FmuModel.start` does.
"""

from shmio.simulation.fmu.description import DEFAULTS, FmuOptions
from shmio.simulation.fmu.model import FmuModel, is_fmu, load_fmu

__all__ = ["DEFAULTS", "FmuModel", "FmuOptions", "is_fmu", "load_fmu"]
