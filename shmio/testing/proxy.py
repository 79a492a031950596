"""TCP proxy with faults on demand between a program and its peer, for tests and benchmarks."""

from shmio.emulators.proxy import Edit, FaultProxy, Framing, reference_edit, tpkt

__all__ = ["Edit", "FaultProxy", "Framing", "reference_edit", "tpkt"]
