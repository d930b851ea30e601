"""Parsed meshes are kept on disk, and are those of the file as it is now."""

import numpy as np
import pytest

from nbs_pin.base.npz import read_npz, write_npz
from nbs_pin.robots import mesh_cache, meshes
from nbs_pin.robots.meshes import MeshError, read_mesh

SQUARE = """mtllib {materials}
v 0 0 0\nv 1 0 0\nv {x} 1 0\nv 0 1 0
usemtl red\nf 1 2 3\nusemtl none\nf 1 3 4
"""
RED = "newmtl red\nKd 1 0 0\n"
ONE = np.ones(3)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "a.obj").write_text(SQUARE.format(materials="a.mtl", x=1))
    (tmp_path / "a.mtl").write_text(RED)
    return tmp_path


def files(folder):
    return sorted((folder / "cache" / "nbs_pin" / "meshes").glob("*.npz"))


def same(parts, others):
    assert len(parts) == len(others) >= 1
    for part, other in zip(parts, others, strict=True):
        np.testing.assert_array_equal(part.vertices, other.vertices, strict=True)
        np.testing.assert_array_equal(part.faces, other.faces, strict=True)
        assert part.color == other.color


def test_a_mesh_is_parsed_once(folder, monkeypatch):
    parts = read_mesh(folder / "a.obj", ONE)
    assert {part.color for part in parts} >= {(1.0, 0.0, 0.0, 1.0)}
    assert len(files(folder)) == 1
    monkeypatch.setattr(meshes, "_read", None)
    same(read_mesh(folder / "a.obj", ONE), parts)


def test_another_content_scale_or_material_is_parsed_anew(folder):
    (folder / "b.obj").write_text(SQUARE.format(materials="a.mtl", x=1))
    first = read_mesh(folder / "a.obj", ONE)
    same(read_mesh(folder / "b.obj", ONE), first)
    assert len(files(folder)) == 1  # wherever the file lies
    double = read_mesh(folder / "a.obj", 2.0 * ONE)
    np.testing.assert_array_equal(np.ptp(double[0].vertices, axis=0), [2.0, 2.0, 0.0])
    (folder / "a.obj").write_text(SQUARE.format(materials="a.mtl", x=3))
    wide = read_mesh(folder / "a.obj", ONE)
    assert max(part.vertices[:, 0].max() for part in wide) == 3.0
    (folder / "a.mtl").write_text(RED.replace("1 0 0", "0 0 1"))
    assert {part.color for part in read_mesh(folder / "a.obj", ONE)} >= {(0.0, 0.0, 1.0, 1.0)}


@pytest.mark.parametrize("damage", [lambda data: data[: len(data) // 2], lambda data: b"", lambda data: data[::-1]])
def test_a_damaged_file_is_made_again(folder, damage):
    parts = read_mesh(folder / "a.obj", ONE)
    (file,) = files(folder)
    whole = file.read_bytes()
    file.write_bytes(damage(whole))
    same(read_mesh(folder / "a.obj", ONE), parts)
    assert len(file.read_bytes()) == len(whole)


def test_without_a_cache_directory_meshes_are_read_all_the_same(folder, monkeypatch):
    parts = read_mesh(folder / "a.obj", ONE)
    (folder / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder / "file"))
    same(read_mesh(folder / "a.obj", ONE), parts)


def test_without_a_home_directory_meshes_are_read_all_the_same(folder, monkeypatch):
    parts = read_mesh(folder / "a.obj", ONE)

    def homeless(*_):
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(mesh_cache.platformdirs, "user_cache_path", homeless)
    same(read_mesh(folder / "a.obj", ONE), parts)


def test_materials_count_by_what_they_say(folder):
    """Not by name, size and time, which packages that are built reproducibly share."""
    (folder / "other").mkdir()
    for where, text in ((folder, RED), (folder / "other", RED.replace("1 0 0", "0 0 1"))):
        (where / "a.obj").write_text(SQUARE.format(materials="a.mtl", x=1))
        (where / "a.mtl").write_text(text)
        mesh_cache.os.utime(where / "a.mtl", (1.0, 1.0))
    assert (1.0, 0.0, 0.0, 1.0) in {part.color for part in read_mesh(folder / "a.obj", ONE)}
    assert (0.0, 0.0, 1.0, 1.0) in {part.color for part in read_mesh(folder / "other" / "a.obj", ONE)}


def test_a_file_that_changes_while_it_is_read_is_not_kept_as_another(folder, monkeypatch):
    read = meshes._read

    def changing(path, *given):
        path.write_text(SQUARE.format(materials="a.mtl", x=9))
        return read(path, *given)

    monkeypatch.setattr(meshes, "_read", changing)
    assert max(part.vertices.max() for part in read_mesh(folder / "a.obj", ONE)) == 1.0


@pytest.mark.parametrize("change", [
    lambda arrays: {"one": np.zeros(3)},
    lambda arrays: arrays | {"faces 0": arrays["faces 0"] + 1000},
    lambda arrays: arrays | {"vertices 0": arrays["vertices 0"][:, :2]},
])  # fmt: skip
def test_an_intact_file_of_no_mesh_is_made_again(folder, change):
    parts = read_mesh(folder / "a.obj", ONE)
    (file,) = files(folder)
    write_npz(file, change(read_npz(file)))
    same(read_mesh(folder / "a.obj", ONE), parts)
    same(meshes._parts(read_npz(file)), parts)


def test_a_mesh_that_cannot_be_drawn_is_refused_each_time(folder):
    (folder / "a.obj").write_text("v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    for _ in range(2):
        with pytest.raises(MeshError, match="not finite"):
            read_mesh(folder / "a.obj", ONE)
    assert files(folder) == []


def test_what_was_used_longest_ago_goes_first(folder, monkeypatch):
    for k in range(1, 5):
        read_mesh(folder / "a.obj", k * ONE)
    sizes = [file.stat().st_size for file in files(folder)]
    for age, file in enumerate(files(folder)):
        mesh_cache.os.utime(file, (1e9 - age, 1e9 - age))
    oldest, *_, newest = reversed(files(folder))
    monkeypatch.setattr(mesh_cache, "MAX_BYTES", max(sizes) * 3)
    read_mesh(folder / "a.obj", 5 * ONE)
    assert len(files(folder)) == 3
    assert newest in files(folder)
    assert oldest not in files(folder)
