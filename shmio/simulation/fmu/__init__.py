"""FMUs as models: co-simulation by FMI 2.0 and 3.0, by the library FMPy.

``archive`` reads and extracts the file, ``description`` makes declarations of the variables, and
``model`` steps the FMU. Reading an FMU runs none of its code; only :meth:`FmuModel.start` does.
"""

from shmio.simulation.fmu.model import FmuModel, is_fmu, load_fmu

__all__ = ["FmuModel", "is_fmu", "load_fmu"]
