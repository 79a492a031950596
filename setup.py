"""The C extension; everything else is in pyproject.toml.

``SHMIO_SANITIZE=address,undefined`` builds it under sanitizers (see .ci/checks).
"""

import os

from setuptools import Extension, setup
from setuptools.command.bdist_wheel import bdist_wheel

sanitizers = os.environ.get("SHMIO_SANITIZE")
flags = ["-std=c11", "-O2", "-Wall", "-Wextra", "-fvisibility=hidden"]
if os.environ.get("SHMIO_WERROR"):
    flags.append("-Werror")
link: list[str] = []
if sanitizers:
    flags += [f"-fsanitize={sanitizers}", "-fno-omit-frame-pointer", "-g", "-O1"]
    link += [f"-fsanitize={sanitizers}"]


class AbiWheel(bdist_wheel):
    """One wheel for every CPython from 3.11 on (limited API)."""

    def finalize_options(self) -> None:
        """Say which Pythons the extension serves."""
        self.py_limited_api = "cp311"
        super().finalize_options()


setup(
    ext_modules=[
        Extension(
            "shmio.segment._atomics",
            ["shmio/segment/_atomics.c"],
            depends=["shmio/segment/queue.h", "shmio/segment/relay.h", "shmio/segment/ring.h"],
            define_macros=[("Py_LIMITED_API", "0x030B0000")],
            py_limited_api=True,
            extra_compile_args=flags,
            extra_link_args=link,
        )
    ],
    cmdclass={"bdist_wheel": AbiWheel},
)
