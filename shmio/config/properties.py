"""Properties files such as ``plc.ini``: lines ``key=value`` (D6.5, section 4.2)."""

from __future__ import annotations

from pathlib import Path

from shmio.config.wording import decode
from shmio.errors import ConfigError

MAX_FILE_BYTES = 64 << 10


def read_properties(file: Path, key: str) -> dict[str, tuple[str, int]]:
    """Read the text and line of each key; ``key`` is the section that names the file, for messages.

    Blank lines, ``[section]`` lines and lines that begin with ``#``, ``;`` or ``!`` are skipped.

    Raises:
        ConfigError: The file cannot be read, is too large or not UTF-8, or has an invalid line or
            a duplicate key.

    """
    try:
        with file.open("rb") as stream:
            data = stream.read(MAX_FILE_BYTES + 1)
        if len(data) > MAX_FILE_BYTES:
            raise ConfigError(f"{key}.properties: {file} is larger than {MAX_FILE_BYTES} bytes")
    except OSError as error:
        raise ConfigError(f"{key}.properties: {file}: {error.strerror}") from None
    text = decode(data, f"{key}.properties: {file}")
    values: dict[str, tuple[str, int]] = {}
    for number, line in enumerate(text.splitlines(), 1):
        stripped = line.strip()
        if not stripped or stripped[0] in "#;!" or (stripped[0] == "[" and stripped[-1] == "]"):
            continue
        name, equals, value = stripped.partition("=")
        name = name.strip()
        if not equals or not name:
            raise ConfigError(f"{key}.properties: {file}:{number}: expected key=value")
        if name in values:
            raise ConfigError(f"{key}.properties: {file}:{number}: {name} is given twice")
        values[name] = value.strip(), number
    return values
