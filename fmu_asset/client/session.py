"""`FmiAsset`: the one client of any FMU. It knows FMI and roles of variables, not wings."""

from typing import Self

import numpy as np

from fmu_asset.errors import FmuError, FmuStateError

from .opened_fmu import HEAD_BYTES
from .saved_state import SavedState
from .stepped_fmu import SteppedFmu

_REPLAY_INSTEAD = (
    'If it cannot save and restore its state, though it declares so, write `state = "replay"` into '
    "[binding] of its binding."
)


class FmiAsset(SteppedFmu):
    """An FMU that is simulated step by step through a binding.

    The FMU runs in a worker process of its own unless `isolated` is False: only the worker provides
    the wall-clock limit and protection against crashes. The asset is opened by the first `reset`,
    `step` or `with`.

    Parameters
    ----------
    fmu_path : path-like or FmuDescription
        An FMU of FMI 1, 2 or 3, for co-simulation or model exchange, or what `read_fmu` returned
        for it.
    binding : Binding or path-like
        The binding, or its file.
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
    binding : Binding
        The binding, with arrays that are observed or recorded as their elements.
    step_index : int
        Number of steps since the last reset.
    state_method : {"serialised", "replay"}
        How `save_state` keeps the state: serialised by the FMU, or as the inputs of all steps.
    reset_trial : ResetTrial
        Whether the FMU's own reset works, as the first reset after a simulation shows.
    recorded_units : dict of str to str
        Units of `Observation.extra` by name.

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

    def save_state(self) -> bytes:
        """Return the state of the asset, for `restore_state` in this or another process.

        If the FMU can serialise its state, that is kept; if not, the inputs of all steps since the
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
            body=self._state_body(),
            inputs=bytes(self._instance.request)[HEAD_BYTES:],
            outputs=self._present_outputs(),
        ).to_bytes()

    def _state_body(self) -> bytes:
        """Return the FMU's serialised state, or the inputs of the steps to be replayed."""
        if self.state_method == "replay":
            return b"".join(self._record)
        try:
            return self._instance.save()
        except FmuError as error:
            self._raise_located(_with_advice_to_replay(error), "saving the state")

    def restore_state(self, content: bytes) -> None:
        """Bring the asset to a state that `save_state` returned, in this or an earlier process.

        Parameters
        ----------
        content : bytes
            The state that `save_state` returned.

        Raises
        ------
        FmuStateError
            If it is damaged, belongs to another FMU or step size, or the FMU gives other outputs
            than when it was saved.
        FmuCallError, FmuWorkerError, FmuTimeoutError
            If the FMU fails.
        """
        saved_state = SavedState.from_bytes(content)
        self._refuse_foreign(saved_state)
        replays = saved_state.method == "replay"
        # An instance that was started in the same way takes a serialised state as it is, which
        # makes ensembles fast.
        if replays or not self._was_started_like(saved_state):
            self._start_as_saved(saved_state)
        try:
            if replays:
                self._replay(saved_state)
            else:
                self._instance.restore(saved_state.body)
                self.step_index = saved_state.index
            self._request.cast("B")[HEAD_BYTES:] = saved_state.inputs
            saved_state.refuse_other_outputs(self._present_outputs(), self._exchange.output_names)
        except FmuError as error:
            self._phase = "broken"
            # an `FmuStateError` gives this advice itself
            if not replays and not isinstance(error, FmuStateError):
                error = _with_advice_to_replay(error)
            self._raise_located(error, "restoring the state")

    def _was_started_like(self, saved_state: SavedState) -> bool:
        """Return whether the instance runs and had the same start as that of a saved state."""
        if self._phase != "ready" or self._instance.lost:
            return False
        return (
            saved_state.parameters == self._parameters
            and saved_state.start_inputs == self._start_inputs
            and saved_state.health == self._health
            and saved_state.first_index == self._first_index
        )

    def _start_as_saved(self, saved_state: SavedState) -> None:
        """Start an instance with the parameters and inputs of a saved state's start."""
        self._health = dict(saved_state.health)
        self._set_parameters(saved_state.parameters)
        start_inputs = saved_state.start_inputs
        if not start_inputs and self.binding.binding.structural_parameters:
            # The start values of resized arrays may not fit. Zeros fill the block instead; they
            # are not sent to the FMU.
            start_inputs = bytes(self._bytes_of_inputs())
        if start_inputs:
            request = [0.0, 0.0, *np.frombuffer(start_inputs).tolist()]
        else:
            request = self._exchange.request.start_values({})
        with_inputs = bool(saved_state.start_inputs)
        self._start_instance(request, with_inputs=with_inputs, index=saved_state.first_index)

    def _replay(self, saved_state: SavedState) -> None:
        """Repeat the steps of a saved state from its start."""
        bytes_per_step = self._bytes_of_inputs()
        for index in range(saved_state.steps_since_start):
            inputs = saved_state.body[index * bytes_per_step : (index + 1) * bytes_per_step]
            self._request[0] = self.time
            self._request[1] = self._step_size
            self._request.cast("B")[HEAD_BYTES:] = inputs
            self._instance.step()
            self.step_index += 1
            self._record.append(inputs)

    def fork(self) -> Self:
        """Return an independent asset of the same FMU in the same state, with its own worker.

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

    def _bytes_of_inputs(self) -> int:
        """Return the size of the inputs of one step in a request block [bytes]."""
        return 8 * self._exchange.plan.input_count

    def _refuse_foreign(self, saved_state: SavedState) -> None:
        """Refuse a saved state that another FMU or binding has made, or that is damaged."""
        if saved_state.fmu != self.description.sha256:
            raise FmuStateError(
                f"The state was saved with another FMU than {self.description.label} (its hash "
                "differs); use that one."
            )
        if saved_state.step_size != self._interval or saved_state.start_time != self._start_time:
            raise FmuStateError(
                "The state was saved with another step size or start time; use that binding."
            )
        bytes_of_inputs = self._bytes_of_inputs()
        replays = saved_state.method == "replay"
        is_sound = (
            saved_state.method == self.state_method
            and len(saved_state.inputs) == bytes_of_inputs
            and len(saved_state.start_inputs) in (0, bytes_of_inputs)
            and saved_state.first_index <= saved_state.index
            and not (
                replays and len(saved_state.body) != bytes_of_inputs * saved_state.steps_since_start
            )
        )
        if not is_sound:
            raise FmuStateError(
                "The saved state is damaged, or another binding was in use; use that binding."
            )


def _with_advice_to_replay(error: FmuError) -> FmuError:
    """Return an error with the advice to keep states as inputs."""
    return type(error)(f"{error.sentence} {_REPLAY_INSTEAD}", error.messages, error.time)
