"""The location of a fleet's store: in its folder, or at an address that fsspec supports."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import util
from pathlib import Path
from typing import TYPE_CHECKING

from reporting.errors import ReportingError
from reporting.words import one_line
from twin_master.errors import FleetError, TwinMasterError

if TYPE_CHECKING:
    from twin_master.fleet.storage.remote_store import RemoteStore

STORE_NAME = "fleet.zarr"
"""The folder of the store in the folder of a fleet, unless the store has an address elsewhere."""


@dataclass(frozen=True)
class StoreAddress:
    """The location of a store.

    Attributes
    ----------
    folder : Path
        The folder of the fleet.
    remote : str
        The address of the store; empty if it is in the folder.
    """

    folder: Path
    remote: str = ""

    def for_zarr(self) -> "Path | RemoteStore":
        """Return the argument with which zarr and xarray open the store."""
        if not self.remote:
            return self.folder / STORE_NAME
        from zarr.storage import FsspecStore

        from twin_master.fleet.storage.remote_store import RemoteStore

        return RemoteStore(FsspecStore.from_url(self.remote), self.explained_errors)

    def check(self) -> None:
        """Check that the address has the right form, and that the packages for it are installed.

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
            _, path = url_to_fs(self.remote)
        except Exception as error:
            raise FleetError(
                f"the store cannot be at {self.remote} ({one_line(error)}): give an address that "
                "fsspec knows, such as s3://BUCKET/NAME.zarr, and install the package for it."
            ) from error
        if not path.strip("/"):
            raise FleetError(
                f"the store cannot be at {self.remote}: the name of the store is missing, as in "
                "s3://BUCKET/NAME.zarr."
            )

    def check_new(self, *, replace_old: bool) -> None:
        """Check that a new store can be written at the address, before anything is written here.

        Parameters
        ----------
        replace_old : bool
            Whether a store that is at the address may be replaced.

        Raises
        ------
        FleetError
            If the service does not answer or refuses to write, or if a store is there already.
        """
        if not self.remote:
            return
        import zarr

        try:
            root = zarr.open_group(self.for_zarr(), mode="a", zarr_format=3)
            is_occupied = any(True for _ in root.members())
        except _ServiceError as error:
            raise FleetError(
                f"the store cannot be at {self.remote} ({error.reason}): correct the address, or "
                "the keys and the service that its package finds; nothing was flown."
            ) from error
        if is_occupied and not replace_old:
            raise FleetError(
                f"there is a store at {self.remote} already, which may be that of another fleet: "
                "choose another --store, or give --replace."
            )

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
        """Turn an error of the service into one sentence, within a context.

        Raises
        ------
        FleetError
            Instead of the error, if the store has a remote address.
        """
        try:
            yield
        except (TwinMasterError, ReportingError):
            raise
        except Exception as error:
            if not self.remote:
                raise
            raise _ServiceError(self.remote, one_line(error) or type(error).__name__) from error


class _ServiceError(FleetError):
    """The service of a store does not answer, or refuses what is asked of it.

    Parameters
    ----------
    address : str
        The address of the store.
    reason : str
        What the service, or the package for it, says.
    """

    def __init__(self, address: str, reason: str) -> None:
        super().__init__(
            f"the store at {address} cannot be read or written ({reason}): what was flown is kept, "
            "repeat the command once the service answers."
        )
        self.reason = reason


def address_of(config_of_fleet: dict[str, object], folder: Path) -> StoreAddress:
    """Return where the store of a fleet is, given its record in `config.json`."""
    return StoreAddress(folder, str(config_of_fleet.get("store", "")))
