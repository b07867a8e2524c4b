"""The viewer for the web: found, downloaded once and checked, and filled in so that no text can change its page."""

import gzip
import io
import tracemalloc
import urllib.error
from pathlib import Path

import pytest

import pointsplat_ns as ps
from pointsplat_ns.pages.web_viewer import WebViewerPackage, filled, web_viewer
from web_viewers import INDEX, MEMBERS, package_of, read_page, small_viewer, tarball


@pytest.fixture(autouse=True)
def nothing_named(monkeypatch) -> None:
    """No viewer that the environment names."""
    monkeypatch.delenv("POINTSPLAT_WEB_VIEWER", raising=False)


def answering(monkeypatch, answer: bytes | Exception) -> list[str]:
    """Let each download give these bytes, or fail; the addresses that were asked for."""
    asked: list[str] = []

    def urlopen(address: str, timeout: float):
        asked.append(address)
        if isinstance(answer, Exception):
            raise answer
        return io.BytesIO(answer)

    monkeypatch.setattr("urllib.request.urlopen", urlopen)
    return asked


def test_it_is_downloaded_and_checked(monkeypatch):
    asked = answering(monkeypatch, tarball())
    assert web_viewer(package_of(tarball())) == small_viewer()
    assert asked == ["https://registry.npmjs.org/@playcanvas/supersplat-viewer/-/supersplat-viewer-1.36.2.tgz"]


@pytest.mark.parametrize("answer", [b"<html>log in first</html>", tarball()[:-1], tarball() + b"\0"])
def test_other_bytes_than_the_package_are_refused(answer, monkeypatch):
    answering(monkeypatch, answer)
    with pytest.raises(ps.PointSplatError, match=f"{len(answer)} bytes with another SHA-512.*; set"):
        web_viewer(package_of(tarball()))


@pytest.mark.parametrize("error", [urllib.error.URLError("no route"), TimeoutError("timed out")])
def test_without_a_network_it_says_what_to_do(error, monkeypatch):
    answering(monkeypatch, error)
    remedy = r"npm pack @playcanvas/supersplat-viewer@1\.36\.2"
    with pytest.raises(ps.PointSplatError, match=rf"cannot be downloaded \(.*\); set POINTSPLAT_WEB_VIEWER .*{remedy}"):
        web_viewer()


def test_a_local_package_is_taken_first_whatever_its_version(tmp_path, monkeypatch):
    asked = answering(monkeypatch, OSError("no network"))
    place = tmp_path / "viewer.tgz"
    place.write_bytes(tarball())
    monkeypatch.setenv("POINTSPLAT_WEB_VIEWER", str(place))
    assert web_viewer() == small_viewer() and asked == []


def without(name: str) -> dict[str, bytes]:
    return {member: data for member, data in MEMBERS.items() if member != name}


SCRIPT = "package/public/index.js"


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"no archive", "no tarball"),
        (b"", "no tarball"),
        (tarball()[:200], "no tarball, or a damaged one"),
        (gzip.compress(b"no archive" * 100), "no tarball, or a damaged one"),
        (tarball(without(SCRIPT)), "has no file package/public/index.js"),
        (tarball({**MEMBERS, SCRIPT: None}), "has no file package/public/index.js"),
        (tarball({**without(SCRIPT), "../public/index.js": b"", "package/public/../public/index.js": b""}), "no file"),
        (tarball({**MEMBERS, "package/zeros": bytes(1 << 20)}), "unpacks to more than 100,000 bytes"),
        (bytes(100_001), "larger than 100,000 bytes"),
    ],
    ids=["text", "empty", "cut", "no tar", "file missing", "link", "elsewhere", "bomb", "large"],
)
def test_a_local_file_that_is_no_package_is_refused_and_nothing_is_unpacked(data, words, tmp_path, monkeypatch):
    place = tmp_path / "a.tgz"
    place.write_bytes(data)
    monkeypatch.setenv("POINTSPLAT_WEB_VIEWER", str(place))
    with pytest.raises(ps.PointSplatError, match=f"a.tgz, which POINTSPLAT_WEB_VIEWER names: .*{words}") as raised:
        web_viewer(WebViewerPackage(largest=100_000))
    assert "\n" not in str(raised.value) and [*tmp_path.rglob("*")] == [place]


def test_a_small_file_that_unpacks_to_a_large_one_takes_no_memory(tmp_path, monkeypatch):
    (tmp_path / "a.tgz").write_bytes(gzip.compress(bytes(64 << 20), 1))
    monkeypatch.setenv("POINTSPLAT_WEB_VIEWER", str(tmp_path / "a.tgz"))
    tracemalloc.start()
    try:
        with pytest.raises(ps.PointSplatError, match="unpacks to more"):
            web_viewer(WebViewerPackage(largest=1_000_000))
        assert tracemalloc.get_traced_memory()[1] < 8 << 20, "bytes; all of it has eight times as many"
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("kind", ["nothing", "an empty folder", "a pipe"])
def test_a_local_place_without_a_package_is_named(kind, tmp_path, monkeypatch):
    place = tmp_path if kind == "an empty folder" else Path("/dev/zero") if kind == "a pipe" else tmp_path / "none"
    monkeypatch.setenv("POINTSPLAT_WEB_VIEWER", str(place))
    with pytest.raises(ps.PointSplatError, match="POINTSPLAT_WEB_VIEWER names: .*; expected a tarball"):
        web_viewer()


@pytest.mark.parametrize(
    "text", ["</script><script>alert(1)</script>", "<!-- <script>", "&lt;b&gt; \"'", "\u2028", r"\1 \g<0> $&", "台所"]
)
def test_no_text_changes_the_page_and_each_arrives_as_it_is(text):
    page = filled(small_viewer(), text, {"text": text, text: [1.5, None]})
    tags, title, values = read_page(page["index.html"])
    assert (title, values) == (text, {"text": text, text: [1.5, None]})
    assert b"<" not in page["index.html"].partition(b'id="sse-bootstrap">')[2].partition(b"</script>")[0]
    assert tags == read_page(filled(small_viewer(), "a", {})["index.html"])[0], "no element is added"
    assert {**page, "index.html": INDEX} == small_viewer(), "the other files are as they were"


def test_a_name_that_is_no_text_and_a_number_that_json_lacks():
    assert read_page(filled(small_viewer(), "a\udcff", {})["index.html"])[1] == "a?"
    with pytest.raises(ValueError):
        filled(small_viewer(), "a", {"fov": float("nan")})


@pytest.mark.parametrize("page", [b"", INDEX.replace(b"sse-bootstrap", b"other"), INDEX + INDEX])
def test_another_page_than_the_viewers_is_refused(page):
    with pytest.raises(ps.PointSplatError, match="elements <.*; expected one"):
        filled({"index.html": page}, "a", {})
