"""What every command shares: exit status, output, and errors as one clear line. No traceback reaches a user."""

from __future__ import annotations

import io
import json
import os
import sys
from collections.abc import Callable
from typing import Any

from shmio.errors import ShmioError
from shmio.logs import printable


def run(command: Callable[[], int | None]) -> int:
    """Run a command: 0 done, 1 failed with one line on standard error (argparse exits with 2 on wrong usage)."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # a terminal that is not UTF-8
    try:
        status = command() or 0
        sys.stdout.flush()
    except ShmioError as error:
        sys.stderr.write(f"{printable(str(error))}\n")
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


def dumps(value: Any, indent: int | None = None) -> str:
    """JSON that standard output can take, whatever its encoding."""
    utf8 = (sys.stdout.encoding or "").lower().replace("-", "") == "utf8"
    return json.dumps(value, indent=indent, ensure_ascii=not utf8)
