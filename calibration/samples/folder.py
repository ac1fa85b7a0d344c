"""The folder that a calibration leaves: complete, or as it was before."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from calibration.samples.file import FILE_NAME
from reporting.files import write_error

FIGURES = "figures"


def drawing_names(figures: Iterable[str]) -> list[str]:
    """Return the files of figures in the folder of a calibration."""
    return [f"{FIGURES}/{name}.{kind}" for name in figures for kind in ("svg", "png")]


@contextmanager
def replaced_at_once(folder: Path, companions: Iterable[str]) -> Iterator[Path]:
    """Give an empty folder beside `folder`; what stands in it at the end is moved there.

    The calibration itself comes last; an older file of the same name is replaced. If anything goes wrong
    before, the folder stays as it was.

    Parameters
    ----------
    folder : Path
        Where the files go.
    companions : iterable of str
        What may stand beside a calibration. Where an older calibration stands in the folder, those that this
        one does not write are removed, lest a page shows other figures than the file beside it.

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
            if (folder / FILE_NAME).exists():
                _remove(folder, set(map(Path, companions)) - set(files))
            for name in sorted(files, key=lambda name: (name.name == FILE_NAME, name)):
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                (fresh / name).replace(folder / name)
    except OSError as error:
        raise write_error(error, folder) from error


def _remove(folder: Path, names: Iterable[Path]) -> None:
    for name in names:
        (folder / name).unlink(missing_ok=True)
    figures = folder / FIGURES
    if figures.is_dir() and not any(figures.iterdir()):
        figures.rmdir()
