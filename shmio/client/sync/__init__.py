"""The synchronous client of ``shmio.v1``, for programs with threads: every call waits."""
