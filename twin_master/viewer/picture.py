"""The drawing of a missing force that a verdict leaves in its folder."""

from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from reporting.errors import DamagedFileError
from reporting.json_file import read_json
from twin_master.run_folder import PICTURE, VERDICT


class Picture(NamedTuple):
    """The missing force that a verdict shows: behind which step it came, its drawing, what it says."""

    step: int
    drawing: Path
    said: str


def picture_of(step: int, verdict: Path) -> Picture | None:
    """Return what the folder of a verdict shows of a missing force; None: nothing, or no whole verdict."""
    with suppress(DamagedFileError, KeyError, TypeError):
        if (verdict / PICTURE).is_file():
            record = read_json(verdict / VERDICT, DamagedFileError)["verdict"]
            return Picture(step, verdict / PICTURE, str(record["sentence"]))
    return None
