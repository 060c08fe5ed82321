from __future__ import annotations

import errno
import json
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from tensor_stereo.datasets.download import disk_space, transfer
from tensor_stereo.datasets.download.transfer import discard_part, fetch_part
from tests.datasets.file_server import Site, serve

CONTENT = bytes(range(256)) * 4000  # several blocks
PATH = "/data/a.zip"


@pytest.fixture(autouse=True)
def _no_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transfer, "_PAUSES_S", (0.0, 0.0))
    monkeypatch.setenv("no_proxy", "*")


@pytest.fixture
def site() -> Iterator[Site]:
    with serve(Site({PATH: CONTENT})) as served:
        yield served


class Log(list[tuple[int, int | None]]):
    def __call__(self, done: int, total: int | None) -> None:
        self.append((done, total))


def fetch(site: Site, part: Path) -> Log:
    log = Log()
    fetch_part(site.url + PATH, part, progress=log)
    return log


def break_off(site: Site, part: Path, num_bytes: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave ``num_bytes`` in ``part``, as an interrupted run does."""
    with monkeypatch.context() as patch:
        patch.setattr(transfer, "_PAUSES_S", ())
        site.cuts = [num_bytes]
        with pytest.raises(OSError, match="goes on from there"):
            fetch(site, part)
    site.requests.clear()
    assert part.stat().st_size == num_bytes


def test_a_file_arrives_whole_and_progress_tells_every_block(site, tmp_path):
    log = fetch(site, tmp_path / "a.part")
    assert (tmp_path / "a.part").read_bytes() == CONTENT
    assert log[0] == (0, len(CONTENT))
    assert log[-1] == (len(CONTENT), len(CONTENT))
    assert log == sorted(log)
    assert len(log) > 3
    assert site.requests == [(PATH, None, None)]


@pytest.mark.parametrize(
    ("etag", "last_modified", "condition"),
    [
        ('"1"', None, '"1"'),
        ('"1"', "Wed, 21 Oct 2015 07:28:00 GMT", '"1"'),
        (None, "Wed, 21 Oct 2015 07:28:00 GMT", "Wed, 21 Oct 2015 07:28:00 GMT"),
        ('W/"1"', "Wed, 21 Oct 2015 07:28:00 GMT", "Wed, 21 Oct 2015 07:28:00 GMT"),
        ('W/"1"', None, None),
    ],
)
def test_a_broken_connection_is_taken_up_where_it_broke(site, tmp_path, etag, last_modified, condition):
    site.etag, site.last_modified, site.cuts = etag, last_modified, [300_000, 70_000]
    fetch(site, tmp_path / "a.part")
    assert (tmp_path / "a.part").read_bytes() == CONTENT
    assert site.requests == [
        (PATH, None, None),
        (PATH, "bytes=300000-", condition),
        (PATH, "bytes=370000-", condition),
    ]


def test_a_connection_that_breaks_often_but_brings_bytes_is_not_given_up(site, tmp_path):
    site.cuts = [1000] * 7
    fetch(site, tmp_path / "a.part")
    assert (tmp_path / "a.part").read_bytes() == CONTENT
    assert [asked for _, asked, _ in site.requests[1:]] == [f"bytes={1000 * k}-" for k in range(1, 8)]


def test_a_later_run_goes_on_from_the_partial_file(site, tmp_path, monkeypatch):
    break_off(site, tmp_path / "a.part", 123_456, monkeypatch)
    log = fetch(site, tmp_path / "a.part")
    assert (tmp_path / "a.part").read_bytes() == CONTENT
    assert site.requests == [(PATH, "bytes=123456-", '"1"')]
    assert log[0] == (123_456, len(CONTENT))


def test_a_complete_partial_file_is_not_asked_for(site, tmp_path):
    fetch(site, tmp_path / "a.part")
    site.requests.clear()
    assert fetch(site, tmp_path / "a.part") == [(len(CONTENT), len(CONTENT))]
    assert site.requests == []


def test_a_server_without_ranges_starts_anew(site, tmp_path, monkeypatch):
    site.has_ranges = False
    break_off(site, tmp_path / "a.part", 5000, monkeypatch)
    fetch(site, tmp_path / "a.part")
    assert (tmp_path / "a.part").read_bytes() == CONTENT
    assert site.requests == [(PATH, "bytes=5000-", '"1"')]


@pytest.mark.parametrize("heeds_if_range", [True, False])
@pytest.mark.parametrize("content", [CONTENT[::-1], CONTENT[::-1] + b"more", b"less"])
def test_a_changed_file_starts_anew(site, tmp_path, monkeypatch, heeds_if_range, content):
    break_off(site, tmp_path / "a.part", 5000, monkeypatch)
    site.files[PATH], site.etag, site.heeds_if_range = content, '"2"', heeds_if_range
    fetch(site, tmp_path / "a.part")
    assert (tmp_path / "a.part").read_bytes() == content
    assert site.requests[0] == (PATH, "bytes=5000-", '"1"')


def test_a_file_of_another_size_starts_anew_even_with_the_same_etag(site, tmp_path, monkeypatch):
    break_off(site, tmp_path / "a.part", 5000, monkeypatch)
    site.files[PATH] = CONTENT[::-1] + b"more"
    fetch(site, tmp_path / "a.part")
    assert (tmp_path / "a.part").read_bytes() == CONTENT[::-1] + b"more"


def test_a_file_that_nothing_identifies_starts_anew(site, tmp_path, monkeypatch):
    site.etag = None
    break_off(site, tmp_path / "a.part", 5000, monkeypatch)
    fetch(site, tmp_path / "a.part")
    assert (tmp_path / "a.part").read_bytes() == CONTENT
    assert site.requests == [(PATH, None, None)]


@pytest.mark.parametrize("source", ["", "[]", '{"url": 1}', None])
def test_a_partial_file_of_unknown_source_starts_anew(site, tmp_path, source):
    part = tmp_path / "a.part"
    part.write_bytes(b"something else")
    if source is not None:
        (tmp_path / "a.part.json").write_text(source)
    fetch(site, part)
    assert part.read_bytes() == CONTENT
    assert site.requests == [(PATH, None, None)]


def test_a_partial_file_of_another_address_starts_anew(site, tmp_path, monkeypatch):
    break_off(site, tmp_path / "a.part", 5000, monkeypatch)
    site.files["/mirror"] = CONTENT[::-1]
    fetch_part(f"{site.url}/mirror", tmp_path / "a.part", progress=Log())
    assert (tmp_path / "a.part").read_bytes() == CONTENT[::-1]
    assert site.requests == [("/mirror", None, None)]


def test_a_server_that_does_not_tell_the_length_is_read_to_the_end(site, tmp_path):
    site.tells_length = False
    log = fetch(site, tmp_path / "a.part")
    assert (tmp_path / "a.part").read_bytes() == CONTENT
    assert log[-1] == (len(CONTENT), None)


def test_tries_end_when_no_new_byte_arrives(site, tmp_path):
    site.cuts = [4000, 0, 0, 0, 0]
    with pytest.raises(OSError, match="also after 2 more tries") as error:
        fetch(site, tmp_path / "a.part")
    for part in (site.url + PATH, "ended after 4,000 of", "first 4,000 bytes are kept", str(tmp_path / "a.part")):
        assert part in str(error.value)
    assert len(site.requests) == 3  # one that brought bytes, two that did not
    site.cuts = []
    fetch(site, tmp_path / "a.part")
    assert (tmp_path / "a.part").read_bytes() == CONTENT


def test_an_unreachable_server_is_tried_again_and_named(tmp_path):
    with serve(Site()) as gone:
        pass
    with pytest.raises(OSError, match=f"{gone.url}/a: the connection broke .*refused"):
        fetch_part(f"{gone.url}/a", tmp_path / "a.part", progress=Log())


@pytest.mark.parametrize("status", [408, 429, 500, 503])
def test_a_busy_server_is_asked_again(site, tmp_path, status):
    site.statuses = [status, status]
    fetch(site, tmp_path / "a.part")
    assert (tmp_path / "a.part").read_bytes() == CONTENT


@pytest.mark.parametrize("status", [403, 404, 410])
def test_a_refusal_names_address_and_status_at_once(site, tmp_path, status):
    site.statuses = [status]
    with pytest.raises(OSError, match=f"{site.url}{PATH}: the server answered {status} "):
        fetch(site, tmp_path / "a.part")
    assert len(site.requests) == 1


def test_an_answer_without_content_is_refused(site, tmp_path):
    site.statuses = [204]
    with pytest.raises(OSError, match="expected status 200, the server answered 204"):
        fetch(site, tmp_path / "a.part")


def test_a_file_larger_than_the_disk_is_not_begun(site, tmp_path, monkeypatch):
    monkeypatch.setattr(disk_space.shutil, "disk_usage", lambda folder: SimpleNamespace(free=1000))
    with pytest.raises(OSError, match=r"needs 1,024,000 bytes, but the disk of .* has only 1,000 left"):
        fetch(site, tmp_path / "a.part")
    assert not (tmp_path / "a.part").exists()


def test_a_disk_that_fills_up_keeps_what_is_there(site, tmp_path):
    def fill(done: int, total: int | None) -> None:
        if done > 0:
            raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OSError, match=f"the disk of {tmp_path} is full; with more space the same command goes on"):
        fetch_part(site.url + PATH, tmp_path / "a.part", progress=fill)
    assert CONTENT.startswith((tmp_path / "a.part").read_bytes())
    site.requests.clear()
    fetch(site, tmp_path / "a.part")
    assert (tmp_path / "a.part").read_bytes() == CONTENT
    assert site.requests[0][1] is not None


def test_a_discarded_part_leaves_nothing(site, tmp_path):
    fetch(site, tmp_path / "a.part")
    assert json.loads((tmp_path / "a.part.json").read_text())["etag"] == '"1"'
    discard_part(tmp_path / "a.part")
    discard_part(tmp_path / "a.part")
    assert list(tmp_path.iterdir()) == []
