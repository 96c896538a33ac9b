"""Files of a run, damaged in every way: what is loaded is what was saved, or a line says why not."""

import hashlib
import io
import json
import os
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest

from tests.train.small_run import CONFIG, assert_same, at, random_state, without_clock, write_run
from train.metrics_file import MetricsFile
from train.run_folder import Run, resume_run
from train.saved_run import load_run
from train.sealed import seal_of

UPDATES = (10, 20)
EXPLODED = "unpickled"


@pytest.fixture(scope="module")
def state():
    return random_state()


@pytest.fixture(scope="module")
def intact(state, tmp_path_factory):
    """A run with two checkpoints and the rows of 23 updates."""
    folder = tmp_path_factory.mktemp("runs") / "intact"
    folder.mkdir()
    write_run(folder, state, written=())
    with MetricsFile(folder) as metrics:
        for update in range(1, 24):
            metrics.write(
                {"update": update, "env_steps": 4 * update, "seconds": update, "reward": update / 3}
            )
            if update in UPDATES:
                Run(folder, CONFIG, 0, metrics).save(at(state, update))
    return folder


class Exploding:
    """Makes a folder when it is unpickled."""

    def __init__(self, folder):
        self.folder = str(folder)

    def __reduce__(self):
        return os.mkdir, (self.folder,)


def truncate(path, rng):
    data = path.read_bytes()
    path.write_bytes(data[: rng.integers(len(data))])


def flip_one_bit(path, rng):
    flip(path, rng, 1)


def flip_many_bits(path, rng):
    flip(path, rng, 40)


def flip(path, rng, number):
    data = bytearray(path.read_bytes())
    for place in rng.integers(8 * len(data), size=number):
        data[place // 8] ^= 1 << (place % 8)
    path.write_bytes(data)


def delete(path, rng):
    path.unlink()


def empty(path, rng):
    path.write_bytes(b"")


def overwrite_with_noise(path, rng):
    path.write_bytes(rng.bytes(path.stat().st_size))


def zero_a_block(path, rng):
    data = bytearray(path.read_bytes())
    start = rng.integers(len(data))
    data[start : start + 512] = bytes(len(data[start : start + 512]))
    path.write_bytes(data)


def append(path, rng):
    path.write_bytes(path.read_bytes() + rng.bytes(30))


def make_a_folder_of_it(path, rng):
    path.unlink()
    path.mkdir()


def make_a_loop_of_it(path, rng):
    path.unlink()
    path.symlink_to(path)


def swap_with_another(path, rng):
    """With another file that is not metrics.csv, without which a run can be evaluated but not resumed."""
    run = path.parent.parent if path.parent.name == "checkpoints" else path.parent
    others = [run / file for file in FILES if run / file != path]
    other = others[rng.integers(len(others))]
    mine, theirs = path.read_bytes(), other.read_bytes()
    path.write_bytes(theirs)
    other.write_bytes(mine)


def claim_a_huge_size(path, rng):
    """A terabyte: as a file of zeros that takes no space, and as a number in a seal or a configuration."""
    if path.suffix == ".npz":
        os.truncate(path, 1 << 40)
    elif path.suffix == ".json":
        numbers = json.loads(path.read_text())
        name = "size" if "size" in numbers else "num_envs"
        path.write_text(json.dumps({**numbers, name: 1 << 40}))
    else:
        path.write_bytes(path.read_bytes() * 100)


def change_within(path, change):
    """Another content of a checkpoint under a seal that fits, as no accident but a bad program makes it."""
    if path.suffix != ".npz":
        path = (
            path.parent / "20.npz"
            if path.parent.name == "checkpoints"
            else path.parent / "checkpoints/20.npz"
        )
    with np.load(path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    buffer = io.BytesIO()
    change(arrays, buffer)
    path.write_bytes(buffer.getvalue())
    seal = {"size": len(buffer.getvalue()), "sha256": hashlib.sha256(buffer.getvalue()).hexdigest()}
    seal_of(path).write_text(json.dumps(seal))


def claim_another_format(path, rng):
    def change(arrays, buffer):
        about = json.loads(str(arrays["about"]))
        np.savez(buffer, **{**arrays, "about": np.array(json.dumps({**about, "format": 3}))})

    change_within(path, change)


def leave_out_an_array(path, rng):
    def change(arrays, buffer):
        arrays.pop(sorted(arrays)[rng.integers(len(arrays))])
        np.savez(buffer, **arrays)

    change_within(path, change)


def claim_a_huge_array(path, rng):
    def change(arrays, buffer):
        np.savez(buffer, **arrays)
        header = io.BytesIO()
        np.lib.format.write_array_header_1_0(
            header, {"descr": "<f4", "fortran_order": False, "shape": (1 << 42,)}
        )
        with zipfile.ZipFile(buffer, "a") as file:
            file.writestr("weights/more.npy", header.getvalue())

    change_within(path, change)


def pickle_something(path, rng):
    def change(arrays, buffer):
        np.savez(buffer, **{**arrays, "key": np.array([Exploding(path.parent / EXPLODED)], dtype=object)})

    change_within(path, change)


KINDS = (
    truncate,
    flip_one_bit,
    flip_many_bits,
    delete,
    empty,
    overwrite_with_noise,
    zero_a_block,
    append,
    make_a_folder_of_it,
    make_a_loop_of_it,
    swap_with_another,
    claim_a_huge_size,
    claim_another_format,
    leave_out_an_array,
    claim_a_huge_array,
    pickle_something,
)
FILES = ("config.json", *(f"checkpoints/{update}.{end}" for update in UPDATES for end in ("npz", "json")))


@pytest.mark.parametrize(
    "number", [pytest.param(20, marks=pytest.mark.medium), pytest.param(200, marks=pytest.mark.slow)]
)
def test_damage_is_never_loaded(intact, state, tmp_path, capsys, number):
    rng = np.random.default_rng(number)
    told = {"loaded": 0, "fell back": 0, "refused": 0}
    for trial in range(number):
        kind, file = KINDS[trial % len(KINDS)], FILES[rng.integers(len(FILES))]
        folder = tmp_path / f"{trial}-{kind.__name__}"
        shutil.copytree(intact, folder)
        kind(folder / file, rng)
        told[outcome(folder, state, capsys)] += 1
    assert not list(tmp_path.rglob(EXPLODED))
    assert sum(told.values()) == number
    assert all(told.values())
    with capsys.disabled():
        print(f" {number} mutations: {told} ", end="")


def outcome(folder, state, capsys):
    """What loading a damaged run and resuming it come to, which must be the same; anything else fails."""
    capsys.readouterr()
    try:
        config, _, weights = load_run(folder)
    except ValueError as error:
        assert_one_line(error, folder)
        with pytest.raises(ValueError) as again:  # noqa: PT011  # compared below
            resume(folder)
        assert_one_line(again.value, folder)
        return "refused"
    said = capsys.readouterr().out
    update = next(each for each in UPDATES if f"{folder}: using the checkpoint of update {each}\n" in said)
    assert config == CONFIG
    assert_same(weights, at(state, update).weights)
    resumed = resume(folder)
    assert resumed.done == update
    assert_same(resumed.state, at(state, update))
    assert resumed.metrics.lost == 0
    assert len(without_clock(folder)) == 1 + update
    if update == UPDATES[-1]:
        return "loaded"
    assert f"{folder}: the checkpoint of update 20 is damaged (" in said
    return "fell back"


def resume(folder):
    with resume_run(folder, 0) as run:
        return run


def assert_one_line(error, folder):
    assert "\n" not in str(error)
    assert str(folder) in str(error) or str(error).startswith("checkpoint of update ")


@pytest.mark.parametrize("kind", [each for each in KINDS if "change_within" not in each.__code__.co_names])
def test_damaged_metrics_are_found_by_their_digest(intact, tmp_path, kind, capsys):
    for trial in range(4):
        folder = tmp_path / str(trial)
        shutil.copytree(intact, folder)
        kind(folder / "metrics.csv", np.random.default_rng(trial))
        try:
            lost = resume(folder).metrics.lost
        except (ValueError, OSError) as refused:
            error = refused
        else:
            # Nothing that counts was hit, or the file was empty or gone, which is said.
            assert lost == 20 or without_clock(folder) == without_clock(intact)[:21]
            assert lost == 0 or "earlier rows are lost" in capsys.readouterr().out
            continue
        assert_one_line(error, folder)
        assert isinstance(error, ValueError) or kind in (make_a_folder_of_it, make_a_loop_of_it)


def test_a_run_is_found_by_its_path_from_anywhere(intact, tmp_path, monkeypatch):
    monkeypatch.chdir(intact.parent)
    assert load_run(Path(intact.name))[0] == CONFIG
