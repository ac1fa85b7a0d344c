"""The store of a fleet at an address elsewhere, whose errors are one sentence each.

Packages for services raise exceptions of many classes, which have no common base. They are replaced
here, below zarr and xarray, so that it does not matter when and by whom a lazy array is read.
"""

from collections.abc import AsyncIterator, Callable, Iterable
from contextlib import AbstractContextManager

from zarr.abc.store import ByteRequest
from zarr.core.buffer import Buffer, BufferPrototype
from zarr.storage import FsspecStore, WrapperStore

ExplainedErrors = Callable[[], AbstractContextManager[None]]


class RemoteStore(WrapperStore[FsspecStore]):  # type: ignore[misc]
    """A store that fsspec reaches; each access raises the errors of `StoreAddress`.

    Parameters
    ----------
    store : FsspecStore
        The store.
    explained_errors : callable
        Returns a context that replaces the errors of the service; see
        `StoreAddress.explained_errors`.
    """

    def __init__(self, store: FsspecStore, explained_errors: ExplainedErrors) -> None:
        super().__init__(store)
        self._explained_errors = explained_errors

    def _with_store(self, store: FsspecStore) -> "RemoteStore":
        return type(self)(store, self._explained_errors)

    async def get(
        self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        """Return the content of a file, or a part of it; None if there is no such file."""
        with self._explained_errors():
            return await super().get(key, prototype, byte_range)

    async def get_partial_values(
        self, prototype: BufferPrototype, key_ranges: Iterable[tuple[str, ByteRequest | None]]
    ) -> list[Buffer | None]:
        """Return parts of files."""
        with self._explained_errors():
            parts: list[Buffer | None] = await super().get_partial_values(prototype, key_ranges)
            return parts

    async def exists(self, key: str) -> bool:
        """Return whether there is a file."""
        with self._explained_errors():
            is_there: bool = await super().exists(key)
            return is_there

    async def set(self, key: str, value: Buffer) -> None:
        """Write a file."""
        with self._explained_errors():
            await super().set(key, value)

    async def set_if_not_exists(self, key: str, value: Buffer) -> None:
        """Write a file, unless there is one."""
        with self._explained_errors():
            await super().set_if_not_exists(key, value)

    async def delete(self, key: str) -> None:
        """Remove a file."""
        with self._explained_errors():
            await super().delete(key)

    async def delete_dir(self, prefix: str) -> None:
        """Remove all files whose names begin with a prefix."""
        with self._explained_errors():
            await super().delete_dir(prefix)

    async def list_dir(self, prefix: str) -> AsyncIterator[str]:
        """Yield the names of what is in a folder."""
        with self._explained_errors():
            async for name in super().list_dir(prefix):
                yield name
