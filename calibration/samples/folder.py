"""The folder that a calibration leaves: complete, or as it was before."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from calibration.errors import CalibrationRecordError
from calibration.samples.file import FILE_NAME
from calibration.samples.record import SampledCalibration
from reporting.errors import FileNotWrittenError
from reporting.files import write_error


def check_folder(
    folder: Path, asset: str | None, load: Callable[[Path], SampledCalibration], one: str = "wing"
) -> None:
    """Look at the place before the work begins.

    Parameters
    ----------
    folder : Path
        Where a calibration is to be written.
    asset : str, optional
        Of what; None: of anything.
    load : callable
        Reads the calibration that is there.
    one : str
        What is calibrated, in the sentence.

    Raises
    ------
    FileNotWrittenError
        If it is no folder, or holds the calibration of another asset.
    """
    if folder.exists() and not folder.is_dir():
        raise FileNotWrittenError(f"{folder} exists and is no folder: choose another --out.")
    kept = folder / FILE_NAME
    if not kept.exists():
        return
    try:
        found = load(kept).asset
    except CalibrationRecordError:
        return  # what cannot be read is of no use to anyone
    if asset is not None and found != asset:
        raise FileNotWrittenError(
            f"{kept} is the calibration of {found}, not of {asset}: choose another --out, one for each {one}."
        )


@contextmanager
def replaced_at_once(folder: Path) -> Iterator[Path]:
    """Give an empty folder beside `folder`; what stands in it at the end is moved there.

    The calibration itself comes last; an older file of the same name is replaced. If anything goes wrong the
    folder stays as it was.

    Raises
    ------
    FileNotWrittenError
        If a file cannot be written.
    """
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent) as scratch:
            fresh = Path(scratch)
            yield fresh
            files = sorted(path.relative_to(fresh) for path in fresh.rglob("*") if path.is_file())
            for name in sorted(files, key=lambda name: (name.name == FILE_NAME, name)):
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                (fresh / name).replace(folder / name)
    except OSError as error:
        raise write_error(error, folder) from error
