"""Several training seeds of one configuration: a folder that holds the run folder of each."""

import contextlib
import dataclasses
import json
import time
from collections.abc import Iterator
from pathlib import Path

from jaxtrack.cli import LARGEST_SEED, require_integer
from train.config import TrainConfig, check, first_difference, from_dict, to_dict
from train.devices import with_devices
from train.recorded import with_recording
from train.run_folder import Run, resume_command, resume_run, start_run
from train.saved_run import read_config
from train.sealed import read_json, write_whole

SEEDS = "seeds.json"
"""What a folder of several seeds holds beside their folders: the configuration, of which `seed` is the
first one, and how many there are."""


@dataclasses.dataclass(frozen=True)
class Seeds:
    """Trainings that differ in nothing but their seed, and their folder.

    Attributes:
        folder: where theirs lie, and what is written about all of them.
        config: what they do; its `seed` is the first.
        number: how many seeds there are, one after the other.
        evaluation_episodes: the configuration's, or what was asked for when they were resumed.
    """

    folder: Path
    config: TrainConfig
    number: int
    evaluation_episodes: int

    @property
    def seeds(self) -> range:
        """The training seeds."""
        return range(self.config.seed, self.config.seed + self.number)

    @property
    def folders(self) -> list[Path]:
        """The run folder of each seed, made or not."""
        return [self.folder_of(seed) for seed in self.seeds]

    def folder_of(self, seed: int) -> Path:
        """The run folder of one seed."""
        return self.folder / f"seed{seed}"

    @property
    def resume_command(self) -> str:
        """What continues them."""
        return resume_command(self.folder)

    @property
    def finished(self) -> bool:
        """All are trained and compared: results.json is the last file."""
        return (self.folder / "results.json").exists()

    @contextlib.contextmanager
    def open(self, seed: int) -> Iterator[Run]:
        """The run of a seed, new or resumed, as it would be alone; but it tells how to continue all of them.

        Raises:
            ValueError: one line, if its folder holds another run, or nothing intact to continue from.
            OSError: if the folder can not be written, or another training writes there.
        """
        folder = self.folder_of(seed)
        config = dataclasses.replace(self.config, seed=seed, out=str(folder))
        if (folder / "config.json").exists():
            self._require_own(folder, config)
            opened = resume_run(folder, self.evaluation_episodes)
        else:
            with contextlib.suppress(OSError):
                folder.rmdir()  # empty, if it was killed before it wrote
            opened = start_run(config)
        with opened as run:
            yield dataclasses.replace(run, belongs_to=self.folder)

    def _require_own(self, folder: Path, config: TrainConfig) -> None:
        own = dataclasses.replace(read_config(folder)[0], out=config.out)  # it may have been moved
        if found := first_difference(to_dict(own), to_dict(config)):
            name, here, there = found
            raise ValueError(
                f"{folder / 'config.json'}: {name} = {here!r}, but {self.folder / SEEDS} says {there!r}"
            )


@contextlib.contextmanager
def start_seeds(config: TrainConfig, number: int) -> Iterator[Seeds]:
    """Makes the folder of new runs, which must not exist.

    Raises:
        ValueError: one line, if the configuration can not run.
        OSError: if the folder can not be made.
    """
    check(config)
    config = with_devices(config)
    require_integer("seeds", number, 1, LARGEST_SEED + 1 - config.seed)
    seeds = f"seeds{config.seed}-{config.seed + number - 1}"
    folder = Path(config.out or f"runs/{config.encoder}-{seeds}-{time.strftime('%Y%m%d-%H%M%S')}")
    folder.mkdir(parents=True, exist_ok=False)
    text = json.dumps({"seeds": number, "config": to_dict(config)}, indent=2) + "\n"
    write_whole(folder / SEEDS, text.encode())
    yield Seeds(folder, config, number, config.evaluation_episodes)


def read_seeds(folder: Path) -> Seeds:
    """What a folder of several seeds says.

    Raises:
        ValueError: naming the file and what is wrong with it.
    """
    path = folder / SEEDS
    try:
        values = read_json(path)
        number, config = values.get("seeds"), with_recording(from_dict(values.get("config", {})))
        check(dataclasses.replace(config, out=""))
        if type(number) is not int:
            raise ValueError(f"seeds = {number!r}: expected an integer")
        require_integer("seeds", number, 1, LARGEST_SEED + 1 - config.seed)
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}") from None
    except ValueError as error:
        said = str(error).removeprefix(f"{path}: ")
        raise ValueError(f"{path}: {said}") from None
    return Seeds(folder, config, number, config.evaluation_episodes)


def holds_seeds(folder: Path) -> bool:
    """Whether a folder is one of several seeds."""
    return (folder / SEEDS).exists()


def run_folders(folder: Path) -> list[Path]:
    """The folder itself if it is that of a run, or those of its seeds.

    Raises:
        ValueError: as `read_seeds`.
    """
    return read_seeds(folder).folders if holds_seeds(folder) else [folder]
