"""Where the instance of an asset lives: the extracted FMU, and the worker process or this one."""

from __future__ import annotations

import math
import shutil
import weakref
from collections.abc import Callable
from dataclasses import replace

from .archive import plain_folder
from .binding import Binding
from .declared import FmuDescription
from .errors import FmuCallError, FmuInputError
from .extraction import Extraction
from .instances import open_instance
from .instances.base import FmuInstance, forget_modules
from .instances.plan import Plan
from .worker.client import Limits, WorkerInstance

Instance = FmuInstance | WorkerInstance


class Housing:
    """The life of one instance at a time.

    Parameters
    ----------
    description : FmuDescription
        The FMU.
    plan : Plan
        What is exchanged; its folder is still empty.
    limits : Limits
        What a worker may take.
    isolated : bool
        Whether there is a worker.

    Attributes
    ----------
    instance : FmuInstance, WorkerInstance or None
        The one that lives here.
    """

    def __init__(self, description: FmuDescription, plan: Plan, limits: Limits, *, isolated: bool) -> None:
        self._description, self._plan, self._limits, self._isolated = description, plan, limits, isolated
        self._extraction: Extraction | None = None
        self._release: Callable[[], object] = lambda: None
        self.instance: Instance | None = None

    def sibling(self) -> Housing:
        """Return an empty housing beside this one, which shares the extracted FMU as long as it is in use."""
        other = Housing(self._description, self._plan, self._limits, isolated=self._isolated)
        other._extraction = self._extraction
        return other

    def fresh(self) -> Instance:
        """Return an instance as after its instantiation; never one that a fatal error has touched.

        Raises
        ------
        FmuError
            If the FMU cannot be extracted, loaded or instantiated.
        """
        if self.instance is not None and not self.instance.lost:
            try:
                self.instance.reset()
                return self.instance
            except FmuCallError:
                pass  # an FMU that cannot be reset is instantiated anew
        shared = self._extraction
        # After a crash the files of the FMU are not trusted either.
        crashed = self.instance is not None and self.instance.lost
        if shared is not None and (crashed or not shared.usable):
            shared = None
        if shared is not None:
            shared.hold()
        self.close()
        if shared is None:
            shared = Extraction(self._description)
            shared.hold()
        try:
            instance = self._open(replace(self._plan, folder=str(shared.folder)))
        except BaseException:
            shared.release()
            raise
        self.instance, self._extraction = instance, shared
        # Also at the end of the interpreter, or when the asset is forgotten without being closed.
        self._release = weakref.finalize(self, _release, instance, shared)
        return instance

    def _open(self, plan: Plan) -> Instance:
        if not self._isolated:
            return open_instance(plan)
        scratch = plain_folder()
        try:
            return WorkerInstance(plan, scratch, limits=self._limits)
        except BaseException:
            shutil.rmtree(scratch, ignore_errors=True)
            raise

    def close(self) -> None:
        """Free the instance, end the worker and remove what nobody else uses."""
        self.instance = None
        self._release()


def _release(instance: Instance, extraction: Extraction) -> None:
    instance.close()
    if isinstance(instance, FmuInstance):
        forget_modules(str(extraction.folder))
    extraction.release()


def limits_of(
    binding: Binding, step_timeout: float | None, load_timeout: float | None, memory_limit: float | None
) -> Limits:
    """Return what the caller says, else what the binding says, else the defaults.

    Raises
    ------
    FmuInputError
        If one is not positive.
    """
    given = {"step_timeout": step_timeout, "load_timeout": load_timeout, "memory_limit": memory_limit}
    for name, value in given.items():
        if value is not None and not (math.isfinite(value) and value > 0.0):
            unit = "MiB" if name == "memory_limit" else "seconds"
            raise FmuInputError(f"{name} must be a positive number of {unit}, but is {value!r}.")
    own, default = binding.limits, Limits()
    return Limits(
        step_time=step_timeout or own.step_time or default.step_time,
        load_time=load_timeout or own.load_time or default.load_time,
        memory=memory_limit or own.memory or default.memory,
    )
