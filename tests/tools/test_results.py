import dataclasses
import errno
import json
import os
import stat

import numpy as np
import pytest

from creps_jax import files
from creps_jax.errors import UserError
from creps_jax.tools import results


@dataclasses.dataclass(frozen=True)
class Settings:
    iterations: int = 3
    speeds: tuple[float, ...] = (0.1, 0.2)


def test_arrays_come_back_as_they_were_saved(tmp_path):
    arrays = {
        "a": np.arange(6, dtype=np.float32).reshape(2, 3),
        "b.c": np.array(True),
        "names": np.array(["x", "yz"]),
    }
    files.save_arrays(tmp_path / "new" / "arrays.npz", arrays)
    loaded = files.load_arrays(tmp_path / "new" / "arrays.npz")
    assert loaded.keys() == arrays.keys()
    for name, values in arrays.items():
        np.testing.assert_array_equal(loaded[name], values)
        assert loaded[name].dtype == values.dtype


def test_a_full_disk_leaves_the_earlier_file_whole_and_nothing_else(tmp_path, monkeypatch):
    path = tmp_path / "arrays.npz"
    files.save_arrays(path, {"a": np.ones(3)})

    def fail(_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(UserError, match=r"cannot write .*arrays\.npz: No space left on device"):
        files.save_arrays(path, {"a": np.zeros(3)})
    assert os.listdir(tmp_path) == ["arrays.npz"]
    np.testing.assert_array_equal(files.load_arrays(path)["a"], np.ones(3))


def test_a_file_is_on_the_disk_before_its_name_is_and_then_the_folder(tmp_path, monkeypatch):
    done = []
    fsync, replace = os.fsync, os.replace

    def note_fsync(handle):
        done.append("folder" if stat.S_ISDIR(os.fstat(handle).st_mode) else "file")
        fsync(handle)

    def note_replace(*paths):
        done.append("name")
        replace(*paths)

    monkeypatch.setattr(os, "fsync", note_fsync)
    monkeypatch.setattr(os, "replace", note_replace)
    files.save_text(tmp_path / "file", "hello")
    assert done == ["file", "name", "folder"]


@pytest.mark.parametrize("code", [errno.EIO, errno.EINVAL])
def test_a_folder_that_cannot_be_synced_is_named_where_it_could_be(tmp_path, monkeypatch, code):
    def fail(_):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(os, "fsync", fail)
    if code == errno.EINVAL:
        files.sync_folder(tmp_path)
    else:
        with pytest.raises(UserError, match=r"may not last a loss of power: Input/output error"):
            files.sync_folder(tmp_path)


def test_a_writer_that_fails_leaves_no_trace(tmp_path):
    def fail(file):
        file.write(b"half")
        raise RuntimeError("no")

    with pytest.raises(RuntimeError):
        files.write_atomically(tmp_path / "file", fail)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("spoil", ["missing", "folder", "empty", "text", "truncated", "pickle", "npy"])
def test_files_that_are_no_arrays_get_one_clear_error(tmp_path, spoil):
    path = tmp_path / "arrays.npz"
    if spoil == "folder":
        path.mkdir()
    elif spoil == "empty":
        path.write_bytes(b"")
    elif spoil == "text":
        path.write_text("hello")
    elif spoil == "pickle":
        np.savez(path, a=np.array([{}], dtype=object))
    elif spoil == "npy":
        with open(path, "wb") as file:
            np.save(file, np.ones(3))
    elif spoil == "truncated":
        files.save_arrays(path, {"a": np.random.default_rng(0).normal(size=1000)})
        path.write_bytes(path.read_bytes()[:-500])
    with pytest.raises(UserError, match=r"arrays\.npz") as caught:
        files.load_arrays(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "error"),
    [
        (None, "cannot read .*: No such file"),
        (b"", "cut short, or no JSON"),
        (b'{"a": 1', "cut short, or no JSON"),
        (b"\xff\xfe", "cut short, or no JSON"),
        (b'{"a": {"b": 1, "c": 2, "b": 3}}', "the field 'b' is there twice"),
    ],
)
def test_files_that_are_no_json_get_one_clear_error(tmp_path, content, error):
    path = tmp_path / "file.json"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(UserError, match=error) as caught:
        files.load_json(path)
    assert "file.json" in str(caught.value) and "\n" not in str(caught.value)


def test_new_folders_never_take_one_that_is_there(tmp_path):
    folders = {results.new_folder(tmp_path / "walk", "stamp") for _ in range(3)}
    assert {folder.name for folder in folders} == {"stamp", "stamp-2", "stamp-3"}


def test_manifest_says_how_results_came_about(tmp_path):
    manifest = results.make_manifest("walk", "quick", Settings(), seed=3)
    files.save_json(tmp_path / results.MANIFEST, manifest)
    loaded = results.load_manifest(tmp_path)
    assert loaded["settings"] == {"iterations": 3, "speeds": [0.1, 0.2]}
    assert (loaded["experiment"], loaded["preset"], loaded["seed"]) == ("walk", "quick", 3)
    assert loaded["packages"].keys() >= {"jax", "numpy", "mujoco"}
    assert all(loaded[name] for name in ("version", "python", "processor", "cores", "started"))


@pytest.mark.parametrize("text", ["", "{", "[]", '{"experiment": "walk"}'])
def test_a_manifest_that_is_none_gets_one_clear_error(tmp_path, text):
    (tmp_path / results.MANIFEST).write_text(text)
    with pytest.raises(UserError, match="manifest"):
        results.load_manifest(tmp_path)


def test_latest_folder_goes_by_start_and_status(tmp_path):
    for name, started, status in (
        ("b", "2026-01-01", "finished"),
        ("a", "2026-01-02", "finished"),
        ("c", "2026-01-03", "running"),
    ):
        (tmp_path / "walk" / name).mkdir(parents=True)
        manifest = {"settings": {}, "started": started, "status": status}
        (tmp_path / "walk" / name / results.MANIFEST).write_text(json.dumps(manifest))
    assert results.latest_folder("walk", status="finished", root=tmp_path).name == "a"
    assert results.latest_folder("walk", root=tmp_path).name == "c"
    assert results.latest_folder("other", root=tmp_path) is None
