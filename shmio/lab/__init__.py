"""The laboratory: an instance whose sources are all computed, in one Python process.

See docs/how-to/use-the-laboratory.md.
"""

from shmio.lab.laboratory import Laboratory, prepare_laboratory

__all__ = ["Laboratory", "prepare_laboratory"]
