"""The extracted FMU: once for an asset and all that were made from it, removed with the last of them."""

from pathlib import Path

from fmu_asset.folders import remove_folder

from .declared import FmuDescription
from .fmu_file import extract_fmu


class Extraction:
    """An extracted FMU with the number of its users.

    Attributes
    ----------
    folder : Path
        Where it is.

    Raises
    ------
    FmuFileError
        If it cannot be extracted.
    """

    def __init__(self, description: FmuDescription) -> None:
        self.folder: Path = extract_fmu(description)
        self._users = 0

    def hold(self) -> None:
        """Be one user more."""
        self._users += 1

    def release(self) -> None:
        """Be one user less; the last one removes the folder."""
        self._users -= 1
        if self._users <= 0:
            remove_folder(self.folder)

    @property
    def usable(self) -> bool:
        """Whether the folder is still there."""
        return self._users > 0 and self.folder.is_dir()
