"""What every command shares: exit status, and errors as one clear line. No traceback reaches a user."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable

from shmio.errors import ShmioError


def run(command: Callable[[], int | None]) -> int:
    """Run a command: 0 done, 1 failed with one line on standard error (argparse exits with 2 on wrong usage)."""
    try:
        status = command() or 0
        sys.stdout.flush()
    except ShmioError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        # Who read our output went away (`| head`); keep the interpreter from complaining when it flushes at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except OSError as error:
        sys.stderr.write(f"{error.filename or 'shmio'}: {error.strerror}\n")
        return 1
    return status
