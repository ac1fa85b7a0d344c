"""Where the store of a fleet is: in its folder, or at an address that fsspec knows.

Addresses are such as `s3://bucket/winter.zarr`. fsspec finds the package that knows the service,
and takes keys and tokens from where this package looks for them.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import util
from pathlib import Path

from twin_master.errors import FleetError

STORE_NAME = "fleet.zarr"
"""The folder of the store in the folder of a fleet, unless the store has an address elsewhere."""


@dataclass(frozen=True)
class StoreAddress:
    """The place of a store.

    Attributes
    ----------
    folder : Path
        The folder of the fleet.
    remote : str
        The address of the store; empty if it is in the folder.
    """

    folder: Path
    remote: str = ""

    def for_zarr(self) -> Path | str:
        """Return what zarr and xarray open."""
        return self.remote or self.folder / STORE_NAME

    def check(self) -> None:
        """Check that the address is of a kind for which a package is installed.

        Raises
        ------
        FleetError
            If fsspec or the package for the address is missing, or if no package knows it.
        """
        if not self.remote:
            return
        if util.find_spec("fsspec") is None:
            raise FleetError(
                f"a store at {self.remote} needs fsspec: pip install 'uav-twin[fleet,remote]'."
            )
        if "://" not in self.remote:
            raise FleetError(
                f"the store cannot be at {self.remote}: an address begins with the name of a "
                "service, as in s3://BUCKET/NAME.zarr; a folder of this machine is given by --out."
            )
        from fsspec.core import url_to_fs

        try:
            url_to_fs(self.remote)
        except (ImportError, ValueError, OSError) as error:
            raise FleetError(
                f"the store cannot be at {self.remote} ({error}): give an address that fsspec "
                "knows, such as s3://BUCKET/NAME.zarr, and install the package for it."
            ) from error

    def send(self, file: Path, path: str) -> None:
        """Send a complete file to the store at its address, and remove it here.

        Parameters
        ----------
        file : Path
            The file.
        path : str
            Its path in the store.

        Raises
        ------
        FleetError
            If it cannot be sent; the file is kept.
        """
        from fsspec.core import url_to_fs

        with self.explained_errors():
            file_system, root = url_to_fs(self.remote)
            file_system.put_file(str(file), f"{root}/{path}")
        file.unlink()

    @contextmanager
    def explained_errors(self) -> Iterator[None]:
        """Return a context in which an error of the service becomes one sentence.

        Raises
        ------
        FleetError
            In place of the error, if the store has an address elsewhere.
        """
        try:
            yield
        except (OSError, ImportError, ValueError) as error:
            if not self.remote:
                raise
            raise FleetError(
                f"the store at {self.remote} cannot be read or written ({error}): "
                "what was flown is kept, repeat the command to go on."
            ) from error


def address_of(config_of_fleet: dict[str, object], folder: Path) -> StoreAddress:
    """Return where the store of a fleet is, given its record in `config.json`."""
    return StoreAddress(folder, str(config_of_fleet.get("store", "")))
