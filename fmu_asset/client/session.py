"""`FmiAsset`: the only door to an FMU. It knows FMI and roles, not wings."""

from collections.abc import Mapping
from typing import Any, Self

import numpy as np

from fmu_asset.errors import FmuEndedError, FmuError, FmuStateError, said
from fmu_asset.instances.plan import Instance
from reporting.arrays import Float
from reporting.progress import Progress, Stage, reporter

from .health_at_start import split_where_health_changes
from .layout import Observation, ObservationHistory, joined_histories
from .life import OpenedFmu, SavedState
from .values import Histories, Values, plain_values

_BLOCK_BYTES = 2**20
"""Of the requests or replies that are sent in one message."""
_REPLAY_INSTEAD = (
    'If it cannot save and restore its state, though it declares so, write `state = "replay"` into [binding] '
    "of its binding."
)


class FmiAsset(OpenedFmu):
    """An FMU that is flown step by step through a binding.

    The FMU runs in a worker process of its own unless `isolated` is False: only then are the wall-clock limit
    and protection against crashes given. The asset is opened by the first `reset`, `step` or `with`.

    Parameters
    ----------
    fmu_path : path-like or FmuDescription
        An FMU of FMI 1, 2 or 3, for co-simulation or model exchange, or what `read_fmu` returned for it.
    binding : Binding or path-like
        The binding, or its file.
    isolated : bool
        Whether the FMU runs in a worker process.
    step_timeout, load_timeout : float, optional
        Wall-clock limits of one step, and of loading and initialisation [s]; those of the binding, or 10 and
        60.
    memory_limit : float, optional
        Limit of the worker's resident memory [MiB]; that of the binding, or 4096.
    parameters : mapping of str to float, optional
        Parameters by the binding's names and in its units; they are set at every reset that gives no others.

    Attributes
    ----------
    description : FmuDescription
        What the FMU declares.
    binding : Binding
        The binding, with arrays that are observed or recorded as their elements.
    step_index : int
        Number of steps since the last reset.
    state_method : {"serialised", "replay"}
        How `save_state` keeps the state: serialised by the FMU, or by replaying the recorded inputs.
    reset_trial : ResetTrial
        Whether the FMU's own reset works, which is seen at the first reset after a flight.
    recorded_units : dict of str to str
        Units of `Observation.extra` by name.

    Raises
    ------
    FmuFileError, FmuUnsupportedError
        If the FMU is missing, damaged, unsafe or of another kind.
    BindingError
        If the binding does not fit the FMU: a variable is missing, of the wrong causality or in another unit.
    FmuInputError
        If a parameter lies outside its range.
    """

    def step(
        self,
        control: Values | None = None,
        health: Values | None = None,
        load: Values | None = None,
        port: Values | None = None,
    ) -> Observation:
        """Make one communication step.

        Inputs are given by the binding's names and in its units; one that is not given keeps its last value.
        If the FMU refuses the step, the asset is where it was before it.

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
        inputs: dict[str, Any] = {"control": control, "health": health, "load": load, "port": port}
        if self._exchange.health_slots:
            inputs = self._enter_health(inputs)
        instance = self._opened(inputs)
        request = self._request
        before = request.tobytes()
        begin = self._start_time + self.step_index * self._interval
        if self._lines:
            request[-self._lines :] = request[2 : 2 + self._lines]
        try:
            self._exchange.place(request, inputs)
            request[0] = begin
            request[1] = self._step_size
            instance.step()
            while not self.step_index and (other := self._stand_in(request.tobytes(), self._reply)):
                other.step()
        except FmuError as error:
            self._request.cast("B")[:] = before
            self._fail(error, f"step {self.step_index} from t = {begin:g} s")
        self.step_index += 1
        if self.state_method == "replay":
            self._record.append(request.tobytes()[16:])
        return self._observation()

    def hold(
        self,
        control: Values | None = None,
        health: Values | None = None,
        load: Values | None = None,
        port: Values | None = None,
    ) -> None:
        """Let inputs, as those of `step`, stand at values from this moment on, without a step.

        A step that does not name them keeps them; under linear interpolation the next step's lines begin
        there, so that an input can jump.

        Raises
        ------
        FmuInputError, BindingError
            As `step`.
        """
        inputs: dict[str, Any] = {"control": control, "health": health, "load": load, "port": port}
        if self._exchange.health_slots:
            inputs = self._enter_health(inputs)
        self._opened(inputs)
        before = self._request.tobytes()
        try:
            self._exchange.place(self._request, inputs)
        except FmuError:
            self._request.cast("B")[:] = before
            raise

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
        """Make many communication steps under prescribed inputs, from where the asset is.

        The result is that of as many calls of `step`, to the bit. All inputs are checked before the first
        step. If a step fails, the steps before it are made and the asset is where it was before that one. If
        the FMU ends its simulation, the result ends there and says so in `ended`.

        Parameters
        ----------
        control, health, load, port : mapping of str to (N,) array-like or float
            Inputs by the binding's names and in its units: one for each step, or one for all; (N, n) or (n,)
            for an array. One that is not given keeps its last value.
        steps : int, optional
            Number of steps N; that of the histories if absent.
        progress : Progress, optional
            Where progress is shown.

        Raises
        ------
        FmuInputError
            If a value is not finite or out of range, or histories have different lengths; nothing was sent.
        BindingError, FmuCallError, FmuOutputError, FmuWorkerError, FmuTimeoutError
            As `step`; the message says at which step. A worker that dies or takes too long reports every 20
            ms: the step named may be a little early.
        """
        roles: dict[str, Any] = {"control": control, "health": health, "load": load, "port": port}
        if self._exchange.health_slots:
            return self._simulate_states(roles, steps, progress)
        return self._simulate(roles, steps, progress)

    def _simulate_states(
        self, roles: Mapping[str, Any], steps: int | None, progress: Progress | None
    ) -> ObservationHistory:
        """Make many steps, each run of equal health after a start of its own."""
        histories = []
        for course in split_where_health_changes(self._exchange, roles, steps):
            self._enter_health(course.first_inputs)
            histories.append(self._simulate(course.histories, course.steps, progress))
            if histories[-1].ended:
                break
        return joined_histories(histories)

    def _simulate(
        self, roles: Mapping[str, Any], steps: int | None, progress: Progress | None
    ) -> ObservationHistory:
        """Make many steps in one instance; see `simulate`."""
        self._opened(roles)
        rows = self._exchange.rows(np.array(self._request), roles, steps)
        index = np.arange(self.step_index, self.step_index + len(rows) + 1)
        moments = np.asarray(self._start_time + index * self._interval, dtype=np.float64)
        rows[:, 0], rows[:, 1] = moments[:-1], self._step_size
        if self._lines:
            moving = slice(2, 2 + self._lines)
            rows[0, -self._lines :] = np.array(self._request[moving])
            rows[1:, -self._lines :] = rows[:-1, moving]
        replies = np.full((len(rows), len(self._reply)), np.nan)
        with reporter(progress).stage("Simulating", total=len(rows), unit="steps") as stage:
            begin = self.step_index
            length = max(1, _BLOCK_BYTES // max(rows[0].nbytes, replies[0].nbytes))
            for first in range(0, len(rows), length):
                ended = self._run(
                    rows[first : first + length], replies[first : first + length], stage
                )
                if ended is not None:
                    made = self.step_index - begin
                    if ended.time is not None and ended.time > moments[made]:
                        # A part of the step was made, or all of it.
                        moments[made + 1], made = ended.time, made + 1
                        replies[made - 1] = np.frombuffer(self._outputs_now())
                    moments, replies = moments[: made + 1], replies[:made]
                    break
        sentence = "" if ended is None else ended.sentence
        return self._exchange.outputs.history(moments[1:], replies, sentence)

    def _run(self, rows: Float, replies: Float, stage: Stage) -> FmuEndedError | None:
        """Make a block of steps; whatever happens, the asset is where the last complete one has left it.

        Return how the FMU has ended its simulation, if it has.
        """
        before, begin, made = np.array(self._request), self.step_index, 0

        def report(done: int) -> None:
            nonlocal made
            stage.advance(done - made)
            made = done

        failure: FmuError | None = None
        instance: Instance | None = self._opened()
        try:
            while instance is not None:
                failure = None
                try:
                    instance.run(rows, replies, report)
                except FmuError as error:
                    failure = error
                instance = None
                if (
                    made
                    and not begin
                    and (instance := self._stand_in(rows[0].tobytes(), replies[0]))
                ):
                    report(0)
        finally:
            self.step_index += made
            self._request[:] = (rows[made - 1] if made else before).data
            if self.state_method == "replay":
                self._record += [row[2:].tobytes() for row in rows[:made]]
        if isinstance(failure, FmuEndedError):
            return failure
        if failure is not None:
            self._fail(failure, f"step {self.step_index} from t = {self.time:g} s")
        self._reply[:] = replies[made - 1]
        self._refuse_not_finite(f" It was step {begin + made - 1}.")
        return None

    def observe(self) -> Observation:
        """Return the observation of this moment without a step, such as the initial one."""
        instance = self._opened()
        try:
            instance.read()
        except FmuError as error:
            self._fail(error, f"reading at t = {self.time:g} s")
        return self._observation()

    # ------------------------------------------------------------------ state

    def save_state(self) -> bytes:
        """Return the state of the asset, for `restore_state` in this or another process.

        If the FMU can serialise its state, that is what is kept; if not, the inputs of all steps since the
        last reset are, and restoring replays them (see `state_method`).

        Raises
        ------
        FmuStateError
            If the asset is not open.
        FmuCallError
            If the FMU fails to save.
        """
        if self._phase != "ready":
            raise FmuStateError("There is no state to save before the first reset or step.")
        if self.state_method == "serialised":
            try:
                body = self._instance.save()
            except FmuError as error:
                told = type(error)(
                    f"{error.sentence} {_REPLAY_INSTEAD}", error.messages, error.time
                )
                self._fail(told, "saving the state")
        else:
            body = b"".join(self._record)
        return SavedState(
            method=self.state_method,
            fmu=self.description.sha256,
            index=self.step_index,
            step_size=self._interval,
            start_time=self._start_time,
            parameters=self._parameters,
            health=self._health,
            first_index=self._first_index,
            start_inputs=self._start_inputs,
            inputs=bytes(self._instance.request)[16:],
            outputs=self._outputs_now(),
            body=body,
        ).to_bytes()

    def restore_state(self, content: bytes) -> None:
        """Bring the asset to a state that `save_state` returned, in this or an earlier process.

        Raises
        ------
        FmuStateError
            If it is damaged, belongs to another FMU or step size, or the FMU gives other outputs than when it
            was saved.
        FmuCallError, FmuWorkerError, FmuTimeoutError
            If the FMU fails.
        """
        saved = SavedState.from_bytes(content)
        width = 8 * self._exchange.plan.input_count
        self._refuse_foreign(saved, width)
        replayed = saved.method == "replay"
        ready = self._phase == "ready" and not self._instance.lost
        same = (plain_values(saved.parameters), saved.start_inputs) == (
            self._parameters,
            self._start_inputs,
        ) and (saved.health, saved.first_index) == (self._health, self._first_index)
        # An instance that was initialised in the same way takes the state as it is: what an ensemble needs.
        if replayed or not (ready and same):
            self._health = dict(saved.health)
            self._set_parameters(saved.parameters)
            # Arrays that were resized may have no start values: zeros keep their place, and are not sent.
            empty = bytes(width) if self.binding.binding.structural_parameters else b""
            held = np.frombuffer(saved.start_inputs or empty).tolist()
            start = [0.0, 0.0, *held] if held else self._exchange.start_values({})
            self._begin(start, with_inputs=bool(saved.start_inputs), index=saved.first_index)
        instance = self._instance
        try:
            if replayed:
                for index in range(saved.index - saved.first_index):
                    inputs = saved.body[index * width : (index + 1) * width]
                    self._request[0], self._request[1] = self.time, self._step_size
                    self._request.cast("B")[16:] = inputs
                    instance.step()
                    self.step_index += 1
                    self._record.append(inputs)
            else:
                instance.restore(saved.body)
                self.step_index = saved.index
            self._request.cast("B")[16:] = saved.inputs
            saved.refuse_other_outputs(self._outputs_now(), self._exchange.output_names)
        except FmuError as error:
            self._phase = "broken"
            if not replayed and not isinstance(error, FmuStateError):  # whose sentence says it
                error = type(error)(
                    f"{error.sentence} {_REPLAY_INSTEAD}", error.messages, error.time
                )
            self._fail(error, "restoring the state")

    def fork(self) -> Self:
        """Return another asset of the same FMU in the same state, with a worker of its own.

        The FMU is not extracted again. Each of the two goes its own way from here.

        Raises
        ------
        FmuStateError
            If the asset is not open.
        FmuError
            As `save_state` and `restore_state`.
        """
        state = self.save_state()
        other = self.sibling()
        try:
            other.restore_state(state)
        except BaseException:
            other.close()
            raise
        return other

    def _refuse_foreign(self, saved: SavedState, width: int) -> None:
        """Refuse a state of another FMU or binding; the inputs of one step have `width` bytes."""
        if saved.fmu != self.description.sha256:
            raise FmuStateError(said("state.other_fmu", self=self))
        if (saved.step_size, saved.start_time) != (self._interval, self._start_time):
            raise FmuStateError(
                "The state was saved with another step size or start time; use that binding."
            )
        if (
            saved.method != self.state_method
            or len(saved.inputs) != width
            or len(saved.start_inputs) not in (0, width)
            or not saved.first_index <= saved.index
            or (
                saved.method == "replay"
                and len(saved.body) != width * (saved.index - saved.first_index)
            )
        ):
            raise FmuStateError(said("state.damaged"))

    def _outputs_now(self) -> bytes:
        """Return the outputs of this moment as the FMU gives them."""
        self._instance.read()
        return self._reply.tobytes()
