"""metrics.csv: one row per update, cut back and continued by a resumed training, locked while one writes."""

import csv
import errno
import fcntl
import hashlib
import math
import os
from pathlib import Path
from types import TracebackType

CLOCK = ("seconds", "steps_per_second")
"""Columns in which two runs of the same configuration differ."""


class MetricsFile:
    """The open file of a run's folder.

    Attributes:
        path: where it is.
        lost: updates before the first row; 0 unless the file was removed and the training resumed.
        num_rows: whole rows.
        seconds: the last row's, of all parts of a resumed training together; 0 without a row.
        last: the last row's cells by column; empty without a row.
    """

    def __init__(self, folder: Path) -> None:
        """Opens the file, or a new one, and locks it against a second training.

        Raises:
            OSError: naming the file, if that is not possible.
        """
        self.path = folder / "metrics.csv"
        # A damaged byte must not stop the reader: the checksum of its row will tell.
        self._file = open(self.path, "a+", newline="", encoding="ascii", errors="replace")  # noqa: SIM115
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            self._file.close()
            busy = error.errno in (errno.EAGAIN, errno.EACCES)
            reason = "another training is writing into this folder" if busy else error.strerror
            raise OSError(error.errno, reason, str(self.path)) from None
        self._file.seek(0)
        text = self._file.read()
        whole_lines = text.split("\n")[:-1]
        self._columns = _cells(whole_lines[0]) if whole_lines else []
        self._rows = [_cells(line) for line in whole_lines[1:]]
        self._ends = [len(line) + 1 for line in whole_lines]
        self._empty = not text
        self._digest = hashlib.sha256()
        self.lost, self.num_rows, self.seconds = 0, len(self._rows), 0.0
        self.last: dict[str, str] = {}

    def __enter__(self) -> "MetricsFile":
        """The file itself."""
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Closes the file, which ends the lock."""
        try:
            self._file.close()
        except OSError:  # half a row that found no place on the disk; it is cut off when resumed
            if error is None:
                raise

    def cut(self, update: int, digest: str = "") -> None:
        """Keeps the rows up to that of `update`, whose `digest` the checkpoint holds; none for update 0.

        A file that was removed or is empty begins anew, with `lost` updates before its first row.

        Raises:
            ValueError: if one of the rows is missing or was changed.
        """
        self.lost = update
        kept = []
        if update and not self._empty:
            kept = self._read_rows(update)
            if not kept or self.digest != digest:
                raise ValueError(
                    f"{self.path}: rows up to update {update} are missing or damaged; "
                    "move the file away to continue without them"
                )
            self.last, self.seconds = kept[-1], float(kept[-1]["seconds"])
        self._file.truncate(sum(self._ends[: len(kept) + 1]) if kept else 0)
        self._file.seek(0, os.SEEK_END)
        self.num_rows = len(kept)

    def _read_rows(self, update: int) -> list[dict[str, str]]:
        """The rows up to `update`, added to the digest; none if that one is missing or not a row."""
        kept = []
        try:
            self.lost = int(self._rows[0][self._columns.index("update")]) - 1
            for cells in self._rows[: update - self.lost]:
                kept.append(dict(zip(self._columns, cells, strict=True)))
                self._add_to_digest(kept[-1])
            float(kept[-1]["seconds"])
        except (ValueError, LookupError):
            return []
        return kept

    @property
    def digest(self) -> str:
        """SHA-256 of the names and values of all rows, without the clock's."""
        return self._digest.hexdigest()

    def _add_to_digest(self, row: dict[str, str]) -> None:
        told = [f"{name}={value}" for name, value in row.items() if name not in CLOCK]
        self._digest.update((",".join(told) + "\n").encode())

    def write(self, row: dict[str, float]) -> None:
        """Appends a row, with the header before the first, and hands it to the system.

        Raises:
            OSError: naming the file.
            ValueError: if the rows before have other columns.
        """
        values = {name: "" if math.isnan(value) else f"{value:.8g}" for name, value in row.items()}
        writer = csv.DictWriter(self._file, fieldnames=list(row))
        if self.num_rows and list(row) != self._columns:
            raise ValueError(f"{self.path}: expected the columns {', '.join(row)}")
        try:
            if not self.num_rows:
                writer.writeheader()
            writer.writerow(values)
            self._file.flush()
        except OSError as error:
            error.filename = str(self.path)
            raise
        self._columns = list(row)
        self.num_rows += 1
        self.last = values
        self._add_to_digest(values)

    def sync(self) -> None:
        """Hands the rows to the disk, for the case that the power fails."""
        os.fsync(self._file.fileno())


def _cells(line: str) -> list[str]:
    return line.rstrip("\r").split(",")
