"""What the files of calibrations share: NetCDF-4 with a schema, labelled samples, a hash of the content."""

import hashlib
import json
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from calibration.errors import CalibrationRecordError
from calibration.samples.record import CalibratedFigure
from reporting.errors import DamagedFileError
from reporting.netcdf import read_groups

FILE_NAME = "calibration.nc"
SAMPLE, PRIOR_SAMPLE = "sample", "prior_sample"
_HASH = "content_sha256"

Groups = Mapping[str, xr.Dataset]
Root = Mapping[str, Any]


def file_bytes(groups: Groups, root: Mapping[str, Any]) -> bytes:
    """Return the content of a file of groups and root attributes, with its hash; equal input, equal bytes."""
    attributes = {**root, _HASH: content_hash(groups, root)}
    tree = xr.DataTree.from_dict({"/": xr.Dataset(attrs=attributes), **groups})
    return bytes(tree.to_netcdf(engine="h5netcdf"))


def read_file(path: Path) -> tuple[dict[str, xr.Dataset], dict[str, Any]]:
    """Return groups and root attributes of a calibration file.

    Raises
    ------
    CalibrationRecordError
        If the file is missing, or cannot be read as NetCDF; one sentence.
    """
    if not path.is_file():
        raise CalibrationRecordError(
            f"{path} is {'no file' if path.exists() else 'not there'}; give the {FILE_NAME} that "
            "`uav-twin calibrate --out DIR` leaves."
        )
    try:
        tree = _tree(path, hashlib.sha256(path.read_bytes()).digest())
    except DamagedFileError as error:
        raise CalibrationRecordError(
            f"{path} is damaged or no calibration file: it cannot be read as NetCDF; calibrate again."
        ) from error
    groups = {name: tree[name].to_dataset() for name in tree.children}
    return groups, {str(name): value for name, value in tree.attrs.items()}


@lru_cache(maxsize=8)
def _tree(path: Path, content: bytes) -> xr.DataTree:
    """Read a file of a content (its hash) once: a run asks for the same calibration some twenty times."""
    return read_groups(path)


def check_schema(path: Path, root: Root, *schemas: str) -> None:
    """Refuse a file of another schema; raises `CalibrationRecordError`."""
    came = root.get("schema")
    if came not in schemas:
        raise CalibrationRecordError(
            f"{path} is {'of the schema ' + repr(str(came)) if came else 'no calibration file'}, but "
            f"{' or '.join(repr(schema) for schema in schemas)} is needed; calibrate again with this version."
        )


def check_content(groups: Groups, root: Root) -> None:
    """Refuse content that does not match its hash.

    Raises
    ------
    CalibrationRecordError, KeyError
        If it does not, or there is no hash.
    """
    if root[_HASH] != content_hash(groups, root):
        raise CalibrationRecordError("its content does not match its hash")


def json_text(content: object) -> str:
    """Return plain data as JSON, the same text for the same data."""
    return json.dumps(content, sort_keys=True, ensure_ascii=False)


def content_hash(groups: Groups, root: Root) -> str:
    """Return a hash of all values and attributes, so that a flipped bit does not pass as a calibration."""
    digest = hashlib.sha256()
    for name in sorted(set(root) - {_HASH}):
        digest.update(f"{name}\0{root[name]}\0".encode())
    for group in sorted(groups):
        dataset = groups[group]
        for name in sorted(str(name) for name in dataset.variables):
            values = dataset.variables[name].values
            kind = "f" if values.dtype.kind == "f" else "i" if values.dtype.kind in "iu" else "s"
            digest.update(f"{group}/{name}\0{values.shape}\0{kind}\0".encode())
            if kind == "s":
                digest.update("\0".join(str(value) for value in values.ravel()).encode())
            else:
                digest.update(np.ascontiguousarray(values, "<f8" if kind == "f" else "<i8").tobytes())
            attributes = dataset[name].attrs
            digest.update(json_text({key: str(attributes[key]) for key in attributes}).encode())
    return digest.hexdigest()


def variable(
    dimension: str, values: object, unit: str, title: str
) -> tuple[str, NDArray[Any], dict[str, str]]:
    """Return a variable of one dimension with unit and meaning."""
    return dimension, np.asarray(values), {"units": unit, "long_name": title}


def samples_dataset(
    figures: tuple[CalibratedFigure, ...],
    values: NDArray[np.float64],
    dimension: str,
    before: str,
    prefix: str = "",
) -> xr.Dataset:
    """Return samples (N, F) as one variable for each figure."""
    return xr.Dataset(
        {
            prefix + figure.name: variable(dimension, values[:, index], figure.unit, before + figure.title)
            for index, figure in enumerate(figures)
        }
    )


def samples_of(
    dataset: xr.Dataset, figures: tuple[CalibratedFigure, ...], prefix: str = ""
) -> NDArray[np.float64]:
    """Return the samples (N, F) that `samples_dataset` wrote."""
    return np.column_stack([dataset[prefix + figure.name].values for figure in figures])
