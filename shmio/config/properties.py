"""Properties files such as ``plc.ini``: lines ``key=value`` (D6.5, section 4.2)."""

from __future__ import annotations

from pathlib import Path

from shmio.errors import ConfigError

MAX_FILE_BYTES = 64 << 10


def read_properties(file: Path, key: str) -> dict[str, str]:
    """Read a properties file as text values; ``key`` is the section that names it, for messages.

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
        text = data.decode("utf-8-sig")
    except OSError as error:
        raise ConfigError(f"{key}.properties: {file}: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"{key}.properties: {file}: not UTF-8 at byte {error.start}") from None
    values: dict[str, str] = {}
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
        values[name] = value.strip()
    return values
