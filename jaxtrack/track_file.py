"""Tracks as a CSV file: one row for each live track and scan, every number in full precision."""

import contextlib
import os
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

import numpy as np

from jaxtrack.tracking import TrackRows
from jaxtrack.types import NO_DETECTION, STATE_DIM

UPPER = np.triu_indices(STATE_DIM)
"""Rows and columns of the upper triangle of a covariance, row by row."""

HEADER = (
    "time", "track", "x", "vx", "y", "vy", "z", "vz",
    *(f"p{i}{j}" for i, j in zip(*UPPER, strict=True)), "detection",
)  # fmt: skip
"""Columns: s, number, m and m/s, covariance in their products, row of the detection within the scan."""


class TrackWriter:
    """Writes into `PATH.partial`, which becomes `PATH` when all is written.

    Whatever goes wrong, the partial file keeps whole rows only.

    Args:
        path: the file to make.
        labels: `[S]` times of the scans, as they are to be written.
    """

    def __init__(self, path: Path, labels: Sequence[str]) -> None:
        self.path = path
        self.partial = partial_path(path)
        self.labels = labels

    def __enter__(self) -> "TrackWriter":
        """Opens the partial file."""
        self.file = open(self.partial, "wb")
        self._append(",".join(HEADER) + "\n")
        return self

    def write(self, rows: TrackRows) -> None:
        """Appends the rows and hands them to the system."""
        self._append(format_rows(rows, self.labels))

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Renames the file, or cuts it after its last whole row if something went wrong."""
        if kind is None:
            os.fsync(self.file.fileno())
            self.file.close()
            os.replace(self.partial, self.path)
            return
        with contextlib.suppress(OSError):
            self.file.close()
        os.truncate(self.partial, self.whole)

    def _append(self, text: str) -> None:
        self.file.write(text.encode())
        self.file.flush()
        self.whole = self.file.tell()


def partial_path(path: Path) -> Path:
    """Where the rows are while not all are written."""
    return path.with_name(path.name + ".partial")


def format_rows(rows: TrackRows, labels: Sequence[str]) -> str:
    """The lines of the file for these rows; a number is read back as exactly the same float64."""
    numbers = np.concatenate([rows.mean, rows.covariance[:, *UPPER]], axis=1).tolist()
    detections = ("" if row == NO_DETECTION else row for row in rows.detection.tolist())
    lines = zip(rows.scan.tolist(), rows.track.tolist(), numbers, detections, strict=True)
    # The text of a list is the fastest exact text of its floats.
    text = "".join(
        f"{labels[scan]},{track},{str(line)[1:-1]},{detection}\n" for scan, track, line, detection in lines
    )
    return text.replace(", ", ",")
