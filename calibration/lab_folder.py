"""The layout of a laboratory's folder, which is that of the paper's authors."""

from collections.abc import Iterator
from pathlib import Path

from reporting.formats.table_file import TableErrors, TextTable, read_table

from .errors import ExperimentDataError, ExperimentFileError

LAB_ERRORS = TableErrors(layout=ExperimentFileError, value=ExperimentDataError)
"""The exceptions of the reader of a laboratory's tables."""

# The folders of the steps in the authors' repository, relative to the folder that a user may give
_FOLDERS_OF_STEPS = (Path(), Path("datafiles"), Path("src") / "datafiles")


def possible_locations(folder: Path, name: Path) -> Iterator[Path]:
    """Yield the possible locations of a file or folder below a user's folder.

    `name` is the path in the authors' layout, such as `step1/geometry_data.csv`.
    """
    for folder_of_steps in _FOLDERS_OF_STEPS:
        yield folder / folder_of_steps / name


def find_in_lab_folder(folder: Path, name: Path) -> Path | None:
    """Return the location of a file or folder below a user's folder, or None if it is missing."""
    for location in possible_locations(folder, name):
        if location.exists():
            return location
    return None


def lab_table(path: Path | str, name: Path) -> TextTable:
    """Read a table of a laboratory.

    Parameters
    ----------
    path : Path or str
        The file of the table, the laboratory's folder, or the folder of the step.
    name : Path
        The file of the table in the authors' layout.

    Raises
    ------
    ExperimentFileError
        If there is no such file, or it is not a table.
    """
    path = Path(path)
    if not path.exists():
        raise ExperimentFileError(f"{path} does not exist; give the folder that holds {name}.")
    if path.is_file():
        return read_table(path, LAB_ERRORS)
    for location in (*possible_locations(path, name), path / name.name):
        if location.is_file():
            return read_table(location, LAB_ERRORS)
    raise ExperimentFileError(f"{path} does not hold {name}; give the authors' calibration folder.")
