"""The drawing of a missing force that a verdict leaves in its folder."""

from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from reporting.errors import DamagedFileError
from reporting.json_file import read_json
from twin_master.run_folder import PICTURE, VERDICT


class ForceDrawing(NamedTuple):
    """The drawing of the missing force that a verdict has found.

    Attributes
    ----------
    step : int
        The step after which the verdict came.
    path : Path
        The file of the drawing, SVG.
    sentence : str
        The sentence of the verdict.
    """

    step: int
    path: Path
    sentence: str


def find_force_drawing(step: int, verdict_folder: Path) -> ForceDrawing | None:
    """Return the drawing of a missing force in the folder of a verdict.

    Parameters
    ----------
    step : int
        The step after which the verdict came.
    verdict_folder : Path
        The folder of the verdict.

    Returns
    -------
    ForceDrawing or None
        None if the folder has no drawing, or no verdict that can be read.
    """
    drawing = verdict_folder / PICTURE
    if not drawing.is_file():
        return None
    with suppress(DamagedFileError, KeyError, TypeError):
        verdict = read_json(verdict_folder / VERDICT, DamagedFileError)["verdict"]
        return ForceDrawing(step, drawing, str(verdict["sentence"]))
    return None
