"""Files that are written whole or not at all, and seals that tell whether they are still what was written.

The seal of `NAME.npz` is `NAME.json`, written last: its size in bytes and its SHA-256.
"""

import hashlib
import json
import os
from pathlib import Path
from typing import Any

LARGEST_JSON = 1 << 20
"""Bytes that a configuration or a seal may have: a damaged one is not read into memory."""


def write_whole(path: Path, data: bytes) -> None:
    """Writes a file so that at any moment its old or its new content is there, whole.

    Raises:
        OSError: naming the file; then its old content is untouched.
    """
    part = path.with_name(path.name + ".part")
    try:
        with open(part, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
        _sync_folder(path.parent)
    except OSError as error:
        _remove(part)
        raise OSError(error.errno, error.strerror, str(path)) from None


def write_sealed(path: Path, data: bytes) -> None:
    """Writes a file, then its seal."""
    write_whole(path, data)
    seal = {"size": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    write_whole(seal_of(path), (json.dumps(seal) + "\n").encode())


def check_seal(path: Path) -> None:
    """Compares a file with its seal, without reading it into memory.

    Raises:
        ValueError: saying what is wrong with the file.
        OSError: if one of the two can not be read.
    """
    seal = read_json(seal_of(path))
    size = path.stat().st_size
    if seal.get("size") != size:
        raise ValueError(f"{path.name} has {size} bytes, its seal says {seal.get('size')}")
    with open(path, "rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    if seal.get("sha256") != digest:
        raise ValueError(f"{path.name} is not what was written: its SHA-256 is another")


def remove_sealed(path: Path) -> None:
    """Removes a file and its seal, as far as they are there."""
    for each in (seal_of(path), path):
        _remove(each)


def seal_of(path: Path) -> Path:
    """The seal's file."""
    return path.with_suffix(".json")


def read_json(path: Path) -> dict[str, Any]:
    """A JSON table.

    Raises:
        ValueError: naming the file, if it holds something else.
        OSError: if it can not be read.
    """
    with open(path, "rb") as file:
        data = file.read(LARGEST_JSON + 1)
    if len(data) > LARGEST_JSON:
        raise ValueError(f"{path}: expected at most {LARGEST_JSON} bytes")
    try:
        values = json.loads(data)
    except RecursionError:
        raise ValueError(f"{path}: nested too deeply") from None
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    if not isinstance(values, dict):
        raise ValueError(f"{path}: expected a table of fields")
    return values


def _remove(path: Path) -> None:
    """Removes what is not needed; that it can not be removed harms nobody."""
    try:
        path.unlink(missing_ok=True)
    except OSError:
        return


def _sync_folder(folder: Path) -> None:
    """Hands new names in a folder to the disk, for the case that the power fails."""
    number = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)
