"""The meaning of a declared injection: target, condition, operation and activation.

Pure, no I/O.
"""

from shmio.injection.program import Program, compile_program

__all__ = ["Program", "compile_program"]
