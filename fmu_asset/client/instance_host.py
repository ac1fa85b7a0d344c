"""The instance of an asset: extracted files, worker process, starts anew, steps and log."""

import weakref
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Protocol, Self

import numpy as np

from fmu_asset.archive.declared import FmuDescription
from fmu_asset.archive.fmu_file import extract_fmu
from fmu_asset.errors import FmuCallError, FmuError, FmuInputError
from fmu_asset.folders import plain_folder, remove_folder
from fmu_asset.instances.base import FmuInstance
from fmu_asset.instances.opening import forget_modules, open_instance
from fmu_asset.instances.plan import Instance, Plan, values_of
from fmu_asset.instances.statuses import status_name
from fmu_asset.worker.client import WorkerInstance, WorkerLimits
from fmu_asset.worker.sandbox import Grants, landlock_version, missing_path
from reporting.arrays import Float
from reporting.formats.toml_file import validate
from reporting.system.log import module_logger
from reporting.system.operating_system import can_supervise

from .binding import Binding
from .reset_trial import FirstStep, InstanceStart, ResetTrial, RestartMethod

_logger = module_logger(__name__)
_logged_warnings: set[str] = set()
_LOG_LENGTH = 200
_BLOCK_BYTES = 2**20
"""Largest size of the requests, or replies, that are sent to a worker in one message."""


class Host(Protocol):
    """What runs the FMU of an asset: one replaceable instance, or several coupled ones."""

    reset_trial: ResetTrial
    """What is known about restarts of the FMU."""

    @property
    def request(self) -> "memoryview[float]":
        """Time, step size and inputs of the next step, as doubles that can be set."""

    @property
    def reply(self) -> Float:
        """The outputs (n_outputs,) after the last step."""

    @property
    def lost(self) -> bool:
        """Whether it must be started again before it can be used."""

    @property
    def log(self) -> tuple[tuple[str, str], ...]:
        """Status and text of the last messages, the oldest first."""

    @property
    def worker(self) -> WorkerInstance | None:
        """The worker process, if there is one."""

    def start(self, start: InstanceStart, *, renewed: bool = False) -> None:
        """Start the simulation; `renewed` says that `renew` was called just before."""

    def renew(self) -> None:
        """Replace the instance by a new one in the same process; `start` must follow."""

    def sibling(self) -> Self:
        """Return an independent host of the same extracted FMU."""

    def close(self) -> None:
        """End the worker and remove files that no other asset uses."""

    def step(self) -> None:
        """Make the step that the request describes."""

    def run(self, requests: Float, replies: Float, report: Callable[[int], object]) -> None:
        """Make many steps; stop after one whose outputs are not finite. See `Instance.run`."""

    def read(self) -> None:
        """Read the outputs of this moment into the reply."""

    def save(self) -> bytes:
        """Return the serialised state."""

    def restore(self, content: bytes) -> None:
        """Go back to a serialised state."""

    def note_errors(self, messages: Iterable[str]) -> None:
        """Add messages of an error to the log."""


class ExtractedFmu:
    """The folder of an extracted FMU, removed when this object is garbage-collected.

    Attributes
    ----------
    users : int
        The number of instances that run from it.

    Raises
    ------
    FmuFileError
        If the FMU cannot be extracted.
    """

    def __init__(self, description: FmuDescription) -> None:
        self.folder: Path = extract_fmu(description)
        self.users = 0
        weakref.finalize(self, remove_folder, self.folder)


class InstanceHost:
    """Makes, restarts, steps and frees the instance of one FMU.

    If the first step after a restart shows that the restart did not work, the instance is replaced
    and the step repeated. So any method may change the attribute `instance`.

    Parameters
    ----------
    plan : Plan
        What each call exchanges with the FMU; the folder is filled in here.
    isolated : bool
        Whether the instance runs in a worker process. This works on Linux only; elsewhere the
        instance runs in this process.

    Attributes
    ----------
    instance : FmuInstance, WorkerInstance or None
        None before the start and after `close`.
    request : memoryview of float
        The request of this instance: time, step size, inputs.
    reply : (n_outputs,) ndarray
        Its reply.
    """

    request: "memoryview[float]"
    reply: Float

    def __init__(
        self, description: FmuDescription, plan: Plan, limits: WorkerLimits, *, isolated: bool
    ) -> None:
        self._description = description
        self._plan = plan
        self._limits = limits
        self._isolated = isolated and can_supervise()
        self._extracted: ExtractedFmu | None = None
        self._release: Callable[[], object] = lambda: None
        self.instance: Instance | None = None
        # If only one instance can be made, there is no new one to compare a reset one with.
        can_make_another = self._isolated or not description.once_per_process
        self.reset_trial = ResetTrial(comparable=can_make_another)
        self._method = RestartMethod.LOADING
        self._start: InstanceStart | None = None
        self._is_at_start = False
        self._log: deque[tuple[str, str]] = deque(maxlen=_LOG_LENGTH)

    def sibling(self) -> Self:
        """Return a host for another instance of the same extracted FMU.

        The folder of the FMU is kept until all siblings are closed or garbage-collected.
        """
        host = type(self)
        sibling = host(self._description, self._plan, self._limits, isolated=self._isolated)
        sibling._extracted = self._extracted
        sibling.reset_trial = self.reset_trial
        return sibling

    # ------------------------------------------------------------------ properties

    @property
    def lost(self) -> bool:
        """Whether there is no instance that can be used."""
        return self.instance is None or self.instance.lost

    @property
    def worker(self) -> WorkerInstance | None:
        """The instance if it runs in a worker process that is not lost, else None."""
        instance = self.instance
        return instance if isinstance(instance, WorkerInstance) and not instance.lost else None

    @property
    def log(self) -> tuple[tuple[str, str], ...]:
        """Status and text of the last messages of the FMU, the oldest first."""
        if self.instance is not None and not self.instance.lost:
            for status, text in self.instance.take_log():
                self._log.append((status_name(status), text))
        return tuple(self._log)

    def note_errors(self, messages: Iterable[str]) -> None:
        """Add messages of an error to the log."""
        self._log.extend(("Error", message) for message in messages)

    # ------------------------------------------------------------------ starts

    def start(self, start: InstanceStart, *, renewed: bool = False) -> None:
        """Start the simulation from the initial state; a lost instance is replaced.

        Parameters
        ----------
        renewed : bool
            Whether the instance has just been made by `renew`, so that it needs no reset.

        Raises
        ------
        FmuError
            If the FMU cannot be extracted, loaded, instantiated or initialised.
        """
        instance = self.instance
        if instance is None or instance.lost:
            instance = self._make_instance()
            self._method = RestartMethod.LOADING
        elif renewed:
            self._method = RestartMethod.RENEWAL
        else:
            instance = self._restarted_instance()
        self._start = start
        start.initialise(instance)
        self._is_at_start = True
        self.request = memoryview(instance.request).cast("B").cast("d")
        self.reply = values_of(instance.reply)

    def renew(self) -> None:
        """Replace the instance by a new one in the same process.

        Raises
        ------
        FmuError
            If the FMU fails.
        """
        self._renewed_instance()

    def _renewed_instance(self) -> Instance:
        """Free the instance and return a new one in the same process."""
        worker = self.worker
        if worker is None:
            return self._make_instance()
        worker.renew()
        return worker

    def close(self) -> None:
        """Free the instance, end the worker and remove files that no other asset uses."""
        self.instance = None
        self._extracted = None
        self._release()

    # ------------------------------------------------------------------ steps

    def step(self) -> None:
        """Make the step that the request describes; repeat it if the last restart did not work."""
        assert self.instance is not None
        self.instance.step()
        if self._is_at_start:
            self._is_at_start = False
            request = self.request.tobytes()
            while self._replace_if_restart_failed(request, self.reply):
                self.instance.step()

    def run(self, requests: Float, replies: Float, report: Callable[[int], object]) -> None:
        """Make many steps, in blocks that limit the size of a message to the worker.

        It stops after a step whose outputs are not all finite. See `Instance.run`.
        """
        length = max(1, _BLOCK_BYTES // max(requests[0].nbytes, replies[0].nbytes))
        for first in range(0, len(requests), length):
            block = slice(first, first + length)
            steps_made = self._run_block(requests[block], replies[block], report, first)
            if steps_made < len(requests[block]):
                return

    def _run_block(
        self, requests: Float, replies: Float, report: Callable[[int], object], first: int
    ) -> int:
        """Make a block of steps that begins at step `first`; return how many were made."""
        assert self.instance is not None
        is_at_start = self._is_at_start
        self._is_at_start = False
        steps_made = 0

        def count_and_report(count: int) -> None:
            nonlocal steps_made
            steps_made = count
            report(first + count)

        while True:
            failure: FmuError | None = None
            try:
                self.instance.run(requests, replies, count_and_report)
            except FmuError as error:
                failure = error
            can_be_compared = is_at_start and steps_made > 0
            if can_be_compared and self._replace_if_restart_failed(
                requests[0].tobytes(), replies[0]
            ):
                count_and_report(0)
                continue
            if failure is not None:
                raise failure
            return steps_made

    def read(self) -> None:
        """Read the outputs of this moment into the reply."""
        assert self.instance is not None
        self.instance.read()

    def save(self) -> bytes:
        """Return the serialised state of the instance."""
        assert self.instance is not None
        return self.instance.save()

    def restore(self, content: bytes) -> None:
        """Restore a serialised state."""
        assert self.instance is not None
        self._is_at_start = False
        self.instance.restore(content)

    def _replace_if_restart_failed(self, request: bytes, reply: Float) -> bool:
        """Replace the instance if its first step proves that its restart did not work.

        A restart has worked if the same start and the same first step give the same outputs
        (n_outputs,) as in the first instance, whose first step is recorded here. If the instance
        was replaced, return True: the step is then in the new request and must be made again.
        """
        trial = self.reset_trial
        start = self._start
        if start is None or not trial.comparable:
            return False
        first_step = trial.first_step
        if first_step is None:
            trial.first_step = FirstStep(start, request, np.array(reply))
            return False
        if start != first_step.start or request != first_step.request:
            return False
        if trial.accepts(self._description.label, self._method, first_step, reply):
            return False
        self.start(start)
        self._is_at_start = False
        self.request.cast("B")[:] = request
        return True

    # ------------------------------------------------------------------ restarts

    def _restarted_instance(self) -> Instance:
        """Return the instance in its state after instantiation, by the fastest method that works.

        The methods are tried in this order: the FMU's own reset, a new instance in the same
        process, and a new process. A method with a known fault is not tried again.
        """
        methods: list[tuple[RestartMethod, Callable[[], Instance]]] = [
            (RestartMethod.RESET, self._reset_instance)
        ]
        if self._isolated and not self._description.once_per_process:
            methods.append((RestartMethod.RENEWAL, self._renewed_instance))
        for method, restart in methods:
            self._method = method
            if not self._is_worth_trying(method):
                continue
            # if the worker does not survive this method, the next one makes a new worker
            with suppress(FmuError):
                instance = self._instance_restarted_by(restart)
                if instance is not None:
                    return instance
        self._method = RestartMethod.LOADING
        return self._make_instance()

    def _is_worth_trying(self, method: RestartMethod) -> bool:
        """Return whether a restart method has no known fault and its result can be verified.

        The FMU's reset is verified against the first step of the first instance.
        """
        trial = self.reset_trial
        cannot_be_verified = (
            method == RestartMethod.RESET and trial.first_step is None and trial.comparable
        )
        return method >= trial.method and not cannot_be_verified

    def _instance_restarted_by(self, restart: Callable[[], Instance]) -> Instance | None:
        """Restart the instance; return None if its first step differs from the recorded one."""
        instance = restart()
        first_step = self.reset_trial.first_step
        if first_step is None:
            return instance
        reply = first_step.repeat(instance)
        label = self._description.label
        if self.reset_trial.accepts(label, self._method, first_step, reply):
            # restart again, since the comparison has made a step
            return restart()
        return None

    def _reset_instance(self) -> Instance:
        """Reset the instance by the FMU's own function, and record it if the FMU refuses."""
        assert self.instance is not None
        try:
            self.instance.reset()
        except FmuCallError:
            self.reset_trial.record_refused_reset()
            raise
        return self.instance

    # ------------------------------------------------------------------ making an instance

    def _make_instance(self) -> Instance:
        """Load the FMU anew and return its instance, in a new worker if this host is isolated."""
        extracted = self._extracted
        # after a crash the files of the FMU may be damaged, so they are extracted again
        has_crashed = self.instance is not None and self.instance.lost
        self.close()
        if extracted is None or has_crashed or not extracted.folder.is_dir():
            extracted = ExtractedFmu(self._description)
        try:
            instance = self._open(replace(self._plan, folder=str(extracted.folder)))
        except BaseException:
            del extracted  # so that its folder is removed now, and not with the traceback
            raise
        extracted.users += 1
        self.instance = instance
        self._extracted = extracted
        # free it also at the end of the interpreter, or if the asset is collected but never closed
        self._release = weakref.finalize(self, _release, instance, extracted)
        return instance

    def _open(self, plan: Plan) -> Instance:
        """Return a new instance, in a worker process if this host is isolated."""
        if not self._isolated:
            return open_instance(plan)
        grants = self._limits.grants
        if grants is not None:
            _check_grants(grants, plan.folder)
        warn_without_sandbox(self._description.label, grants)
        scratch = plain_folder()
        try:
            return WorkerInstance(plan, scratch, limits=self._limits)
        except BaseException:
            remove_folder(scratch)
            raise


def _release(instance: Instance, extracted: ExtractedFmu) -> None:
    """Free an instance; after the last one, unload the Python modules of its FMU."""
    instance.close()
    extracted.users -= 1
    # others may still import what they need
    if isinstance(instance, FmuInstance) and not extracted.users:
        forget_modules(str(extracted.folder))


def _check_grants(grants: Grants, folder: str) -> None:
    """Raise an error if the sandbox grants access to a file or folder that does not exist."""
    missing_file = missing_path(grants, folder)
    if missing_file:
        raise FmuInputError(
            f"The table [limits] of the binding grants {missing_file!r}, which does not exist; "
            "correct it."
        )


def warn_without_sandbox(label: str, grants: Grants | None) -> None:
    """Warn once if an FMU can reach all files of the user.

    Parameters
    ----------
    label : str
        Name of the FMU.
    grants : Grants or None
        What its sandbox allows; None if its binding turns the sandbox off.
    """
    if grants is None:
        warning = (
            f"{label}: its binding turns the sandbox off, so that it has all rights of its user."
        )
    elif not landlock_version():
        warning = (
            "This kernel has no Landlock (Linux 5.13 or later), so that FMUs have all rights of "
            "their user; run FMUs that you do not trust in a container."
        )
    else:
        return
    if warning not in _logged_warnings:
        _logged_warnings.add(warning)
        _logger.warning(warning)


def worker_limits(
    binding: Binding,
    step_timeout: float | None,
    load_timeout: float | None,
    memory_limit: float | None,
) -> WorkerLimits:
    """Return the limits of time and memory for the worker process of an FMU.

    A limit of the caller takes precedence over that of the table `[limits]` in the binding, and
    that over the default.

    Parameters
    ----------
    step_timeout, load_timeout : float or None
        Wall-clock limits of the caller for a step and for loading the FMU [s].
    memory_limit : float or None
        Memory limit of the caller [MiB].

    Raises
    ------
    FmuInputError
        If a limit is not positive.
    """
    limits = binding.limits.model_dump()
    limits_of_caller = {
        "step_time": step_timeout,
        "load_time": load_timeout,
        "memory": memory_limit,
    }
    for key, value in limits_of_caller.items():
        if value is not None:
            limits[key] = value
    return validate(
        WorkerLimits, limits, "the limits of the worker", FmuInputError, what="the limits"
    )
