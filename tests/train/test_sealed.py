"""Files written whole or not at all, and seals that find every change."""

import errno
import os

import pytest

from train.sealed import check_seal, read_json, remove_sealed, seal_of, write_sealed, write_whole


@pytest.mark.parametrize("call", ["fsync", "replace"])
@pytest.mark.parametrize("old", [b"old", None])
def test_a_file_that_can_not_be_written_is_as_it_was(tmp_path, monkeypatch, call, old):
    def refuse(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    path = tmp_path / "file"
    if old is not None:
        path.write_bytes(old)
    monkeypatch.setattr(os, call, refuse)
    with pytest.raises(OSError, match=rf"^\[Errno 28\] No space left on device: '{path}'$"):
        write_whole(path, b"new")
    assert [each.read_bytes() for each in tmp_path.iterdir()] == ([] if old is None else [old])


def test_a_file_that_is_cut_short_is_not_there(tmp_path, monkeypatch):
    """The power fails before the content is on the disk: then the name must not point to it."""
    path = tmp_path / "file"
    path.write_bytes(b"old")
    seen = []
    monkeypatch.setattr(os, "fsync", lambda _: seen.append(path.read_bytes()))
    write_whole(path, b"new")
    assert seen[0] == b"old"
    assert path.read_bytes() == b"new"


def test_every_changed_bit_breaks_the_seal(tmp_path):
    path = tmp_path / "file.npz"
    data = bytes(range(20))
    write_sealed(path, data)
    check_seal(path)
    for bit in range(8 * len(data)):
        changed = bytearray(data)
        changed[bit // 8] ^= 1 << (bit % 8)
        path.write_bytes(changed)
        with pytest.raises(ValueError, match=r"^file.npz is not what was written: its SHA-256 is another$"):
            check_seal(path)
    path.write_bytes(data)
    seal = seal_of(path).read_bytes()
    for bit in range(8 * len(seal) - 8):  # the last byte ends the line
        changed = bytearray(seal)
        changed[bit // 8] ^= 1 << (bit % 8)
        seal_of(path).write_bytes(changed)
        try:
            check_seal(path)
        except ValueError:
            continue
        # Only where JSON means the same, as by another space.
        assert read_json(seal_of(path)) == {"size": 20, "sha256": read_json(seal_of(path))["sha256"]}


def test_the_seal_is_written_last_and_removed_first(tmp_path, monkeypatch):
    path, names = tmp_path / "file.npz", []

    def noted(real):
        return lambda *where: (names.append(str(where[-1])), real(*where))

    for name in ("replace", "unlink"):
        monkeypatch.setattr(os, name, noted(getattr(os, name)))
    write_sealed(path, b"data")
    remove_sealed(path)
    assert [name.rpartition("/")[2] for name in names] == ["file.npz", "file.json", "file.json", "file.npz"]
    assert list(tmp_path.iterdir()) == []


def test_a_large_file_is_not_read_as_json(tmp_path):
    path = tmp_path / "file.json"
    path.touch()
    os.truncate(path, 1 << 40)
    with pytest.raises(ValueError, match="expected at most 1048576 bytes"):
        read_json(path)
