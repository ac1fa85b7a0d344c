"""NetCDF files of several groups, read as a whole or refused in one sentence."""

from __future__ import annotations

from pathlib import Path

import xarray as xr

from reporting.errors import DamagedFileError


def read_groups(path: Path) -> xr.DataTree:
    """Return all groups of a NetCDF-4 file, loaded into memory; times stay the numbers that are stored.

    Raises
    ------
    DamagedFileError
        The file is missing, damaged, cut off or of another kind.
    """
    if not path.is_file():
        raise DamagedFileError(f"there is no file {path}")
    try:
        with xr.open_datatree(path, engine="h5netcdf", decode_times=False) as tree:
            return tree.load()
    except Exception as error:  # HDF5 answers damage with nearly every exception that there is
        reason = str(error).strip().splitlines()[:1] or [type(error).__name__]
        raise DamagedFileError(f"{path} is damaged or no NetCDF file ({reason[0].rstrip('.')})") from error
