"""The layout of a laboratory's folder, which is that of the paper's authors."""

from collections.abc import Iterator
from pathlib import Path

from reporting.table_file import TableErrors, TextTable, read_table

from .errors import ExperimentDataError, ExperimentFileError

LAB_ERRORS = TableErrors(layout=ExperimentFileError, value=ExperimentDataError)
"""What the reader of a laboratory's table raises."""

# Where the folders of the steps lie in the authors' repository, seen from what a user may call its folder.
_FOLDERS_OF_STEPS = (Path(), Path("datafiles"), Path("src") / "datafiles")


def places_of(folder: Path, name: Path) -> Iterator[Path]:
    """Yield where a file or folder such as `step1/geometry_data.csv` may lie, seen from a user's folder."""
    for above in _FOLDERS_OF_STEPS:
        yield folder / above / name


def lab_place(folder: Path, name: Path) -> Path | None:
    """Return where a file or folder lies in a user's folder, None where it does not."""
    return next((place for place in places_of(folder, name) if place.exists()), None)


def lab_table(path: Path | str, name: Path) -> TextTable:
    """Return the table of a file, or of the file `name` in the laboratory's (or its step's) folder `path`.

    Raises
    ------
    ExperimentFileError
        If there is neither, or it is no table.
    """
    path = Path(path)
    if not path.exists():
        raise ExperimentFileError(f"{path} does not exist; give the folder that holds {name}.")
    places = (path,) if path.is_file() else (*places_of(path, name), path / name.name)
    file = next((place for place in places if place.is_file()), None)
    if file is None:
        raise ExperimentFileError(f"{path} does not hold {name}; give the authors' calibration folder.")
    return read_table(file, LAB_ERRORS)
