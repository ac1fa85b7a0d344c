"""Files of a fleet's store: many chunks in each, valid while they grow, equal to those of zarr at the end."""

from pathlib import Path
from typing import Any

import fsspec
import numpy as np
import pytest
import xarray as xr
import zarr

from reporting.files import TEMPORARY_SUFFIX
from tests.twin_master.runs import written
from twin_master.assets.resolution import Overrides
from twin_master.errors import FleetError
from twin_master.fleet.comparison import group_statistics
from twin_master.fleet.engine import Engine
from twin_master.fleet.flight import fly_fleet
from twin_master.fleet.learning.learn import learn_fleet
from twin_master.fleet.members import ListedMembers, RecordedMembers
from twin_master.fleet.page.report import write_fleet_report
from twin_master.fleet.plan import Fleet, Group, ensemble, load_fleet
from twin_master.fleet.reading import open_groups
from twin_master.fleet.storage.chunk_file import ChunkFile
from twin_master.fleet.storage.store_writing import CHUNKS_PER_FILE, _ChunkCodec
from twin_master.mission.journal import JournalFile
from uav_twin import open_fleet

CHUNKS = 5
ROWS = 4
"""Rows of a chunk."""


class GrowingFile:
    """An array of zarr in chunks of four rows and one file, and the file that this program writes."""

    def __init__(self, folder: Path) -> None:
        self.values = np.random.default_rng(3).standard_normal((CHUNKS * ROWS, 3)).astype("f4")
        self.by_zarr = self._array(folder / "by_zarr")
        self.array = self._array(folder / "appended")
        self.path = folder / "appended" / "c" / "0" / "0"
        self.file = ChunkFile(self.path, CHUNKS)
        self.codec = _ChunkCodec(self.array)

    def _array(self, folder: Path) -> Any:
        return zarr.create_array(
            folder,
            shape=(CHUNKS * ROWS, 3),
            chunks=(ROWS, 3),
            shards={"shape": (CHUNKS * ROWS, 3), "index_location": "start"},
            dtype="f4",
            fill_value=np.nan,
        )

    def append(self, number: int) -> None:
        """Append a chunk with its rows of the values."""
        self.file.write(number, self.codec.encode(self.values[number * ROWS : (number + 1) * ROWS]))

    def bytes_by_zarr(self, values: np.ndarray) -> bytes:
        """Return the file that zarr writes of the values as a whole."""
        self.by_zarr[:] = values
        return (self.path.parents[3] / "by_zarr" / "c" / "0" / "0").read_bytes()


@pytest.fixture
def growing_file(tmp_path: Path) -> GrowingFile:
    return GrowingFile(tmp_path)


def test_a_file_that_grows_is_read_by_zarr_after_each_chunk(growing_file):
    expected = np.full_like(growing_file.values, np.nan)
    for number in (3, 0, 4):
        growing_file.append(number)
        rows = slice(number * ROWS, (number + 1) * ROWS)
        expected[rows] = growing_file.values[rows]
        np.testing.assert_array_equal(growing_file.array[:], expected)


@pytest.mark.parametrize("order", [(0, 1, 2, 3, 4), (4, 1, 1, 3, 0, 2, 1)])
def test_a_finished_file_is_that_of_zarr_whatever_the_order(growing_file, order):
    for number in order:
        growing_file.append(number)
    growing_file.file.finish()
    assert growing_file.path.read_bytes() == growing_file.bytes_by_zarr(growing_file.values)


def test_a_finished_file_without_some_chunks_is_that_of_zarr(growing_file):
    growing_file.append(4)
    growing_file.append(1)
    growing_file.file.write(1, None)
    growing_file.file.finish()
    values = np.full_like(growing_file.values, np.nan)
    values[4 * ROWS :] = growing_file.values[4 * ROWS :]
    assert growing_file.path.read_bytes() == growing_file.bytes_by_zarr(values)


def test_a_file_without_chunks_is_removed(growing_file):
    growing_file.append(2)
    growing_file.file.write(2, growing_file.codec.encode(np.full((ROWS, 3), np.nan, "f4")))
    growing_file.file.finish()
    assert not growing_file.path.exists()
    assert np.isnan(growing_file.array[:]).all()


def test_a_finished_file_stays_as_it_is(growing_file):
    growing_file.append(0)
    growing_file.file.finish()
    first = growing_file.path.stat()
    growing_file.file.finish()
    assert growing_file.path.stat().st_mtime_ns == first.st_mtime_ns


def test_what_a_killed_process_left_beside_a_file_is_removed(growing_file):
    growing_file.append(0)
    leftover = growing_file.path.with_name(f".0.17-1{TEMPORARY_SUFFIX}")
    leftover.write_bytes(b"half of a file")
    growing_file.file.finish()
    assert [path.name for path in growing_file.path.parent.iterdir()] == ["0"]


def test_a_chunk_is_read_as_it_was_written(growing_file):
    growing_file.append(3)
    chunk = growing_file.codec.decode(growing_file.file.read(3))
    np.testing.assert_array_equal(chunk, growing_file.values[3 * ROWS : 4 * ROWS])
    assert growing_file.file.read(2) is None


def test_a_file_with_a_damaged_index_is_named(growing_file):
    growing_file.append(3)
    content = bytearray(growing_file.path.read_bytes())
    content[5] ^= 1
    growing_file.path.write_bytes(content)
    with pytest.raises(FleetError, match=r"the index of .*c/0/0 is damaged: fly the fleet again"):
        growing_file.append(1)


def growing(library_file: Path, count: int = 10, shard: int = 4) -> Fleet:
    return ensemble("growing_damage", range(count), Overrides(strain_library=library_file), shard=shard)


def files_with_values(store: Path) -> list[Path]:
    """Return the files of a store that hold values, and not descriptions of arrays."""
    return [path for path in store.rglob("*") if path.is_file() and path.name != "zarr.json"]


@pytest.fixture(scope="module")
def whole(library_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a fleet of ten twins in chunks of two."""
    folder = tmp_path_factory.mktemp("whole") / "fleet"
    return fly_fleet(growing(library_file, shard=2), folder).folder


def test_a_variable_of_a_fleet_is_one_file_for_many_chunks(whole):
    group = open_fleet(whole)["growing_damage"]
    variables = list(zarr.open_group(whole / "fleet.zarr/growing_damage").members(None))
    arrays = [name for name, member in variables if isinstance(member, zarr.Array)]
    assert group["filtered/mean"].encoding["chunks"][0] == 2
    assert group["filtered/mean"].encoding["shards"][0] == 10
    assert len(files_with_values(whole / "fleet.zarr")) <= len(arrays)


def test_a_file_has_a_limited_number_of_chunks(library_file, tmp_path, monkeypatch):
    monkeypatch.setattr("twin_master.fleet.storage.store_writing.CHUNKS_PER_FILE", 2)
    assert CHUNKS_PER_FILE == 128
    folder = fly_fleet(growing(library_file, shard=2), tmp_path / "fleet").folder
    means = sorted((folder / "fleet.zarr/growing_damage/filtered/mean/c").iterdir())
    assert [path.name for path in means] == ["0", "1", "2"]


def test_the_names_of_twins_are_in_the_store_once(whole):
    group = open_fleet(whole)["growing_damage"]
    assert len([*(whole / "fleet.zarr").glob("**/twin")]) == 1
    assert group["filtered/mean"].coords["twin"].values.tolist() == [f"seed-{row}" for row in range(10)]


def test_the_configuration_does_not_grow_with_the_fleet(library_file):
    sizes = {len(str(growing(library_file, count=count).record())) for count in (10, 90)}
    million = str(growing(library_file, count=1_000_000).record())
    assert len(sizes) == 1
    assert len(million) < max(sizes) + 10


def members_of(kind: str, library_file: Path, folder: Path) -> Group:
    """Return a group whose assets have seeds of a range, or of their rows."""
    if kind == "seeds":
        return growing(library_file, count=3).groups[0]
    text = 'format = 1\nfleet = { name = "few", seed = 5 }\n[[group]]\nname = "north"\ncount = 3\n'
    return load_fleet(written(folder, text + 'scenario = "growing_damage"\n')).groups[0]


@pytest.mark.parametrize("kind", ["seeds", "count"])
def test_names_of_assets_follow_from_the_configuration(kind, library_file, tmp_path):
    """Also from that of an earlier version, which lists them."""
    group = members_of(kind, library_file, tmp_path)
    record = group.record()
    listed = {**record, "members": ListedMembers(group.members[:]).record()}
    for content in (record, listed):
        members = RecordedMembers(content)
        assert [members.name(row) for row in range(len(members))] == [one.name for one in group.members]
        assert members.scenario_numbers(np.arange(3)).tolist() == [0, 0, 0]


REMOTE = "memory://bucket/fleet.zarr"


@pytest.fixture
def bucket() -> Any:
    """An empty file system in memory, which fsspec knows by the address `memory://`."""
    file_system = fsspec.filesystem("memory")
    yield file_system
    if file_system.exists("/bucket"):
        file_system.rm("/bucket", recursive=True)


@pytest.fixture
def far(library_file: Path, tmp_path: Path, bucket: Any) -> Path:
    """The folder of the same fleet, whose store is elsewhere."""
    return fly_fleet(growing(library_file, shard=2), tmp_path / "far", store=REMOTE).folder


def test_a_store_elsewhere_has_what_a_store_in_the_folder_has(far, whole):
    xr.testing.assert_identical(open_fleet(far), open_fleet(whole))
    assert not (far / "fleet.zarr").exists()
    assert [path for path in (far / "growing").rglob("*") if path.is_file()] == []


def test_files_of_a_store_elsewhere_are_those_of_a_store_in_the_folder(far, whole, bucket):
    for path in files_with_values(whole / "fleet.zarr"):
        relative_path = path.relative_to(whole / "fleet.zarr").as_posix()
        assert bucket.cat_file(f"/bucket/fleet.zarr/{relative_path}") == path.read_bytes(), relative_path


def test_report_figures_and_lessons_are_made_of_a_store_elsewhere(far, whole):
    figures, expected = (group_statistics(open_groups(folder)["growing_damage"]) for folder in (far, whole))
    lessons, expected_lessons = (learn_fleet(folder)["groups"] for folder in (far, whole))
    assert figures == expected
    assert lessons == expected_lessons
    assert "10 of 10 assets have flown" in write_fleet_report(far).read_text()


def test_a_fleet_with_a_store_elsewhere_goes_on_after_a_kill(
    library_file, tmp_path, bucket, whole, monkeypatch
):
    append = JournalFile.append

    def dying(self: JournalFile, record: Any, parts: Any = None) -> None:
        if record.get("rows") == [4, 6]:
            raise KeyboardInterrupt
        append(self, record, parts)

    fleet = growing(library_file, shard=2)
    with monkeypatch.context() as patch:
        patch.setattr(JournalFile, "append", dying)
        with pytest.raises(KeyboardInterrupt):
            fly_fleet(fleet, tmp_path / "cut", store=REMOTE)
    outcome = fly_fleet(fleet, tmp_path / "cut", Engine(0), store=REMOTE)
    assert (outcome.shards_kept, outcome.shards_flown) == (2, 3)
    xr.testing.assert_identical(open_fleet(outcome.folder), open_fleet(whole))


@pytest.mark.parametrize(
    ("address", "sentence"),
    [
        ("nowhere://bucket/x.zarr", "the store cannot be at nowhere://bucket/x.zarr .*Protocol not known"),
        ("runs/fleet.zarr", "the store cannot be at runs/fleet.zarr: an address begins with"),
    ],
)
def test_an_address_that_nothing_knows_is_refused_before_the_first_flight(
    library_file, tmp_path, address, sentence
):
    with pytest.raises(FleetError, match=sentence):
        fly_fleet(growing(library_file, count=2), tmp_path / "fleet", store=address)
    assert not (tmp_path / "fleet").exists()
