"""The C extensions; everything else is in pyproject.toml.

``SHMIO_SANITIZE=address,undefined`` builds them under sanitizers (see .ci/checks).
"""

import os

from setuptools import Extension, setup
from setuptools.command.bdist_wheel import bdist_wheel

sanitizers = os.environ.get("SHMIO_SANITIZE")
flags = ["-std=c11", "-O2", "-Wall", "-Wextra", "-fvisibility=hidden"]
flags.append("-ffp-contract=off")  # so that injections compute the same on each machine, whatever the compiler
if os.environ.get("SHMIO_WERROR"):
    flags.append("-Werror")
link: list[str] = []
if sanitizers:
    flags += [f"-fsanitize={sanitizers}", "-fno-omit-frame-pointer", "-g", "-O1"]
    link += [f"-fsanitize={sanitizers}"]


class AbiWheel(bdist_wheel):
    """One wheel for every CPython from 3.11 on (limited API)."""

    def finalize_options(self) -> None:
        """Say which Pythons the extensions serve."""
        self.py_limited_api = "cp311"
        super().finalize_options()


def extension(name: str, *headers: str) -> Extension:
    """Return the extension of a module, whose C file is beside it."""
    file = name.replace(".", "/")
    return Extension(
        name,
        [f"{file}.c"],
        depends=[f"{file.rpartition('/')[0]}/{header}" for header in headers],
        define_macros=[("Py_LIMITED_API", "0x030B0000")],
        py_limited_api=True,
        extra_compile_args=flags,
        extra_link_args=link,
    )


setup(
    ext_modules=[
        extension("shmio.injection._numbers"),
        extension("shmio.recording.format._frames"),
        extension("shmio.segment._atomics", "frames.h", "queue.h", "relay.h", "ring.h"),
    ],
    cmdclass={"bdist_wheel": AbiWheel},
)
