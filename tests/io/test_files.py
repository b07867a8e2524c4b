"""What every reader and writer does with a path."""

import hashlib

import pytest

from pointsplat_ns.errors import SceneError
from pointsplat_ns.io import content_hash


def test_content_hash_is_the_sha256_of_all_bytes(tmp_path):
    data = bytes(range(256)) * 10_000  # 2.56 MB: read in three pieces
    (tmp_path / "a.ply").write_bytes(data)
    assert content_hash(tmp_path / "a.ply") == hashlib.sha256(data).hexdigest()


def test_content_hash_follows_the_content_not_the_name_or_the_date(tmp_path):
    (tmp_path / "a.ply").write_bytes(b"scene")
    (tmp_path / "b.ply").write_bytes(b"scene")
    before = content_hash(tmp_path / "a.ply")
    assert content_hash(tmp_path / "b.ply") == before
    (tmp_path / "a.ply").write_bytes(b"scenf")
    assert content_hash(tmp_path / "a.ply") != before


def test_content_hash_of_no_file_is_refused(tmp_path):
    with pytest.raises(SceneError, match="no such file"):
        content_hash(tmp_path / "none.ply")
    with pytest.raises(SceneError, match="not a regular file"):
        content_hash(tmp_path)
