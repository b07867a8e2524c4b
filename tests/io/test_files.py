"""What every reader and writer does with a path."""

import errno
import hashlib
import os
import stat
from pathlib import Path

import pytest

from pointsplat_ns.errors import SceneError
from pointsplat_ns.io import content_hash
from pointsplat_ns.io.files import replacing


def test_content_hash_is_the_sha256_of_all_bytes(tmp_path):
    data = bytes(range(256)) * 10_000  # 2.56 MB: read in three pieces
    (tmp_path / "a.ply").write_bytes(data)
    assert content_hash(tmp_path / "a.ply") == hashlib.sha256(data).hexdigest()


def test_content_hash_of_no_file_is_refused(tmp_path):
    with pytest.raises(SceneError, match="no such file"):
        content_hash(tmp_path / "none.ply")
    with pytest.raises(SceneError, match="not a regular file"):
        content_hash(tmp_path)


def write(path: Path, text: str = "new") -> None:
    with replacing(path) as part:
        part.write_text(text)


@pytest.mark.parametrize("name", ["x" * 251 + ".ply", "\u00e9" * 125 + ".ply", "x" * 243, "x" * 244])
def test_every_name_that_the_file_system_takes_can_be_written(tmp_path, name):
    write(tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_text() == "new"


@pytest.mark.parametrize("name", ["x" * 256, "x" * 300 + "/a.ply", "\u00e9" * 128])
def test_a_name_that_is_too_long_is_the_error_that_is_told(tmp_path, name):
    with pytest.raises(SceneError, match=r"cannot be written \(File name too long\)"):
        write(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_a_read_only_file_system_is_the_error_that_is_told(tmp_path, monkeypatch):
    def refused(*_, **__):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(Path, "write_text", refused)
    monkeypatch.setattr(Path, "unlink", refused)
    with pytest.raises(SceneError, match=r"a.ply: cannot be written \(Read-only file system\)"):
        write(tmp_path / "a.ply")


@pytest.mark.parametrize("path", ["/proc/a.ply", "/dev/null/a.ply", "/dev/null", "file/a.ply", "nul\0/a.ply"])
def test_a_place_where_no_file_can_be_is_one_error(tmp_path, path):
    (tmp_path / "file").touch()
    with pytest.raises(
        SceneError, match="a.ply: cannot be written|/dev/null: not a regular file|holds a NUL character"
    ):
        write(tmp_path / path)
    assert stat.S_ISCHR(os.stat("/dev/null").st_mode)


@pytest.mark.parametrize("relative", [True, False])
def test_output_through_a_link_is_written_to_its_target(tmp_path, relative):
    (tmp_path / "real").mkdir()
    target, link = tmp_path / "real" / "a.ply", tmp_path / "link.ply"
    target.write_text("old")
    link.symlink_to("real/a.ply" if relative else target)
    write(link)
    assert link.is_symlink() and target.read_text() == "new"
    assert [path.name for path in target.parent.iterdir()] == ["a.ply"]
    target.unlink()
    write(link, "anew")
    assert link.is_symlink() and target.read_text() == "anew", "a link that led nowhere"


def test_links_in_a_circle_are_refused_and_stay(tmp_path):
    one, other = tmp_path / "one", tmp_path / "other"
    one.symlink_to(other)
    other.symlink_to(one)
    with pytest.raises(SceneError, match="one|other"):
        write(one)
    assert one.is_symlink() and other.is_symlink()


@pytest.mark.parametrize("mode", [0o600, 0o640, 0o444, 0o755])
def test_a_file_that_is_replaced_keeps_its_mode(tmp_path, mode):
    path = tmp_path / "a.ply"
    path.write_text("old")
    path.chmod(mode)
    with replacing(path) as part:
        part.write_text("new")
        assert stat.S_IMODE(part.stat().st_mode) & 0o077 == 0, "others could read it before it is complete"
    assert path.read_text() == "new" and stat.S_IMODE(path.stat().st_mode) == mode


def test_a_new_file_has_the_mode_of_any_new_file(tmp_path):
    (tmp_path / "any").touch()
    write(tmp_path / "a.ply")
    assert (tmp_path / "a.ply").stat().st_mode == (tmp_path / "any").stat().st_mode


def test_an_error_in_the_block_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "a.ply"
    path.write_text("old")
    with pytest.raises(KeyError), replacing(path) as part:
        part.write_text("half")
        raise KeyError
    assert path.read_text() == "old" and len(list(tmp_path.iterdir())) == 1
