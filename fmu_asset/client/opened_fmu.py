"""An FMU with a binding: opened, started again and closed; subclasses add steps and states."""

import math
import os
from collections import deque
from copy import copy
from typing import Literal, NoReturn, Self, Unpack

import numpy as np

from fmu_asset.archive.declared import FmuDescription
from fmu_asset.archive.fmu_file import read_fmu
from fmu_asset.errors import FmuError, FmuOutputError, FmuStateError
from fmu_asset.instances.plan import Instance
from fmu_asset.instances.statuses import status_name
from fmu_asset.worker.client import WorkerInstance
from reporting.arrays import Float

from .binding import Binding, load_binding
from .exchange import Exchange
from .instance_host import InstanceHost, worker_limits
from .observations import Observation
from .reset_trial import InstanceStart
from .saved_state import StateMethod
from .values import Inputs, InputsByRole, PlainValue, Values, inputs_by_role, plain_values

_LOG_LENGTH = 200
HEAD_BYTES = 16
"""Bytes of time and step size at the beginning of a request block."""


class OpenedFmu:
    """An FMU with a binding, and the instance that runs it.

    Parameters, attributes and errors are those of `FmiAsset`.
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
        exchange = Exchange(description, binding)
        host = InstanceHost(exchange.description, exchange.plan, limits, isolated=isolated)
        self._set_up(exchange, host, parameters or {})

    def _set_up(self, exchange: Exchange, host: InstanceHost, parameters: Values) -> None:
        """Initialise the attributes of an asset whose FMU has not been started.

        Parameters
        ----------
        exchange : Exchange
            The binding, resolved against the FMU.
        host : InstanceHost
            The host of its instance.
        parameters : mapping of str to float
            Parameters by the binding's names.
        """
        self._exchange = exchange
        self._host = host
        self.description = exchange.description
        self.binding = exchange.binding
        self.recorded_units = exchange.recorded_units
        self.reset_trial = host.reset_trial
        self.state_method = self._chosen_state_method()
        self._start_time = self.binding.binding.start_time
        self._interval = self.binding.interval
        self._step_size = self.binding.step_size
        self._linear_count = exchange.plan.linear_count
        self._phase: Literal["new", "ready", "broken", "closed"] = "new"
        self.step_index = 0
        # step number, inputs and health of the last start
        self._first_index = 0
        self._start_inputs = b""
        self._health: dict[str, PlainValue] = {}
        self._set_parameters(parameters)
        # request blocks of the steps since that start; a state is restored by repeating them
        self._record: list[bytes] = []
        self._log: deque[tuple[str, str]] = deque(maxlen=_LOG_LENGTH)

    def _chosen_state_method(self) -> StateMethod:
        """Return how states are saved: as the binding says, or as the FMU supports it best."""
        state_method = self.binding.binding.state
        if state_method != "auto":
            return state_method
        description = self.description
        can_serialise = description.can_get_and_set_state and description.can_serialise_state
        # a state in model exchange would have to hold our solver as well
        if can_serialise and description.interface == "co-simulation":
            return "serialised"
        return "replay"

    # ------------------------------------------------------------------ properties

    @property
    def time(self) -> float:
        """Time of the asset [s]: start + i * interval, never accumulated."""
        return self._start_time + self.step_index * self._interval

    @property
    def log(self) -> tuple[tuple[str, str], ...]:
        """Status and text of the last messages of the FMU, the oldest first."""
        instance = self._host.instance
        if instance is not None and not instance.lost:
            for status, text in instance.take_log():
                self._log.append((status_name(status), text))
        return tuple(self._log)

    def _worker(self) -> WorkerInstance | None:
        """Return the instance if it runs in a worker process that is not lost, else None."""
        instance = self._host.instance
        return instance if isinstance(instance, WorkerInstance) and not instance.lost else None

    @property
    def worker_process_id(self) -> int | None:
        """Process number of the worker; None without one."""
        worker = self._worker()
        return None if worker is None else worker.process_id

    @property
    def worker_memory(self) -> int | None:
        """Resident memory of the worker [bytes]; None without one."""
        worker = self._worker()
        return None if worker is None else worker.memory

    def input_range(self, role: str, name: str) -> tuple[float, float]:
        """Return the least and the largest value of an input, in the unit of the binding.

        The binding, a file, connects names and units of the twin with variables of the FMU. If both
        binding and FMU limit the input, both limits are observed.

        Parameters
        ----------
        role : str
            The role of the input in the binding, such as "control" or "load".
        name : str
            The name of the input in the binding.

        Raises
        ------
        BindingError
            If the binding has no such input.
        """
        # A slot holds where and in which unit the FMU expects the input, and its limits there.
        slot = self._exchange.slot(role, name)
        # A negative factor of the conversion exchanges the limits, so they are sorted.
        low, high = sorted(slot.conversion.from_fmu(limit) for limit in (slot.low, slot.high))
        return low, high

    def check_parameters(self, parameters: Values) -> None:
        """Check that parameters could be set, without setting them.

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
        self._exchange.settings(parameters)

    # ------------------------------------------------------------------ opening and closing

    def __enter__(self) -> Self:
        if self._phase != "ready":
            self.reset()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the worker and remove its files; `reset` opens the asset again."""
        self._phase = "closed"
        self._host.close()

    def reset(self, parameters: Values | None = None, **inputs: Unpack[Inputs]) -> None:
        """Go back to the start.

        Parameters
        ----------
        parameters : mapping of str to float, optional
            Parameters in the binding's units; those of the constructor if absent. They stay for
            later resets.
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

        The method `reset` also starts the FMU again, but by the FMU's own function for this. Call
        `renew` where that function is not trusted.

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
            self._host.renew()
        except FmuError as error:
            self._raise_located(error, "making a new instance")
        self._restart(by_role, renewed=True)

    def sibling(self, parameters: Values | None = None) -> Self:
        """Return an independent asset of the same FMU, binding and limits.

        The FMU is not extracted again, and the new asset has not been started.

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
        sibling._host = self._host.sibling()
        sibling._phase = "new"
        sibling.step_index = 0
        sibling._first_index = 0
        sibling._start_inputs = b""
        sibling._record = []
        sibling._log = deque(maxlen=_LOG_LENGTH)
        sibling._health = {}
        if parameters is not None:
            sibling._set_parameters(parameters)
        elif self._health:
            # the copied settings hold the health of this asset
            sibling._set_parameters(self._parameters)
        return sibling

    # ------------------------------------------------------------------ starts

    def _set_parameters(self, parameters: Values) -> None:
        """Set the parameters of later starts, in the binding's units."""
        self._settings = self._exchange.settings(parameters, self._health)
        self._parameters = plain_values(parameters)

    def _restart(self, inputs: InputsByRole, *, renewed: bool = False) -> None:
        """Start the FMU again with inputs.

        Parameters
        ----------
        inputs : mapping of str to mapping
            Inputs by role and name that hold during the initialisation.
        renewed : bool
            Whether the instance is new, so that it needs no reset.
        """
        if self._exchange.health_slots:
            inputs, health = self._exchange.parameters.split_inputs(inputs)
            self._settings = self._exchange.settings(self._parameters, health)
            self._health = plain_values(health)
        request = self._exchange.request.start_values(inputs)
        with_inputs = self._exchange.request.place(request, inputs)
        self._start_instance(request, with_inputs=with_inputs, renewed=renewed)

    def _restart_if_health_changes(self, inputs: InputsByRole) -> InputsByRole:
        """Start the FMU again if inputs change its health; return the inputs without that health.

        It concerns health that the FMU accepts only before its initialisation. The new start is
        made at the present time with the present inputs. States before it can no longer be
        replayed.

        Parameters
        ----------
        inputs : mapping of str to mapping
            Inputs of the next step by role and name.
        """
        inputs, changed_health = self._exchange.parameters.split_inputs(inputs)
        health = self._health | plain_values(changed_health)
        if health == self._health:
            return inputs
        settings = self._exchange.settings(self._parameters, health)
        if self._phase == "ready":
            start_request = list(self._request)
            self._exchange.request.place(start_request, inputs)
            with_inputs = True
        else:
            self._refuse_closed()
            start_request = self._exchange.request.start_values(inputs)
            with_inputs = self._exchange.request.place(start_request, inputs)
        self._settings = settings
        self._health = health
        self._start_instance(start_request, with_inputs=with_inputs, index=self.step_index)
        return inputs

    def _start_instance(
        self,
        request: list[float],
        *,
        with_inputs: bool,
        renewed: bool = False,
        index: int = 0,
    ) -> None:
        """Start an instance of the FMU, at the time of a given step.

        Parameters
        ----------
        request : list of float
            The request block with the inputs of the start.
        with_inputs : bool
            Whether these are set before the initialisation.
        renewed : bool
            Whether the instance is new, so that it needs no reset.
        index : int
            The number of steps that the asset has made before this start.
        """
        time = self._start_time + index * self._interval
        start = InstanceStart(time, self._settings, request, with_inputs)
        try:
            instance = self._host.start(start, renewed=renewed)
            self._use_instance(instance)
        except FmuError as error:
            self.close()
            self._raise_located(error, "the start")
        self.step_index = index
        self._first_index = index
        self._record = []
        self._start_inputs = bytes(instance.request)[HEAD_BYTES:] if with_inputs else b""
        self._phase = "ready"

    def _use_instance(self, instance: Instance) -> None:
        """Take an instance into use, with fast views of the blocks of its request and its reply."""
        self._instance = instance
        self._request = memoryview(instance.request).cast("B").cast("d")
        self._reply = np.frombuffer(memoryview(instance.reply).cast("B"), dtype=np.float64)

    def _replaced_instance(self, request: bytes, reply: Float) -> Instance | None:
        """Return a new instance if the first step shows that the reset of the present one failed.

        Parameters
        ----------
        request : bytes
            The request block of the first step, which the new instance has to repeat.
        reply : (n,) ndarray
            The outputs after it.

        Returns
        -------
        Instance or None
            None if the present instance is right.
        """
        replacement = self._host.replace_if_contradicted(request, reply)
        if replacement is not None:
            self._use_instance(replacement)
            self._request.cast("B")[:] = request
        return replacement

    def _opened_instance(self, inputs: InputsByRole | None = None) -> Instance:
        """Return the instance; start it at the first use.

        An instance that was closed or broken is not started again: the user must reset the asset.

        Parameters
        ----------
        inputs : mapping of str to mapping, optional
            Inputs of the next step. If it sets the whole of an array that was resized, the FMU's
            start values of this array need not fit.
        """
        self._refuse_closed()
        if self._phase == "new":
            # under linear interpolation the first step begins at the start values, so they must fit
            needs_no_start_values = (
                self.binding.binding.structural_parameters and not self._linear_count
            )
            sent_inputs = inputs if needs_no_start_values and inputs is not None else {}
            request = self._exchange.request.start_values(sent_inputs)
            self._start_instance(request, with_inputs=False)
        return self._instance

    def _refuse_closed(self) -> None:
        """Refuse to use an asset that is closed, or whose state could not be restored."""
        if self._phase == "broken":
            raise FmuStateError("A state could not be restored; reset the asset to go on.")
        if self._phase == "closed":
            raise FmuStateError("The asset is closed; reset it to start again.")

    # ------------------------------------------------------------------ outputs and errors

    def _observation(self) -> Observation:
        """Return the observation that the reply block holds; refuse values that are not finite."""
        self._refuse_not_finite()
        return self._exchange.outputs.observation(self._reply, self.time)

    def _refuse_not_finite(self, remark: str = "") -> None:
        """Refuse outputs that are not finite; the remark is added to the message."""
        # a fast test first: the sum of squares can be infinite for large values, too
        if math.isfinite(self._reply.dot(self._reply)):
            return
        names = []
        for name, value in zip(self._exchange.output_names, self._reply.tolist(), strict=False):
            if not math.isfinite(value):
                names.append(name)
        if names:
            listed = ", ".join(names[:5])
            more = f" and {len(names) - 5} more" if len(names) > 5 else ""
            raise FmuOutputError(
                f"The FMU {self.description.label} gave values that are not finite at "
                f"t = {self.time:g} s: {listed}{more}. Its inputs or its step size are probably "
                "beyond what it can compute; reset the asset or restore a state to go on."
                f"{remark}",
                [text for _, text in self.log[-5:]],
            )

    def _raise_located(self, error: FmuError, action: str) -> NoReturn:
        """Raise an error of the FMU again, with the name of the FMU and what was done.

        The messages of the error are added to the log.

        Parameters
        ----------
        error : FmuError
            The error that the FMU or its worker raised.
        action : str
            The action that failed, such as "the start".
        """
        for message in error.messages:
            self._log.append(("Error", message))
        # other errors are about the caller's request, and their message is complete
        if not isinstance(error, RuntimeError | TimeoutError):
            raise error
        hint = ""
        if action == "the start" and self.description.needs_tool:
            hint = " It declares that it needs its authoring tool on this machine."
        sentence = f"{self.description.label}, {action}: {error.sentence}{hint}"
        raise type(error)(sentence, error.messages, error.time) from error
