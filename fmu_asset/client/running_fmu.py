"""An FMU in operation: it is started and stepped, and its state is saved and restored."""

import math
from typing import Literal, NoReturn

import numpy as np

from fmu_asset.errors import FmuEndedError, FmuError, FmuOutputError, FmuStateError
from fmu_asset.instances.plan import InitialValues
from reporting.arrays import Float
from reporting.progress import Stage

from .blocks import HEAD_BYTES, REQUEST_HEAD, Blocks
from .instance_host import Host
from .reset_trial import InstanceStart
from .saved_state import AssetStart, SavedState, StateMethod
from .values import InputsByRole

_REPLAY_INSTEAD = (
    'If it cannot save and restore its state, though it declares so, write `state = "replay"` into '
    "[binding] of its binding."
)


class RunningFmu:
    """An FMU in operation, driven by requests and replies.

    Attributes
    ----------
    step_index : int
        Number of steps since the last reset.
    phase : {"new", "ready", "broken", "closed"}
        It is broken after a state could not be restored.
    last_start : AssetStart
        How the FMU was started last.
    state_method : {"serialised", "replay"}
        How `save_state` keeps the state.
    linear_count : int
        Number of inputs that change linearly over a step.
    """

    def __init__(self, blocks: Blocks, host: Host) -> None:
        self._blocks = blocks
        self.host = host
        self.phase: Literal["new", "ready", "broken", "closed"] = "new"
        self.step_index = 0
        self.last_start = AssetStart({}, {}, 0, b"")
        self.state_method = self._chosen_state_method()
        self.linear_count = blocks.plan.linear_count
        self._start_time = blocks.binding.binding.start_time
        self._interval = blocks.binding.interval
        self._step_size = blocks.binding.step_size
        # inputs of the steps since the start; a state is restored by repeating them
        self._record: list[bytes] = []

    def _chosen_state_method(self) -> StateMethod:
        """Return how states are saved: as the binding says, else serialised if the FMU can."""
        state_method = self._blocks.binding.binding.state
        if state_method != "auto":
            return state_method
        description = self._blocks.description
        can_serialise = description.can_get_and_set_state and description.can_serialise_state
        # a state in model exchange would have to hold our solver as well
        if can_serialise and description.interface == "co-simulation":
            return "serialised"
        return "replay"

    @property
    def time(self) -> float:
        """Time of the asset [s]: start + i * interval, never accumulated."""
        return self._start_time + self.step_index * self._interval

    def close(self) -> None:
        """End the worker and remove its files."""
        self.phase = "closed"
        self.host.close()

    def check_open(self) -> None:
        """Raise an error if the asset is closed, or if its state could not be restored."""
        if self.phase == "broken":
            raise FmuStateError("A state could not be restored; reset the asset to go on.")
        if self.phase == "closed":
            raise FmuStateError("The asset is closed; reset it to start again.")

    def start(
        self,
        start: AssetStart,
        settings: InitialValues,
        request: list[float],
        *,
        renewed: bool = False,
    ) -> None:
        """Start an instance of the FMU, at the time of a given step.

        Parameters
        ----------
        start : AssetStart
            The step, and the inputs; these are empty if the start values of the FMU hold.
        settings : list of InitialValue
            Parameters and health, in the FMU's units.
        request : list of float
            The request with the inputs of the start.
        renewed : bool
            Whether the instance is new, so that it needs no reset.
        """
        time = self._start_time + start.index * self._interval
        with_inputs = bool(start.inputs)
        try:
            self.host.start(InstanceStart(time, settings, request, with_inputs), renewed=renewed)
        except FmuError as error:
            self.close()
            self.raise_located(error, "the start")
        self.step_index = start.index
        self.last_start = start
        self._record = []
        self.phase = "ready"

    # ------------------------------------------------------------------ steps

    def step(self, inputs: InputsByRole) -> None:
        """Make one step with given inputs; if the FMU refuses it, request and time are restored."""
        request = self.host.request
        previous_request = request.tobytes()
        begin = self.time
        if self.linear_count:
            # Linear inputs begin at their values at the end of the last step. The request holds
            # their values at the end of the step first, and those at its beginning last.
            end_values = slice(REQUEST_HEAD, REQUEST_HEAD + self.linear_count)
            request[-self.linear_count :] = request[end_values]
        try:
            self._blocks.request.write(request, inputs)
            request[0] = begin
            request[1] = self._step_size
            self.host.step()
        except FmuError as error:
            self.host.request.cast("B")[:] = previous_request
            self.raise_located(error, f"step {self.step_index} from t = {begin:g} s")
        self.step_index += 1
        if self.state_method == "replay":
            self._record.append(self.host.request.tobytes()[HEAD_BYTES:])

    def hold(self, inputs: InputsByRole) -> None:
        """Set inputs without a step; if one of them is refused, none is set."""
        request = self.host.request
        previous_request = request.tobytes()
        try:
            self._blocks.request.write(request, inputs)
        except FmuError:
            request.cast("B")[:] = previous_request
            raise

    def times(self, steps: int) -> Float:
        """Return the time now and after each of N steps, (N + 1,) [s]."""
        index = np.arange(self.step_index, self.step_index + steps + 1)
        return np.asarray(self._start_time + index * self._interval, dtype=np.float64)

    def requests_of_steps(self, histories: InputsByRole, steps: int | None) -> Float:
        """Return the requests (N, 2 + n_inputs) of the next N steps; see `Request.of_steps`."""
        previous_request = np.array(self.host.request)
        requests = self._blocks.request.of_steps(previous_request, histories, steps)
        requests[:, 0] = self.times(len(requests))[:-1]
        requests[:, 1] = self._step_size
        if self.linear_count:
            # linear inputs begin at their values at the end of the step before
            end_values = slice(REQUEST_HEAD, REQUEST_HEAD + self.linear_count)
            requests[0, -self.linear_count :] = previous_request[end_values]
            requests[1:, -self.linear_count :] = requests[:-1, end_values]
        return requests

    def run(self, requests: Float, replies: Float, stage: Stage) -> FmuEndedError | None:
        """Make steps until all are made, an output is not finite, or the FMU ends.

        The asset is left after the last complete step, also if the run fails or is interrupted.
        An FMU that ends its simulation is not a failure: that error is returned, all others are
        raised with step and time.

        Parameters
        ----------
        requests : (N, 2 + n_inputs) ndarray
            For each step the time, the step size, and the inputs.
        replies : (N, n_outputs) ndarray
            Row k is filled with the outputs after step k, for the steps that are made.

        Returns
        -------
        FmuEndedError or None
            The error with which the FMU ended its simulation; None if it did not.
        """
        request_before_run = np.array(self.host.request)
        completed_steps = 0

        def count_and_show(count: int) -> None:
            """Note how many steps of this run are complete; `host.run` calls this as it goes."""
            nonlocal completed_steps
            stage.advance(count - completed_steps)
            completed_steps = count

        failure: FmuError | None = None
        try:
            self.host.run(requests, replies, count_and_show)
        except FmuError as error:
            failure = error
        finally:
            # Also on Ctrl-C. The host's request becomes that of the last complete step, because the
            # next step and a saved state take the inputs in force from it.
            self.step_index += completed_steps
            last_request = requests[completed_steps - 1] if completed_steps else request_before_run
            self.host.request[:] = last_request.data
            if self.state_method == "replay":
                # A state is restored by making all steps again: their inputs are recorded, but not
                # time and step size, which follow from the index of the step.
                for request in requests[:completed_steps]:
                    self._record.append(request[REQUEST_HEAD:].tobytes())
        # raised only now that the asset is in order
        if failure is not None and not isinstance(failure, FmuEndedError):
            self.raise_located(failure, f"step {self.step_index} from t = {self.time:g} s")
        return failure

    # ------------------------------------------------------------------ outputs

    def read(self) -> None:
        """Read the present outputs into the reply."""
        try:
            self.host.read()
        except FmuError as error:
            self.raise_located(error, f"reading at t = {self.time:g} s")

    def present_outputs(self) -> bytes:
        """Return the present outputs as the bytes of doubles."""
        self.host.read()
        return self.host.reply.tobytes()

    def finite_reply(self, remark: str = "") -> Float:
        """Return the outputs (n_outputs,); raise `FmuOutputError` if one is not finite.

        `remark` is added to its message.
        """
        reply = self.host.reply
        # a fast test first: the sum of squares can be infinite for large values, too
        if math.isfinite(reply.dot(reply)):
            return reply
        names = []
        for name, value in zip(self._blocks.reply.names, reply.tolist(), strict=False):
            if not math.isfinite(value):
                names.append(name)
        if names:
            listed = ", ".join(names[:5])
            more = f" and {len(names) - 5} more" if len(names) > 5 else ""
            raise FmuOutputError(
                f"The FMU {self._blocks.description.label} gave values that are not finite at "
                f"t = {self.time:g} s: {listed}{more}. Its inputs or its step size are probably "
                "beyond what it can compute; reset the asset or restore a state to go on."
                f"{remark}",
                [text for _, text in self.host.log[-5:]],
            )
        return reply

    # ------------------------------------------------------------------ states

    def save_state(self) -> bytes:
        """Return the state as bytes; see `FmiAsset.save_state`."""
        if self.phase != "ready":
            raise FmuStateError("There is no state to save before the first reset or step.")
        if self.state_method == "replay":
            body = b"".join(self._record)
        else:
            try:
                body = self.host.save()
            except FmuError as error:
                self.raise_located(_with_advice_to_replay(error), "saving the state")
        return SavedState(
            method=self.state_method,
            fmu=self._blocks.description.sha256,
            index=self.step_index,
            step_size=self._interval,
            start_time=self._start_time,
            parameters=self.last_start.parameters,
            health=self.last_start.health,
            first_index=self.last_start.index,
            start_inputs=self.last_start.inputs,
            body=body,
            inputs=self.host.request.tobytes()[HEAD_BYTES:],
            outputs=self.present_outputs(),
        ).to_bytes()

    def was_started_as(self, saved_state: SavedState) -> bool:
        """Return whether the FMU runs, and was started in the same way as a saved state."""
        is_running = self.phase == "ready" and not self.host.lost
        return is_running and saved_state.start == self.last_start

    def restore(self, saved_state: SavedState) -> None:
        """Restore a saved state after its start was repeated; see `FmiAsset.restore_state`."""
        replays = saved_state.method == "replay"
        try:
            if replays:
                self._replay(saved_state)
            else:
                self.host.restore(saved_state.body)
                self.step_index = saved_state.index
            self.host.request.cast("B")[HEAD_BYTES:] = saved_state.inputs
            saved_state.check_outputs(self.present_outputs(), self._blocks.reply.names)
        except FmuError as error:
            self.phase = "broken"
            # an `FmuStateError` gives this advice itself
            if not replays and not isinstance(error, FmuStateError):
                error = _with_advice_to_replay(error)
            self.raise_located(error, "restoring the state")

    def _replay(self, saved_state: SavedState) -> None:
        """Repeat all steps from the start of a saved state to the state."""
        bytes_per_step = self.bytes_of_inputs
        for index in range(saved_state.steps_since_start):
            inputs = saved_state.body[index * bytes_per_step : (index + 1) * bytes_per_step]
            request = self.host.request
            request[0] = self.time
            request[1] = self._step_size
            request.cast("B")[HEAD_BYTES:] = inputs
            self.host.step()
            self.step_index += 1
            self._record.append(inputs)

    @property
    def bytes_of_inputs(self) -> int:
        """Size of the inputs of one step in a request [bytes]."""
        return 8 * self._blocks.plan.input_count

    def check_saved_state(self, saved_state: SavedState) -> None:
        """Raise an error if a state was saved with another FMU or binding, or is damaged."""
        description = self._blocks.description
        if saved_state.fmu != description.sha256:
            raise FmuStateError(
                f"The state was saved with another FMU than {description.label} (its hash "
                "differs); use that one."
            )
        if saved_state.step_size != self._interval or saved_state.start_time != self._start_time:
            raise FmuStateError(
                "The state was saved with another step size or start time; use that binding."
            )
        if not saved_state.is_sound(self.state_method, self.bytes_of_inputs):
            raise FmuStateError(
                "The saved state is damaged, or another binding was in use; use that binding."
            )

    # ------------------------------------------------------------------ errors

    def raise_located(self, error: FmuError, action: str) -> NoReturn:
        """Raise an error again, with the name of the FMU and the failed action in its message.

        The messages of the FMU are added to the log.

        Parameters
        ----------
        action : str
            The action that failed, such as "the start".
        """
        self.host.note_errors(error.messages)
        # other errors are about the caller's request, and their message is complete
        if not isinstance(error, RuntimeError | TimeoutError):
            raise error
        hint = ""
        if action == "the start" and self._blocks.description.needs_tool:
            hint = " It declares that it needs its authoring tool on this machine."
        sentence = f"{self._blocks.description.label}, {action}: {error.sentence}{hint}"
        raise type(error)(sentence, error.messages, error.time) from error


def _with_advice_to_replay(error: FmuError) -> FmuError:
    """Return the error with the advice to save states as inputs."""
    return type(error)(f"{error.sentence} {_REPLAY_INSTEAD}", error.messages, error.time)
