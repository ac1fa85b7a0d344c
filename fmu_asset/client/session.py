"""`FmiAsset`: the one client of any FMU. It knows FMI and roles of variables, not wings."""

from __future__ import annotations

import os
from array import array
from copy import copy
from typing import Self, Unpack

import numpy as np

from fmu_asset.archive.declared import FmuDescription
from fmu_asset.archive.fmu_file import read_fmu
from fmu_asset.errors import FmuError
from reporting.progress import Progress, reporter

from .binding import Binding, load_binding
from .blocks import HEAD_BYTES, Blocks
from .health_at_start import split_where_health_changes
from .instance_host import Host, InstanceHost, worker_limits
from .observations import Observation, ObservationHistory, joined_histories
from .running_fmu import RunningFmu
from .saved_state import AssetStart, SavedState
from .values import (
    Histories,
    Inputs,
    InputsByRole,
    PlainValue,
    Values,
    inputs_by_role,
    plain_values,
)


class FmiAsset:
    """An FMU that is simulated step by step through a binding.

    The FMU runs in a worker process of its own unless `isolated` is False: only the worker provides
    the wall-clock limit and protection against crashes. The asset is opened by the first `reset`,
    `step` or `with`.

    Parameters
    ----------
    fmu_path : path-like or FmuDescription
        An FMU of FMI 1, 2 or 3, for co-simulation or model exchange, or what `read_fmu` returned
        for it.
    isolated : bool
        Whether the FMU runs in a worker process.
    step_timeout, load_timeout : float, optional
        Wall-clock limits of one step, and of loading and initialisation [s]; those of the binding
        if absent.
    memory_limit : float, optional
        Limit of the worker's resident memory [MiB]; that of the binding if absent.
    parameters : mapping of str to float, optional
        Parameters by the binding's names and in its units; they are set at every reset that gives
        no others.

    Attributes
    ----------
    description : FmuDescription
        Declarations of the FMU.
    state_method : {"serialised", "replay"}
        How `save_state` keeps the state: serialised by the FMU, or as the inputs of all steps.
    reset_trial : ResetTrial
        What is known about the FMU's own reset; it is tested at the first reset after a simulation.
    recorded_units : dict of str to str
        Units of `Observation.extra`, by name.

    Raises
    ------
    FmuFileError, FmuUnsupportedError
        If the FMU is missing, damaged, unsafe or of another kind.
    BindingError
        If the binding does not fit the FMU: a variable is missing, of the wrong causality or in
        another unit.
    FmuInputError
        If a parameter lies outside its range.
    """

    def __init__(
        self,
        fmu_path: str | os.PathLike[str] | FmuDescription,
        binding: Binding | str | os.PathLike[str],
        *,
        isolated: bool = True,
        step_timeout: float | None = None,
        load_timeout: float | None = None,
        memory_limit: float | None = None,
        parameters: Values | None = None,
    ) -> None:
        if not isinstance(binding, Binding):
            binding = load_binding(binding)
        limits = worker_limits(binding, step_timeout, load_timeout, memory_limit)
        if isinstance(fmu_path, FmuDescription):
            description = fmu_path
        else:
            description = read_fmu(fmu_path, binding.binding.interface)
        blocks = Blocks(description, binding)
        host = InstanceHost(blocks.description, blocks.plan, limits, isolated=isolated)
        self._compose(blocks, host, parameters or {})

    def _compose(self, blocks: Blocks, host: Host, parameters: Values) -> None:
        """Set up the asset from its blocks and its host; the FMU is not started yet."""
        self._blocks = blocks
        self._running = RunningFmu(blocks, host)
        self.description = blocks.description
        self.binding = blocks.binding
        self.recorded_units = blocks.reply.extra_units
        self.reset_trial = host.reset_trial
        self.state_method = self._running.state_method
        self._set_parameters(parameters)

    # ------------------------------------------------------------------ properties

    @property
    def step_index(self) -> int:
        """Number of steps since the last reset."""
        return self._running.step_index

    @property
    def time(self) -> float:
        """Time of the asset [s]: start + i * interval, never accumulated."""
        return self._running.time

    @property
    def log(self) -> tuple[tuple[str, str], ...]:
        """Status and text of the last messages of the FMU, the oldest first."""
        return self._running.host.log

    @property
    def worker_process_id(self) -> int | None:
        """Process number of the worker; None without one."""
        worker = self._running.host.worker
        return None if worker is None else worker.process_id

    @property
    def worker_memory(self) -> int | None:
        """Resident memory of the worker [bytes]; None without one."""
        worker = self._running.host.worker
        return None if worker is None else worker.memory

    def input_range(self, role: str, name: str) -> tuple[float, float]:
        """Return the smallest and largest allowed value of an input, in the binding's unit.

        If both the binding and the FMU limit the input, the narrower range holds.

        Parameters
        ----------
        role : str
            Its role in the binding, such as "control" or "load".
        name : str
            Its name in the binding.

        Raises
        ------
        BindingError
            If the binding has no such input.
        """
        bound_input = self._blocks.bound_input(role, name)
        limits = (bound_input.low, bound_input.high)
        # A negative factor of the conversion exchanges the limits, so they are sorted.
        low, high = sorted(bound_input.conversion.from_fmu(limit) for limit in limits)
        return low, high

    def check_parameters(self, parameters: Values) -> None:
        """Check values of parameters without setting them.

        Parameters
        ----------
        parameters : mapping of str to float
            Parameters by the binding's names.

        Raises
        ------
        BindingError
            If one is neither in the binding nor a parameter of the FMU.
        FmuInputError
            If a value is not finite, not whole or outside its range.
        """
        self._blocks.settings(parameters)

    # ------------------------------------------------------------------ opening and closing

    def __enter__(self) -> Self:
        if self._running.phase != "ready":
            self.reset()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the worker and remove its files; `reset` opens the asset again."""
        self._running.close()

    def reset(self, parameters: Values | None = None, **inputs: Unpack[Inputs]) -> None:
        """Start the FMU again from its initial state.

        Parameters
        ----------
        parameters : mapping of str to float, optional
            Parameters in the binding's units; they also hold for later resets. By default those of
            the last reset, or of the constructor.
        **inputs : mapping of str to float, optional
            `control`, `health`, `load` and `port`: inputs that hold already during the
            initialisation. If none is given, the FMU's start values hold.

        Raises
        ------
        FmuInputError
            If a value is not finite or outside its range.
        BindingError
            If a name is not in the binding.
        FmuCallError, FmuWorkerError, FmuTimeoutError
            If the FMU or its worker fails.
        """
        by_role = inputs_by_role(inputs)
        if parameters is not None:
            self._set_parameters(parameters)
        self._restart(by_role)

    def renew(self, **inputs: Unpack[Inputs]) -> None:
        """Replace the FMU's instance by a new one in the same process, and start it.

        Unlike `reset`, this does not rely on the reset function of the FMU.

        Parameters
        ----------
        **inputs : mapping of str to float, optional
            `control`, `health`, `load` and `port`, as for `reset`.

        Raises
        ------
        FmuInputError, BindingError
            If an input does not fit.
        FmuError
            If the FMU fails.
        """
        by_role = inputs_by_role(inputs)
        try:
            self._running.host.renew()
        except FmuError as error:
            self._running.raise_located(error, "making a new instance")
        self._restart(by_role, renewed=True)

    def sibling(self, parameters: Values | None = None) -> Self:
        """Return an independent asset of the same FMU, binding and limits, not yet started.

        The extracted files of the FMU are shared.

        Parameters
        ----------
        parameters : mapping of str to float, optional
            Parameters in the binding's units; by default those of this asset.

        Raises
        ------
        BindingError, FmuInputError
            If a parameter is unknown or lies outside its range.
        """
        sibling = copy(self)
        sibling._compose(
            self._blocks,
            self._running.host.sibling(),
            self._parameters if parameters is None else parameters,
        )
        return sibling

    # ------------------------------------------------------------------ starts

    def _set_parameters(self, parameters: Values) -> None:
        """Set the parameters of later starts, in the binding's units."""
        self._settings = self._blocks.settings(parameters, self._running.last_start.health)
        self._parameters = plain_values(parameters)

    def _restart(self, inputs: InputsByRole, *, renewed: bool = False) -> None:
        """Start the FMU again with inputs that hold already during its initialisation.

        With `renewed`, the instance is new and needs no reset.
        """
        health = self._running.last_start.health
        if self._blocks.health_at_start:
            inputs, health_values = self._blocks.initial_values.split_inputs(inputs)
            self._settings = self._blocks.settings(self._parameters, health_values)
            health = plain_values(health_values)
        request = self._blocks.request.start_values(inputs)
        with_inputs = self._blocks.request.write(request, inputs)
        self._start(request, health, with_inputs=with_inputs, renewed=renewed)

    def _restart_if_health_changes(self, inputs: InputsByRole) -> InputsByRole:
        """Start the FMU again if an input of `health` changes; return the inputs still to be set.

        This concerns those inputs of `health` that the FMU accepts only before its initialisation.
        The FMU starts again at the present time with the present inputs, so that states before this
        time can no longer be restored by a replay of all inputs.
        """
        running = self._running
        inputs, changed_health = self._blocks.initial_values.split_inputs(inputs)
        health = running.last_start.health | plain_values(changed_health)
        if health == running.last_start.health:
            return inputs
        settings = self._blocks.settings(self._parameters, health)
        if running.phase == "ready":
            request = list(running.host.request)
            self._blocks.request.write(request, inputs)
            with_inputs = True
        else:
            running.check_open()
            request = self._blocks.request.start_values(inputs)
            with_inputs = self._blocks.request.write(request, inputs)
        self._settings = settings
        self._start(request, health, with_inputs=with_inputs, index=self.step_index)
        return inputs

    def _start(
        self,
        request: list[float],
        health: dict[str, PlainValue],
        *,
        with_inputs: bool,
        renewed: bool = False,
        index: int = 0,
    ) -> None:
        """Start the FMU with the present settings, which already contain the health.

        `request` holds the inputs of the start, which are sent during the initialisation only if
        `with_inputs` is set. `index` counts the steps made before this start.
        """
        inputs = array("d", request).tobytes()[HEAD_BYTES:] if with_inputs else b""
        start = AssetStart(self._parameters, health, index, inputs)
        self._running.start(start, self._settings, request, renewed=renewed)

    def _open(self, inputs: InputsByRole) -> None:
        """Start the FMU at its first use, before a step with the given inputs.

        An FMU that was closed or broken is not started: the caller must reset the asset first.
        """
        if self._running.phase == "ready":
            return
        self._running.check_open()
        # under linear interpolation the first step begins at the start values, so they must fit
        if not self.binding.binding.structural_parameters or self._running.linear_count:
            inputs = {}
        request = self._blocks.request.start_values(inputs)
        self._start(request, self._running.last_start.health, with_inputs=False)

    # ------------------------------------------------------------------ one step

    def step(
        self,
        control: Values | None = None,
        health: Values | None = None,
        load: Values | None = None,
        port: Values | None = None,
    ) -> Observation:
        """Make one communication step and return the outputs after it.

        Inputs are given by the binding's names and in its units; one that is not given keeps its
        last value. If the FMU refuses the step, the asset is where it was before it.

        Parameters
        ----------
        control, health, load, port : mapping of str to float, or to a sequence for an array
            Inputs of this step. An input of a port is called `<port>.<quantity>`.

        Raises
        ------
        FmuInputError
            If a value is not finite or outside the FMU's range; nothing was sent.
        BindingError
            If a name is not in the binding.
        FmuCallError
            If the FMU refused the step (Discard) or failed.
        FmuEndedError
            If the FMU ended its simulation; `observe` still reads its outputs.
        FmuOutputError
            If an output is not finite.
        FmuWorkerError, FmuTimeoutError
            If the worker died or took too long.
        """
        inputs: InputsByRole = {"control": control, "health": health, "load": load, "port": port}
        if self._blocks.health_at_start:
            inputs = self._restart_if_health_changes(inputs)
        self._open(inputs)
        self._running.step(inputs)
        return self._observation()

    def hold(
        self,
        control: Values | None = None,
        health: Values | None = None,
        load: Values | None = None,
        port: Values | None = None,
    ) -> None:
        """Set inputs without making a step.

        They keep these values until they are set again. Under linear interpolation the next step
        begins at these values, so an input can jump.

        Parameters
        ----------
        control, health, load, port : mapping of str to float, or to a sequence for an array
            Inputs, as for `step`.

        Raises
        ------
        FmuInputError, BindingError
            As `step`.
        """
        inputs: InputsByRole = {"control": control, "health": health, "load": load, "port": port}
        if self._blocks.health_at_start:
            inputs = self._restart_if_health_changes(inputs)
        self._open(inputs)
        self._running.hold(inputs)

    def observe(self) -> Observation:
        """Return the present outputs without making a step, such as the initial ones.

        Raises
        ------
        FmuError
            If the FMU fails, or an output is not finite.
        """
        self._open({})
        self._running.read()
        return self._observation()

    def _observation(self) -> Observation:
        """Return the outputs in the reply; raise an error if one is not finite."""
        return self._blocks.reply.observation(self._running.finite_reply(), self._running.time)

    # ------------------------------------------------------------------ many steps

    def simulate(
        self,
        control: Histories | None = None,
        health: Histories | None = None,
        load: Histories | None = None,
        port: Histories | None = None,
        *,
        steps: int | None = None,
        progress: Progress | None = None,
    ) -> ObservationHistory:
        """Make many steps from the present state with prescribed inputs, and return all outputs.

        The result is bitwise equal to that of single calls of `step`. All inputs are checked before
        the first step. If a step fails, the asset stays in the state before that step. If the FMU
        ends its simulation, the result ends there, and its attribute `ended` says so.

        Parameters
        ----------
        control, health, load, port : mapping of str to (N,) array-like or float
            Inputs by the binding's names and in its units: a value for each step, or one for all
            steps. An array of n values is (N, n) or (n,). An input that is not given keeps its last
            value.
        steps : int, optional
            The number of steps N; by default the length of the histories.
        progress : Progress, optional
            The display of the progress.

        Raises
        ------
        FmuInputError
            If a value is not finite or out of range, or histories have different lengths; nothing
            was sent.
        BindingError, FmuCallError, FmuOutputError, FmuWorkerError, FmuTimeoutError
            As `step`; the message says at which step. A worker that dies or takes too long reports
            every 20 ms, so the step in the message may be a little early.
        """
        histories: InputsByRole = {
            "control": control,
            "health": health,
            "load": load,
            "port": port,
        }
        if not self._blocks.health_at_start:
            return self._simulate(histories, steps, progress)
        # Health that an FMU takes only at its start can change only by a restart.
        histories_of_runs = []
        for run in split_where_health_changes(self._blocks, histories, steps):
            self._restart_if_health_changes(run.first_inputs)
            history = self._simulate(run.histories, run.steps, progress)
            histories_of_runs.append(history)
            if history.ended:
                break
        return joined_histories(histories_of_runs)

    def _simulate(
        self, histories: InputsByRole, steps: int | None, progress: Progress | None
    ) -> ObservationHistory:
        """Make the steps of `simulate` without starting the FMU again, and return the outputs.

        If the FMU ends early, the history ends with its last outputs.
        """
        self._open(histories)
        running = self._running
        steps_before = running.step_index
        requests = running.requests_of_steps(histories, steps)
        times = running.times(len(requests))
        replies = np.full((len(requests), len(running.host.reply)), np.nan)
        with reporter(progress).stage("Simulating", total=len(requests), unit="steps") as stage:
            early_end = running.run(requests, replies, stage)
        steps_made = running.step_index - steps_before
        if early_end is None:
            running.host.reply[:] = replies[steps_made - 1]
            running.finite_reply(f" It was step {running.step_index - 1}.")
            return self._blocks.reply.history(times[1:], replies)
        if early_end.time is not None and early_end.time > times[steps_made]:
            # The FMU ended within the next step: its last outputs, at the time at which it ended,
            # are added.
            steps_made += 1
            times[steps_made] = early_end.time
            replies[steps_made - 1] = np.frombuffer(running.present_outputs())
        return self._blocks.reply.history(
            times[1 : steps_made + 1], replies[:steps_made], early_end.sentence
        )

    # ------------------------------------------------------------------ states

    def save_state(self) -> bytes:
        """Return the state of the asset as bytes, for `restore_state` in this or another process.

        If the FMU can serialise its state, the bytes hold that state. Otherwise they hold the
        inputs of all steps since the last reset, which `restore_state` replays (see
        `state_method`).

        Raises
        ------
        FmuStateError
            If the asset is not open.
        FmuCallError
            If the FMU fails to save.
        """
        return self._running.save_state()

    def restore_state(self, content: bytes) -> None:
        """Restore a state that `save_state` returned, in this or an earlier process.

        Raises
        ------
        FmuStateError
            If it is damaged, belongs to another FMU or step size, or the FMU gives other outputs
            than when it was saved.
        FmuCallError, FmuWorkerError, FmuTimeoutError
            If the FMU fails.
        """
        saved_state = SavedState.from_bytes(content)
        self._running.check_saved_state(saved_state)
        # An instance that was started in the same way takes a serialised state as it is, which
        # makes ensembles fast.
        if saved_state.method == "replay" or not self._running.was_started_as(saved_state):
            self._start_as_saved(saved_state.start)
        self._running.restore(saved_state)

    def _start_as_saved(self, start: AssetStart) -> None:
        """Repeat the start that preceded a saved state."""
        self._parameters = start.parameters
        self._settings = self._blocks.settings(start.parameters, start.health)
        inputs = start.inputs
        if not inputs and self.binding.binding.structural_parameters:
            # The start values of resized arrays may not fit. Zeros fill the request instead; they
            # are not sent to the FMU.
            inputs = bytes(self._running.bytes_of_inputs)
        if inputs:
            request = [0.0, 0.0, *np.frombuffer(inputs).tolist()]
        else:
            request = self._blocks.request.start_values({})
        self._running.start(start, self._settings, request)

    def fork(self) -> Self:
        """Return a copy of this asset in the same state, with a worker of its own.

        The FMU is not extracted again.

        Raises
        ------
        FmuStateError
            If the asset is not open.
        FmuError
            As `save_state` and `restore_state`.
        """
        state = self.save_state()
        forked_asset = self.sibling()
        try:
            forked_asset.restore_state(state)
        except BaseException:
            forked_asset.close()
            raise
        return forked_asset
