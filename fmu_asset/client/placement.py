"""Where the instance of an asset lives, and how it gets back to its start: by its own reset if that is good.

Some FMUs return OK from their reset and go on from where they were, or keep a clock that shows later only.
The first step of the first instance is therefore kept. At every later start that step is made again, and
where the flight itself begins with it, it is compared once more: the first difference turns to the next way
of starting for good, a new instance in the same process and then a new process.
"""

import logging
import weakref
from array import array
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from enum import IntEnum
from pathlib import Path

import numpy as np

from fmu_asset.archive.declared import FmuDescription
from fmu_asset.archive.fmu_file import extract_fmu
from fmu_asset.errors import FmuCallError, FmuError, FmuInputError, said
from fmu_asset.folders import plain_folder, remove_folder
from fmu_asset.instances.base import FmuInstance, forget_modules
from fmu_asset.instances.co_simulation import open_instance
from fmu_asset.instances.plan import Instance, Plan, Settings
from fmu_asset.worker.client import WorkerInstance, WorkerLimits
from fmu_asset.worker.sandbox import Grants, landlock_version, missing_path
from reporting.arrays import Float
from reporting.toml_file import validate

from .binding import Binding


@dataclass(frozen=True)
class InstanceStart:
    """How an instance is brought to its first communication point.

    Attributes
    ----------
    time : float
        Start time [s].
    settings : Settings
        What is set before initialisation.
    request : list of float
        The request block: time, step size, inputs.
    with_inputs : bool
        Whether the inputs of the block hold already during initialisation.
    """

    time: float
    settings: Settings
    request: list[float]
    with_inputs: bool

    def make(self, instance: Instance) -> None:
        """Initialise an instance that is as after its instantiation or reset.

        Raises
        ------
        FmuCallError, FmuWorkerError, FmuTimeoutError
            If the FMU or its worker fails.
        """
        memoryview(instance.request).cast("B").cast("d")[:] = array("d", self.request)
        instance.initialise(self.time, self.settings, with_inputs=self.with_inputs)


class RestartMethod(IntEnum):
    """How an instance is brought back to its start, the fastest first."""

    RESET = 0
    RENEWAL = 1
    LOADING = 2


@dataclass
class ResetTrial:
    """Whether the reset of an FMU can be believed; shared by all assets of one opening.

    Attributes
    ----------
    comparable : bool
        Whether there are other instances to compare one with, and they begin alike.
    works : bool or None
        None as long as nothing has shown it.
    fault : str
        What is wrong with it, one sentence; empty as long as nothing is known to be.
    lies : bool
        Whether it returns OK and does nothing of use.
    way : RestartMethod
        The fastest way to start again that has shown no difference.
    first : (InstanceStart, bytes), optional
        How the first instance was started, and the request block of its first step.
    reply : (n,) ndarray
        The outputs after that step.
    """

    comparable: bool = True
    works: bool | None = None
    fault: str = ""
    lies: bool = False
    way: RestartMethod = RestartMethod.RESET
    first: tuple[InstanceStart, bytes] | None = None
    reply: Float = field(default_factory=lambda: np.empty(0))

    def first_step(self, instance: Instance) -> Float:
        """Return the outputs (n,) of an instance that is started and asked as the first one."""
        assert self.first is not None
        start, request = self.first
        start.make(instance)
        memoryview(instance.request).cast("B")[:] = request
        instance.step()
        return np.array(instance.reply)

    def refused(self) -> None:
        """Remember that the FMU has no reset."""
        self.works, self.way = False, RestartMethod.RENEWAL
        self.fault = "It cannot be reset; every start takes a new instance."

    def agrees(self, label: str, way: RestartMethod, reply: Float) -> bool:
        """Return whether a start can be believed; if not, say it once and turn to the next way for good.

        Parameters
        ----------
        label : str
            What the FMU is called.
        way : RestartMethod
            How it was started.
        reply : (n,) ndarray
            Outputs after the first step, which was asked as that of `first`.
        """
        true = self.reply
        different = ~((reply == true) | (np.isnan(reply) & np.isnan(true)))
        if not different.any():
            if way == RestartMethod.RESET:
                self.works = True
            return True
        if way == RestartMethod.LOADING:
            self.comparable, self.first, self.way = False, None, RestartMethod.RENEWAL
            return True
        at = np.flatnonzero(different)[0]
        doubted = " Flights that began by a reset before may be wrong." * bool(self.works)
        self.works, self.lies, self.way = False, True, RestartMethod(way + 1)
        what, instead = _FAULTS[way]
        self.fault = (
            f"{what} (an output is {reply[at]:.9g} where that of a new instance is {true[at]:.9g}); "
            f"every start takes a new {instead} instead.{doubted}"
        )
        if (label, way) not in _said:
            _logger.warning("%s: %s", label, self.fault)
            _said.add((label, way))
        return False


_FAULTS = {
    RestartMethod.RESET: (
        "Its reset returns OK and does not bring it back to its start",
        "instance",
    ),
    RestartMethod.RENEWAL: (
        "Another instance in the same process does not begin as the first one did",
        "process",
    ),
}


_logger = logging.getLogger(__name__)
_said: set[object] = set()
"""What was warned of once already."""


class Extraction:
    """An extracted FMU, at `folder`; it is removed when nothing refers to this any more.

    Attributes
    ----------
    folder : Path
        Where it is.
    users : int
        Number of instances that run from there.

    Raises
    ------
    FmuFileError
        If it cannot be extracted.
    """

    def __init__(self, description: FmuDescription) -> None:
        self.folder: Path = extract_fmu(description)
        self.users = 0
        weakref.finalize(self, remove_folder, self.folder)


class InstanceHost:
    """The life of one instance at a time.

    Parameters
    ----------
    description : FmuDescription
        The FMU.
    plan : Plan
        What is exchanged; its folder is still empty.
    limits : WorkerLimits
        What a worker may take.
    isolated : bool
        Whether there is a worker.

    Attributes
    ----------
    instance : FmuInstance, WorkerInstance or None
        The one that lives here.
    reset_trial : ResetTrial
        Whether the FMU's reset works.
    """

    def __init__(
        self, description: FmuDescription, plan: Plan, limits: WorkerLimits, *, isolated: bool
    ) -> None:
        self._description, self._plan, self._limits, self._isolated = (
            description,
            plan,
            limits,
            isolated,
        )
        self._extraction: Extraction | None = None
        self._release: Callable[[], object] = lambda: None
        self.instance: Instance | None = None
        # Where there can be no instance after the first one, there is nothing to compare a reset with.
        self.reset_trial = ResetTrial(comparable=isolated or not description.once_per_process)
        self._way = RestartMethod.LOADING
        self._start: InstanceStart | None = None

    def sibling(self) -> "InstanceHost":
        """Return an empty housing beside this one, which shares the extracted FMU.

        The folder stays until every sibling that was made of it is closed or collected, used or not.
        """
        other = InstanceHost(self._description, self._plan, self._limits, isolated=self._isolated)
        other._extraction, other.reset_trial = self._extraction, self.reset_trial
        return other

    def start(self, start: InstanceStart, *, renewed: bool = False) -> Instance:
        """Return an instance at its start; never one that a fatal error has touched.

        Parameters
        ----------
        start : InstanceStart
            The start.
        renewed : bool
            Whether the instance has just been made by `renew`.

        Raises
        ------
        FmuError
            If the FMU cannot be extracted, loaded, instantiated or initialised.
        """
        instance = self.instance
        if instance is None or instance.lost:
            instance, self._way = self._another(), RestartMethod.LOADING
        elif renewed:
            self._way = RestartMethod.RENEWAL
        else:
            instance = self._restarted()
        self._start = start
        start.make(instance)
        return instance

    def contradicted(self, request: bytes, reply: Float) -> Instance | None:
        """Return another instance at its start if a flight's first step is not that of a new instance.

        Parameters
        ----------
        request : bytes
            What the step was asked; it is compared if that is what the new instance was asked.
        reply : (n,) ndarray
            The outputs after it.

        Raises
        ------
        FmuError
            If the other one cannot be started.
        """
        trial, start = self.reset_trial, self._start
        if start is None or not trial.comparable:
            return None
        if trial.first is None:
            trial.first, trial.reply = (start, request), np.array(reply)
            return None
        same = (start, request) != trial.first or trial.agrees(
            self._description.label, self._way, reply
        )
        return None if same else self.start(start)

    def renew(self) -> Instance:
        """Free the instance and return another one, in the same process.

        Raises
        ------
        FmuError
            If the FMU fails.
        """
        if isinstance(self.instance, WorkerInstance) and not self.instance.lost:
            self.instance.renew()
            return self.instance
        return self._another()

    def _restarted(self) -> Instance:
        """Return an instance as after its instantiation, by the fastest way that is seen to work."""
        trial = self.reset_trial
        ways: list[tuple[RestartMethod, Callable[[], Instance]]] = [
            (RestartMethod.RESET, self._reset)
        ]
        if self._isolated and not self._description.once_per_process:
            ways.append((RestartMethod.RENEWAL, self.renew))
        for self._way, again in ways:
            unproved = self._way == RestartMethod.RESET and trial.first is None and trial.comparable
            if self._way < trial.way or unproved:
                continue
            with suppress(FmuError):  # a worker that does not survive it is replaced
                instance = again()
                if trial.first is None:
                    return instance
                if trial.agrees(self._description.label, self._way, trial.first_step(instance)):
                    return again()
        self._way = RestartMethod.LOADING
        return self._another()

    def _reset(self) -> Instance:
        assert self.instance is not None
        try:
            self.instance.reset()
        except FmuCallError:
            self.reset_trial.refused()
            raise
        return self.instance

    def _another(self) -> Instance:
        """Return an instance made from the file, in a worker of its own if there are workers."""
        shared = self._extraction
        # After a crash the files of the FMU are not trusted either.
        crashed = self.instance is not None and self.instance.lost
        self.close()
        if shared is None or crashed or not shared.folder.is_dir():
            shared = Extraction(self._description)
        try:
            instance = self._open(replace(self._plan, folder=str(shared.folder)))
        except BaseException:
            del shared  # so that its folder goes now, and not with the traceback
            raise
        shared.users += 1
        self.instance, self._extraction = instance, shared
        # Also at the end of the interpreter, or when the asset is forgotten without being closed.
        self._release = weakref.finalize(self, _release, instance, shared)
        return instance

    def _open(self, plan: Plan) -> Instance:
        if not self._isolated:
            return open_instance(plan)
        grants = self._limits.grants
        if grants is not None and (missing := missing_path(grants, plan.folder)):
            raise FmuInputError(said("binding.grant", missing=missing))
        warn_without_sandbox(self._description.label, grants)
        scratch = plain_folder()
        try:
            return WorkerInstance(plan, scratch, limits=self._limits)
        except BaseException:
            remove_folder(scratch)
            raise

    def close(self) -> None:
        """Free the instance, end the worker and remove what nobody else uses."""
        self.instance = self._extraction = None
        self._release()


def _release(instance: Instance, extraction: Extraction) -> None:
    instance.close()
    extraction.users -= 1
    if (
        isinstance(instance, FmuInstance) and not extraction.users
    ):  # others may yet import what they need
        forget_modules(str(extraction.folder))


def warn_without_sandbox(label: str, grants: Grants | None) -> None:
    """Say once that FMUs, or that this one, are not kept from the user's files, where that is so."""
    if grants is None:
        said = f"{label}: its binding turns the sandbox off, so that it has all rights of its user."
    elif not landlock_version():
        said = (
            "This kernel has no Landlock (Linux 5.13 or later), so that FMUs have all rights of their user; "
            "fly what is not trusted in a container."
        )
    else:
        return
    if said not in _said:
        _said.add(said)
        _logger.warning(said)


def worker_limits(
    binding: Binding,
    step_timeout: float | None,
    load_timeout: float | None,
    memory_limit: float | None,
) -> WorkerLimits:
    """Return what the caller says, else what the binding says, else the defaults.

    Raises
    ------
    FmuInputError
        If one is not positive.
    """
    given = {"step_time": step_timeout, "load_time": load_timeout, "memory": memory_limit}
    limits = binding.limits.model_dump() | {
        key: value for key, value in given.items() if value is not None
    }
    return validate(
        WorkerLimits, limits, "the limits of the worker", FmuInputError, what="the limits"
    )
