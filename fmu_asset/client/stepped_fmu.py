"""Communication steps of an FMU with a binding, one by one or many at once."""

from __future__ import annotations

import numpy as np

from fmu_asset.errors import FmuEndedError, FmuError
from reporting.arrays import Float
from reporting.progress import Progress, Stage, reporter

from .health_at_start import split_where_health_changes
from .observations import Observation, ObservationHistory, joined_histories
from .opened_fmu import HEAD_BYTES, OpenedFmu
from .values import Histories, InputsByRole, Values

_BLOCK_BYTES = 2**20
"""Largest size of the requests, or replies, that are sent in one message."""


class SteppedFmu(OpenedFmu):
    """An opened FMU that makes communication steps; `FmiAsset` adds saved states.

    Parameters, attributes and errors are those of `FmiAsset`.
    """

    def step(
        self,
        control: Values | None = None,
        health: Values | None = None,
        load: Values | None = None,
        port: Values | None = None,
    ) -> Observation:
        """Make one communication step.

        Inputs are given by the binding's names and in its units; one that is not given keeps its
        last value. If the FMU refuses the step, the asset is where it was before it.

        Parameters
        ----------
        control, health, load, port : mapping of str to float, or to a sequence for an array
            Inputs of this step; those of a port are called `<port>.<quantity>`.

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
        if self._exchange.health_slots:
            inputs = self._restart_if_health_changes(inputs)
        instance = self._opened_instance(inputs)
        request = self._request
        previous_request = request.tobytes()
        begin = self._start_time + self.step_index * self._interval
        if self._linear_count:
            # Linear inputs begin at their values at the end of the last step. The block holds their
            # values at the end of the step first, and those at its beginning last.
            request[-self._linear_count :] = request[2 : 2 + self._linear_count]
        try:
            self._exchange.request.place(request, inputs)
            request[0] = begin
            request[1] = self._step_size
            instance.step()
            if not self.step_index:
                self._repeat_first_step_if_contradicted()
        except FmuError as error:
            self._request.cast("B")[:] = previous_request
            self._raise_located(error, f"step {self.step_index} from t = {begin:g} s")
        self.step_index += 1
        if self.state_method == "replay":
            self._record.append(self._request.tobytes()[HEAD_BYTES:])
        return self._observation()

    def _repeat_first_step_if_contradicted(self) -> None:
        """Repeat the first step in a new instance, if the step shows that the reset has failed.

        The host replaces the instance until it has one that was properly at its start.
        """
        while True:
            replacement = self._replaced_instance(self._request.tobytes(), self._reply)
            if replacement is None:
                return
            replacement.step()

    def hold(
        self,
        control: Values | None = None,
        health: Values | None = None,
        load: Values | None = None,
        port: Values | None = None,
    ) -> None:
        """Set inputs now, without a step.

        Later steps keep them unless they give other values. Under linear interpolation the next
        step begins at these values, so this is how an input can jump.

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
        if self._exchange.health_slots:
            inputs = self._restart_if_health_changes(inputs)
        self._opened_instance(inputs)
        previous_request = self._request.tobytes()
        try:
            self._exchange.request.place(self._request, inputs)
        except FmuError:
            self._request.cast("B")[:] = previous_request
            raise

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
        """Make many communication steps under prescribed inputs, from the present state on.

        The result equals, bit by bit, that of as many calls of `step`. All inputs are checked
        before the first step. If a step fails, the asset stays in the state after the step before.
        If the FMU ends its simulation, the result ends there, and its attribute `ended` says so.

        Parameters
        ----------
        control, health, load, port : mapping of str to (N,) array-like or float
            Inputs by the binding's names and in its units: a value for each step, or one for all
            steps. An array of n values is (N, n) or (n,). An input that is not given keeps its last
            value.
        steps : int, optional
            The number of steps N; if left out, the length of the histories.
        progress : Progress, optional
            The display of the progress.

        Raises
        ------
        FmuInputError
            If a value is not finite or out of range, or histories have different lengths; nothing
            was sent.
        BindingError, FmuCallError, FmuOutputError, FmuWorkerError, FmuTimeoutError
            As `step`; the message says at which step. A worker that dies or takes too long reports
            every 20 ms: the step named may be a little early.
        """
        histories: InputsByRole = {
            "control": control,
            "health": health,
            "load": load,
            "port": port,
        }
        # Health that an FMU takes only at its start can change only by a restart.
        if self._exchange.health_slots:
            return self._simulate_with_restarts(histories, steps, progress)
        return self._simulate(histories, steps, progress)

    def _simulate_with_restarts(
        self, histories: InputsByRole, steps: int | None, progress: Progress | None
    ) -> ObservationHistory:
        """Make many steps, with a new start whenever the health changes; see `simulate`."""
        histories_of_runs = []
        for run in split_where_health_changes(self._exchange, histories, steps):
            self._restart_if_health_changes(run.first_inputs)
            history = self._simulate(run.histories, run.steps, progress)
            histories_of_runs.append(history)
            if history.ended:
                break
        return joined_histories(histories_of_runs)

    def _simulate(
        self, histories: InputsByRole, steps: int | None, progress: Progress | None
    ) -> ObservationHistory:
        """Make many steps in one instance; see `simulate`."""
        self._opened_instance(histories)
        requests = self._exchange.request.rows(np.array(self._request), histories, steps)
        count = len(requests)
        index = np.arange(self.step_index, self.step_index + count + 1)
        times = np.asarray(self._start_time + index * self._interval, dtype=np.float64)
        requests[:, 0] = times[:-1]
        requests[:, 1] = self._step_size
        if self._linear_count:
            self._set_begins_of_lines(requests)
        replies = np.full((count, len(self._reply)), np.nan)
        first_index = self.step_index
        early_end = self._run_in_blocks(requests, replies, progress)
        if early_end is None:
            return self._exchange.outputs.history(times[1:], replies)
        steps_made = self.step_index - first_index
        if early_end.time is not None and early_end.time > times[steps_made]:
            # The FMU ended within the next step: its last outputs, at the time at which it ended,
            # are added.
            steps_made += 1
            times[steps_made] = early_end.time
            replies[steps_made - 1] = np.frombuffer(self._present_outputs())
        return self._exchange.outputs.history(
            times[1 : steps_made + 1], replies[:steps_made], early_end.sentence
        )

    def _set_begins_of_lines(self, requests: Float) -> None:
        """Let the linear inputs of each step begin at their values at the end of the step before.

        Parameters
        ----------
        requests : (N, 2 + n_inputs) ndarray
            The request block of each step; changed in place.
        """
        end_values = slice(2, 2 + self._linear_count)
        requests[0, -self._linear_count :] = np.array(self._request[end_values])
        requests[1:, -self._linear_count :] = requests[:-1, end_values]

    def _run_in_blocks(
        self, requests: Float, replies: Float, progress: Progress | None
    ) -> FmuEndedError | None:
        """Make many steps, in blocks that limit the memory of a call to the worker.

        Parameters
        ----------
        requests : (N, 2 + n_inputs) ndarray
            The request block of each step.
        replies : (N, n_outputs) ndarray
            Filled with the reply block of each step.
        progress : Progress, optional
            The display of the progress.

        Returns
        -------
        FmuEndedError or None
            How the FMU ended its simulation, if it did.
        """
        length = max(1, _BLOCK_BYTES // max(requests[0].nbytes, replies[0].nbytes))
        total = len(requests)
        with reporter(progress).stage("Simulating", total=total, unit="steps") as stage:
            for first in range(0, total, length):
                block = slice(first, first + length)
                early_end = self._run_block(requests[block], replies[block], stage)
                if early_end is not None:
                    return early_end
        return None

    def _run_block(self, requests: Float, replies: Float, stage: Stage) -> FmuEndedError | None:
        """Make a block of steps; return how the FMU ended its simulation, if it did.

        If a step fails, the asset is left in the state after the last complete step.
        """
        previous_request = np.array(self._request)
        first_index = self.step_index
        counter = _StepCounter(stage)
        failure: FmuError | None = None
        try:
            failure = self._run_and_check_start(requests, replies, counter)
        finally:
            steps_made = counter.made
            self.step_index += steps_made
            last_request = requests[steps_made - 1] if steps_made else previous_request
            self._request[:] = last_request.data
            if self.state_method == "replay":
                self._record += [row[2:].tobytes() for row in requests[:steps_made]]
        if isinstance(failure, FmuEndedError):
            return failure
        if failure is not None:
            self._raise_located(failure, f"step {self.step_index} from t = {self.time:g} s")
        self._reply[:] = replies[steps_made - 1]
        self._refuse_not_finite(f" It was step {first_index + steps_made - 1}.")
        return None

    def _run_and_check_start(
        self, requests: Float, replies: Float, counter: _StepCounter
    ) -> FmuError | None:
        """Make a block of steps; repeat it in a new instance if a reset proves to have failed.

        Parameters
        ----------
        requests : (N, 2 + n_inputs) ndarray
            The request block of each step.
        replies : (N, n_outputs) ndarray
            Filled with the reply block of each step.
        counter : _StepCounter
            Counts the steps made.

        Returns
        -------
        FmuError or None
            The error of the step at which the FMU failed, if one did.
        """
        instance = self._opened_instance()
        is_first_block = self.step_index == 0
        while True:
            failure: FmuError | None = None
            try:
                instance.run(requests, replies, counter.report)
            except FmuError as error:
                failure = error
            if not is_first_block or not counter.made:
                return failure
            replacement = self._replaced_instance(requests[0].tobytes(), replies[0])
            if replacement is None:
                return failure
            instance = replacement
            counter.report(0)

    def observe(self) -> Observation:
        """Return the observation of this moment without a step, such as the initial one.

        Raises
        ------
        FmuError
            If the FMU fails, or an output is not finite.
        """
        instance = self._opened_instance()
        try:
            instance.read()
        except FmuError as error:
            self._raise_located(error, f"reading at t = {self.time:g} s")
        return self._observation()

    def _present_outputs(self) -> bytes:
        """Return the present outputs of the FMU as the bytes of doubles."""
        self._instance.read()
        return self._reply.tobytes()


class _StepCounter:
    """Counts the steps of a block and shows them as progress.

    Parameters
    ----------
    stage : Stage
        The stage that shows the progress.

    Attributes
    ----------
    made : int
        Number of steps made.
    """

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self.made = 0

    def report(self, steps_made: int) -> None:
        """Set the number of steps made so far, and show the progress since the last call."""
        self._stage.advance(steps_made - self.made)
        self.made = steps_made
