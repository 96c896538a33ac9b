"""A recording as the truths of a training: config.json has the file's name and digest, not what it holds."""

import dataclasses
import hashlib
from pathlib import Path

from jaxtrack.scenarios import read_recording
from train.config import TrainConfig

RESAMPLED_BY = ("time_step", "field_limit", "max_range")
"""Numbers of the scenario that say what the radar sees of a recording, and when."""


def with_recording(config: TrainConfig) -> TrainConfig:
    """The configuration with its recording's trajectories among the numbers, and the file's digest.

    Where there is no recording, the configuration as it is.

    Raises:
        ValueError: naming the recording, if the file can not be used, or is not the one with the digest.
    """
    if not config.recording:
        return config
    path, params = Path(config.recording), config.params
    try:
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ValueError(f"recording = {config.recording!r}: {reason}") from None
    if config.recording_sha256 not in ("", digest):
        raise ValueError(
            f"recording = {config.recording!r}: is not the file of the training: its SHA-256 is {digest}, "
            f"expected {config.recording_sha256}"
        )
    numbers = {name: getattr(params, name) for name in RESAMPLED_BY}
    fields = read_recording(path, num_steps=int(params.max_steps_in_episode), **numbers)
    params = dataclasses.replace(params, trajectories=fields["trajectories"])
    return dataclasses.replace(config, params=params, recording_sha256=digest)
