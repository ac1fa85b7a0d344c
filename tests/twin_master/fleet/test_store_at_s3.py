"""Stores of fleets in a bucket: the protocol of S3, spoken by a server of this machine that moto runs."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.request import Request, urlopen

import pytest
import xarray as xr

from tests.command_line import command, refused, said
from tests.twin_master.fleet.recordings import write_fleet
from tests.twin_master.runs import written
from twin_master.mission.journal import JournalFile
from uav_twin import open_fleet

pytest.importorskip("s3fs", reason="s3fs is not installed: pip install 'fsspec[s3]'")
pytest.importorskip("moto", reason="moto is not installed: pip install 'moto[s3,server]'")

import s3fs
from moto.server import ThreadedMotoServer

pytestmark = [
    pytest.mark.xdist_group("s3"),
    pytest.mark.filterwarnings("default"),  # those of moto, boto and s3fs are not ours
]
FLEET = """format = 1
fleet = { name = "few", seed = 5, shard = 1 }
[[group]]
name = "north"
count = 3
scenario = "wing.toml"
"""


class Bucket:
    """A server with a bucket, which can be stopped and goes on with the same content."""

    def __init__(self) -> None:
        self.port = 0
        self.start()

    @property
    def address(self) -> str:
        """The address of the server."""
        return f"http://127.0.0.1:{self.port}"

    def stop(self) -> None:
        self._server.stop()

    def start(self) -> None:
        self._server = ThreadedMotoServer("127.0.0.1", self.port, verbose=False)
        self._server.start()
        self.port = self._server.get_host_and_port()[1]


@pytest.fixture(scope="module")
def server() -> Iterator[Bucket]:
    """The server; s3fs keeps its connections to it, and finds address and keys in variables."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AWS_ACCESS_KEY_ID", "testing")
        patch.setenv("AWS_SECRET_ACCESS_KEY", "testing")
        patch.setenv("AWS_SHARED_CREDENTIALS_FILE", "/nonexistent")
        patch.setenv("AWS_EC2_METADATA_DISABLED", "true")
        patch.setenv("AWS_MAX_ATTEMPTS", "1")
        server = Bucket()
        patch.setenv("AWS_ENDPOINT_URL", server.address)
        yield server
        server.stop()


@pytest.fixture
def bucket(server: Bucket) -> Bucket:
    """The server with an empty bucket."""
    urlopen(Request(f"{server.address}/moto-api/reset", method="POST")).close()
    urlopen(Request(f"{server.address}/bucket", method="PUT")).close()
    s3fs.S3FileSystem().invalidate_cache()
    return server


@pytest.fixture
def fleet_file(library_file: Path, tmp_path: Path) -> Path:
    """The file of a fleet of three wings, whose strains a library has."""
    write_fleet(library_file, tmp_path)
    return written(tmp_path, FLEET, name="fleet.toml")


def words_of(fleet_file: Path, name: str, store: str = "s3://bucket/few.zarr") -> tuple[object, ...]:
    """Return the words of `uav-twin` that fly the fleet into a folder beside its file."""
    out = fleet_file.with_name(name)
    words = ("fleet", "run", fleet_file, "--out", out, "--workers", 0, "--no-report")
    return (*words, "--store", store) if store else words


@pytest.fixture
def far(fleet_file: Path, bucket: Bucket) -> Path:
    """The folder of the fleet with a store in the bucket."""
    said(*words_of(fleet_file, "far"))
    return fleet_file.with_name("far")


@pytest.fixture
def near(fleet_file: Path) -> Path:
    """The folder of the same fleet with its store in it."""
    said(*words_of(fleet_file, "near", store=""))
    return fleet_file.with_name("near")


def test_a_store_in_a_bucket_has_what_a_store_in_the_folder_has(far, near):
    xr.testing.assert_identical(open_fleet(far), open_fleet(near))
    assert not (far / "fleet.zarr").exists()


def test_a_store_in_a_bucket_is_learnt_from_and_compared(far, near, tmp_path):
    for folder in (far, near):
        said("fleet", "learn", folder, "--out", tmp_path / f"{folder.name}.toml", "--no-report")
    learnt = [
        [line for line in (tmp_path / name).read_text().splitlines() if not line.startswith("config")]
        for name in ("far.toml", "near.toml")
    ]
    assert learnt[0] == learnt[1]
    assert command("compare", far, near).returncode == 0


def test_a_server_that_goes_away_in_the_middle_loses_nothing(fleet_file, bucket, near, monkeypatch):
    append, words = JournalFile.append, words_of(fleet_file, "cut")

    def stopping(self: JournalFile, record: Any, parts: Any = None) -> None:
        append(self, record, parts)
        if record.get("rows") == [1, 2]:
            bucket.stop()

    with monkeypatch.context() as patch:
        patch.setattr(JournalFile, "append", stopping)
        sentence = refused(*words)
    assert "the store at s3://bucket/few.zarr cannot be read or written" in sentence
    bucket.start()
    said(*words)
    xr.testing.assert_identical(open_fleet(fleet_file.with_name("cut")), open_fleet(near))


def test_a_server_that_is_away_is_told_where_a_store_is_read(far, bucket):
    bucket.stop()
    for words in (("compare", far, far), ("fleet", "learn", far, "--no-report")):
        assert "the store at s3://bucket/few.zarr cannot be read or written" in refused(*words)
    bucket.start()


@pytest.mark.parametrize(
    ("variable", "value", "reason"),
    [
        ("AWS_ENDPOINT_URL", "http://127.0.0.1:9", "Could not connect"),
        ("AWS_ACCESS_KEY_ID", "", "Unable to locate credentials"),
    ],
)
def test_a_service_that_cannot_be_used_is_refused_before_a_folder_is_made(
    fleet_file, bucket, variable, value, reason
):
    """Without its server, and without a key."""
    words = [sys.executable, "-m", "uav_twin", *map(str, words_of(fleet_file, "none"))]
    variables = {**os.environ, variable: value}
    if not value:
        del variables[variable], variables["AWS_SECRET_ACCESS_KEY"]
    done = subprocess.run(words, env=variables, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert f"the store cannot be at s3://bucket/few.zarr ({reason}" in done.stderr
    assert not fleet_file.with_name("none").exists()


@pytest.mark.parametrize(
    ("store", "sentence"),
    [
        ("s3://nobucket/few.zarr", "The specified bucket does not exist"),
        ("s3://", "the name of the store is missing"),
    ],
)
def test_a_wrong_bucket_is_refused_before_a_folder_is_made(fleet_file, bucket, store, sentence):
    assert sentence in refused(*words_of(fleet_file, "none", store))
    assert not fleet_file.with_name("none").exists()


def test_the_store_of_another_fleet_is_left_alone(far, fleet_file, near):
    sentence = refused(*words_of(fleet_file, "other"))
    assert "there is a store at s3://bucket/few.zarr already" in sentence
    xr.testing.assert_identical(open_fleet(far), open_fleet(near))


def test_a_store_is_replaced_where_this_is_asked_for(far, fleet_file, near):
    said(*words_of(fleet_file, "other"), "--replace")
    xr.testing.assert_identical(open_fleet(fleet_file.with_name("other")), open_fleet(near))
