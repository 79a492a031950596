"""The laboratory: an instance in one Python process, whose sources are all computed.

See docs/how-to/use-the-laboratory.md.
"""

from shmio.lab.laboratory import Laboratory, prepare_laboratory

__all__ = ["Laboratory", "prepare_laboratory"]
