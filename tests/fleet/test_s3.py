"""Captures and results in buckets of an S3 server."""

import urllib.request

import pytest

from kronc_ns.errors import KroncError
from kronc_ns.fleet import FleetOptions, run_fleet
from kronc_ns.fleet.storage import Place
from tests.fleet.conftest import NAMES

pytestmark = pytest.mark.slow
QUICK = FleetOptions(reports="none", retries=1)


@pytest.fixture
def bucket(s3_server, made_captures):
    """A bucket with the captures, and its file system."""
    import s3fs

    s3 = s3fs.S3FileSystem(use_listings_cache=False)
    s3.mkdir("fleet")
    s3.put(f"{made_captures}/", "fleet/captures", recursive=True)
    yield s3
    s3.rm("fleet", recursive=True)


def run(captures, output, options=QUICK, **rest):
    return run_fleet(captures, output, options, ray="none", **rest)


def test_from_a_bucket_into_a_bucket(bucket, tmp_path, rows, captures, same_poses):
    summary = run("s3://fleet/captures", "s3://fleet/out")
    assert summary.is_solved
    bucket.get("fleet/out/", f"{tmp_path}/out", recursive=True)
    assert sorted(rows(tmp_path / "out")) == list(NAMES)
    assert (tmp_path / "out/fleet.html").exists()
    run_fleet(str(captures), str(tmp_path / "local"), QUICK, ray="none")
    assert all(same_poses(tmp_path / "out" / name, tmp_path / "local" / name) for name in NAMES)
    assert run("s3://fleet/captures", "s3://fleet/out", resume=True).unchanged == 4
    bucket.rm("fleet/captures/d", recursive=True)
    bucket.put(f"{captures}/a/", "fleet/captures/e", recursive=True)
    with bucket.open("fleet/captures/a/note.txt", "w") as file:
        file.write("another content")
    assert run("s3://fleet/captures", "s3://fleet/out", resume=True).unchanged == 2


def test_from_a_bucket_into_a_folder(bucket, tmp_path, rows):
    assert run("s3://fleet/captures", str(tmp_path / "out")).is_solved
    assert rows(tmp_path / "out")["a"]["path"] == "s3://fleet/captures/a"


def test_objects_that_vanish_are_an_error_of_their_capture(bucket, tmp_path, rows, monkeypatch):
    listed = Place.files

    def then_gone(place):
        found = listed(place)
        if place.url.endswith("/b"):
            bucket.rm("fleet/captures/b/keypoints.json")
            bucket.pipe("fleet/captures/b/again", b"")
        elif place.url.endswith("/c"):
            bucket.pipe("fleet/captures/c/keypoints.json", b"{}")
        return found

    monkeypatch.setattr(Place, "files", then_gone)
    assert run("s3://fleet/captures", str(tmp_path / "out")).counts == {"converged": 2, "error": 2}
    table = rows(tmp_path / "out")
    assert table["c"]["reason"].startswith("c/keypoints.json") or "changed or vanished" in table["c"]["reason"]
    assert table["b"]["status"] == "error"
    assert (table["a"]["attempts"], table["b"]["attempts"]) == (1, 2)


def test_no_such_bucket_no_rights_no_credentials(bucket, s3_server, captures, tmp_path, monkeypatch):
    with pytest.raises(KroncError, match=r"s3://nobody/captures cannot be listed: it does not exist"):
        run("s3://nobody/captures", str(tmp_path / "out"))
    with pytest.raises(KroncError, match="s3://nobody/out"):
        run(str(captures), "s3://nobody/out")
    _authorise(s3_server, 0)
    try:
        with pytest.raises(KroncError, match="access is refused"):
            run("s3://fleet/captures", str(tmp_path / "out"))
        with pytest.raises(KroncError, match="access is refused"):
            run(str(captures), "s3://fleet/elsewhere")
    finally:
        _authorise(s3_server, 1 << 30)
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name)
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", str(tmp_path / "none"))
    with pytest.raises(KroncError, match="there are no credentials"):
        run_fleet(
            "s3://fleet/captures", str(tmp_path / "out"), ray="none", storage_options={"skip_instance_cache": True}
        )
    assert not (tmp_path / "out").exists()


def test_a_bucket_that_refuses_in_the_middle_costs_the_captures_of_that_time(bucket, s3_server, tmp_path, rows):
    def refuse(state):
        if state.done == 2:
            _authorise(s3_server, 0)

    try:
        summary = run("s3://fleet/captures", str(tmp_path / "out"), progress=refuse)
    finally:
        _authorise(s3_server, 1 << 30)
    assert summary.counts["converged"] >= 2
    assert sum(summary.counts.values()) == 4
    for row in rows(tmp_path / "out").values():
        assert row["status"] == "converged" or "access is refused" in row["reason"]
    assert run("s3://fleet/captures", str(tmp_path / "out"), resume=True).is_solved


def _authorise(server: str, after: int) -> None:
    """From now on the server lets so many requests pass without asking who sends them."""
    text = {"Content-Type": "text/plain"}
    request = urllib.request.Request(f"{server}/moto-api/reset-auth", str(after).encode(), text, method="POST")
    urllib.request.urlopen(request).read()
