"""Creating the store of a fleet, and writing flown twins into it.

The store has few, large files: an array of a group is cut along its first axis into chunks of one
shard of twins, and up to `CHUNKS_PER_FILE` successive chunks are one file. A file grows on this
machine. If the store has an address elsewhere, the file is sent there once it is complete.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from reporting.arrays import AnyArray
from reporting.files import explained_write_errors
from reporting.formats.netcdf import Variable
from twin_master.fleet.plan import Fleet, Group
from twin_master.fleet.storage.chunk_file import CHUNKS_PER_FILE, ChunkFile
from twin_master.fleet.storage.store_address import STORE_NAME, StoreAddress
from twin_master.fleet.storage.store_layout import (
    TWIN_AXIS,
    coordinates_of_groups,
    stored_layout,
    twin_coordinate,
)

if TYPE_CHECKING:
    import zarr
    from zarr.core.buffer import Buffer

_GROWING = "growing"
"""The folder, in that of the fleet, of files that are not complete if the store is elsewhere."""


class _Partition(NamedTuple):
    """How the rows of a group are divided into chunks and files.

    Attributes
    ----------
    chunk_rows : int
        The number of rows of a chunk.
    chunks_per_file : int
        The number of chunks of a file.
    """

    chunk_rows: int
    chunks_per_file: int

    @classmethod
    def of_group(cls, fleet: Fleet, group: Group) -> "_Partition":
        """Return the partition of a group of a fleet: a chunk is a shard of twins."""
        twin_count = len(group.members)
        chunk_rows = min(fleet.head.shard, twin_count)
        chunk_count = -(-twin_count // chunk_rows)  # rounded up
        return cls(chunk_rows, min(CHUNKS_PER_FILE, chunk_count))

    @property
    def file_rows(self) -> int:
        """The number of rows of a file."""
        return self.chunk_rows * self.chunks_per_file


def create_store(folder: Path, fleet: Fleet) -> None:
    """Create the arrays of a fleet's store, filled with the values of twins that have not flown.

    Raises
    ------
    FleetError
        If nothing can be written at the address of the store.
    FileNotWrittenError
        If the disk is full or the folder cannot be written.
    """
    import zarr

    address = StoreAddress(folder, fleet.store)
    with explained_write_errors(folder), address.explained_errors():
        root = zarr.open_group(address.for_zarr(), mode="a", zarr_format=3)
        for group in fleet.groups:
            _create_group(root.require_group(group.name), group, fleet)


def _create_group(zarr_group: "zarr.Group", group: Group, fleet: Fleet) -> None:
    """Create the empty arrays and the coordinates of a group of assets in the store of a fleet."""
    scenario = group.scenarios[0]
    partition = _Partition.of_group(fleet, group)
    layout = stored_layout(scenario, list(group.parameter_spreads))
    for path, variable in layout.items():
        row_shape = variable.values.shape
        zarr_group.create_array(
            path,
            shape=(len(group.members), *row_shape),
            chunks=(partition.chunk_rows, *row_shape),
            shards={"shape": (partition.file_rows, *row_shape), "index_location": "start"},
            dtype=variable.values.dtype,
            fill_value=variable.values.flat[0],
            dimension_names=(TWIN_AXIS, *variable.dims),
            attributes=dict(variable.attrs),
            overwrite=True,
        )
    coordinates = coordinates_of_groups(layout, scenario)
    for inner_group, group_coordinates in coordinates.items():
        _create_coordinates(zarr_group, inner_group, group_coordinates)
    _write_names(zarr_group, group, partition)
    zarr_group.attrs.update(
        {
            "scenario": scenario.mission.name,
            "fleet": fleet.head.name,
            "fleet_seed": fleet.head.seed,
            "factors": list(scenario.state_names),
            "controls": list(scenario.control_names),
            "step_name": scenario.mission.step_name,
            "gives_notice": scenario.notice is not None,
        }
    )


def _create_coordinates(
    zarr_group: "zarr.Group", path: str, coordinates: Mapping[str, Variable]
) -> None:
    """Write the coordinates of an inner group, or of the fleet's group for an empty path."""
    inner_group = zarr_group.require_group(path) if path else zarr_group
    for name, coordinate in coordinates.items():
        values = coordinate.values
        array = inner_group.create_array(
            name,
            shape=values.shape,
            dtype="str" if values.dtype.kind == "U" else values.dtype,
            dimension_names=coordinate.dims,
            attributes=dict(coordinate.attrs),
            overwrite=True,
        )
        array[:] = values
    # By the CF conventions this attribute names the coordinates that are not dimensions.
    beside_dimensions = [name for name, entry in coordinates.items() if entry.dims != (name,)]
    if beside_dimensions:
        inner_group.attrs["coordinates"] = " ".join(beside_dimensions)


def _write_names(zarr_group: "zarr.Group", group: Group, partition: _Partition) -> None:
    """Write the names of the twins of a group, the rows of one file (shard) at a time.

    Subgroups inherit this coordinate.
    """
    twin_count = len(group.members)
    coordinate_attributes = dict(twin_coordinate([]).attrs)
    array = zarr_group.create_array(
        TWIN_AXIS,
        shape=(twin_count,),
        chunks=(partition.chunk_rows,),
        shards=(partition.file_rows,),
        dtype="str",
        dimension_names=(TWIN_AXIS,),
        attributes=coordinate_attributes,
        overwrite=True,
    )
    for first_row in range(0, twin_count, partition.file_rows):
        end = min(first_row + partition.file_rows, twin_count)
        names = [group.members.name(row) for row in range(first_row, end)]
        array[first_row:end] = np.array(names, dtype=np.dtypes.StringDType())


class _ChunkCodec:
    """Encodes and decodes the chunks of an array of the store.

    zarr itself does so, by an array in memory that has one chunk.

    Parameters
    ----------
    array : zarr.Array
        The array of the store.
    """

    def __init__(self, array: "zarr.Array[object]") -> None:
        import zarr
        from zarr.storage import MemoryStore

        self._content: dict[str, Buffer] = {}
        self._chunk = zarr.create_array(
            MemoryStore(self._content),
            shape=array.chunks,
            chunks=array.chunks,
            dtype=array.dtype,
            compressors=array.compressors,
            fill_value=array.fill_value,
        )
        self._key = chunk_key(0, len(array.chunks))

    def encode(self, values: AnyArray) -> bytes | None:
        """Return the encoded values of a chunk; None if all are those of twins not flown."""
        self._chunk[...] = values
        buffer = self._content.get(self._key)
        return None if buffer is None else buffer.to_bytes()

    def decode(self, content: bytes | None) -> AnyArray:
        """Return the values of a chunk, given its encoded content."""
        from zarr.core.buffer import default_buffer_prototype

        self._content.pop(self._key, None)
        if content is not None:
            self._content[self._key] = default_buffer_prototype().buffer.from_bytes(content)
        return np.asarray(self._chunk[...])


def chunk_key(number: int, axis_count: int) -> str:
    """Return the path, in an array, of a file that has all values of the axes but the first.

    Parameters
    ----------
    number : int
        The number of the file along the first axis.
    axis_count : int
        The number of axes.
    """
    return "/".join(["c", str(number), *["0"] * (axis_count - 1)])


class GroupWriter:
    """Writes flown twins to the arrays of a group of assets."""

    def __init__(self, address: StoreAddress, fleet: Fleet, group: Group) -> None:
        import zarr

        self._address = address
        self._group = group
        self._partition = _Partition.of_group(fleet, group)
        with address.explained_errors():
            stored_group = zarr.open_group(
                address.for_zarr(), mode="r", path=group.name, use_consolidated=False
            )
            paths = stored_layout(group.scenarios[0], list(group.parameter_spreads))
            self._axis_counts = {path: stored_group[path].ndim for path in paths}
            self._codecs = {path: _ChunkCodec(stored_group[path]) for path in paths}

    @property
    def file_rows(self) -> Iterator[range]:
        """The rows of each file of the group, file by file."""
        twin_count = len(self._group.members)
        for first_row in range(0, twin_count, self._partition.file_rows):
            yield range(first_row, min(first_row + self._partition.file_rows, twin_count))

    def write(self, variables: Mapping[str, AnyArray], first_row: int) -> None:
        """Write some variables of twins in successive rows, a (B, ...) array for each path.

        Raises
        ------
        FleetError
            If a file of the store is damaged.
        OSError
            If a file cannot be written.
        """
        for path, values in variables.items():
            row = first_row
            while row < first_row + len(values):
                chunk_end = (row // self._partition.chunk_rows + 1) * self._partition.chunk_rows
                end = min(chunk_end, first_row + len(values))
                self._write_chunk(path, row, values[row - first_row : end - first_row])
                row = end

    def _write_chunk(self, path: str, first_row: int, values: AnyArray) -> None:
        """Write values of successive rows that lie in one chunk."""
        chunk_number, first_in_chunk = divmod(first_row, self._partition.chunk_rows)
        file_number, number_in_file = divmod(chunk_number, self._partition.chunks_per_file)
        file = self._file(path, file_number)
        codec = self._codecs[path]
        end_in_chunk = first_in_chunk + len(values)
        is_whole_chunk = len(values) == self._partition.chunk_rows
        if is_whole_chunk:
            chunk = values
        else:
            chunk = codec.decode(file.read(number_in_file))
            chunk[first_in_chunk:end_in_chunk] = values
        file.write(number_in_file, codec.encode(chunk))

    def finish_file(self, number: int) -> None:
        """Finish the files of all variables with a number, after all their twins have flown.

        They are put in order and, if the store is elsewhere, sent there. Files that were finished
        before stay as they are.

        Raises
        ------
        FleetError
            If a file is damaged, or cannot be sent to the store.
        FileNotWrittenError
            If the disk is full or the folder cannot be written.
        """
        for path in self._codecs:
            file = self._file(path, number)
            file.finish()
            if self._address.remote and file.path.is_file():
                self._address.send(file.path, self._path_in_store(path, number))

    def _file(self, path: str, file_number: int) -> ChunkFile:
        """Return the file with a number of the variable at a path."""
        folder = self._address.folder / (_GROWING if self._address.remote else STORE_NAME)
        file = folder / self._path_in_store(path, file_number)
        return ChunkFile(file, self._partition.chunks_per_file)

    def _path_in_store(self, path: str, file_number: int) -> str:
        """Return the path, in the store, of the file with a number of the variable at a path."""
        return f"{self._group.name}/{path}/{chunk_key(file_number, self._axis_counts[path])}"
