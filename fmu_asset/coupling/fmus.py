"""Several FMUs as one instance: what they exchange in a step, and their state.

To `CoupledAsset`, which is an `FmiAsset`, `CoupledFmus` looks like the instance of one FMU: a
request block with the inputs, a step, a reply block with the outputs.
"""

import ctypes
import math
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from copy import copy
from itertools import accumulate, pairwise
from typing import NamedTuple, Self, cast

import numpy as np

from fe.runtime.arrays import FloatArray
from fmu_asset.client.exchange import Exchange
from fmu_asset.client.instance_host import InstanceHost
from fmu_asset.client.reset_trial import InstanceStart, ResetTrial
from fmu_asset.client.saved_state import PackedState
from fmu_asset.client.session import FmiAsset
from fmu_asset.errors import (
    FmuEndedError,
    FmuError,
    FmuStateError,
    IterationError,
)
from fmu_asset.instances.plan import REPORT_PERIOD, InitialValues, Instance
from reporting.words import comma_list

from .outputs import OutputSelection
from .schedule import Schedule
from .structure import Endpoint
from .system import (
    SteppedComponent,
    SystemDescription,
)
from .wiring import ConnectedVariable

_REQUEST_HEAD = 2
"""Values of a request block before its inputs: time and step size."""


class CoupledState(PackedState):
    """A saved state of coupled FMUs; its body holds the states of the components in their order.

    Attributes
    ----------
    held : dict of str to dict of str to float
        The inputs of each component, in the FMU's units.
    outputs, before : list of float
        All outputs that are read, now and at the beginning of the last step.
    sizes : list of int
        The length of each component's state [bytes].
    """

    magic = b"UAVSYSTM"
    what = "coupled FMUs"

    held: dict[str, dict[str, float]]
    outputs: list[float]
    before: list[float]
    sizes: list[int]

    @property
    def components(self) -> list[bytes]:
        """States of the components; raises `FmuStateError` if the body is damaged."""
        limits = list(accumulate(self.sizes, initial=0))
        if limits[-1] != len(self.body):
            raise FmuStateError(f"What was given is not a state of {self.what}, or it is damaged.")
        return [self.body[begin:end] for begin, end in pairwise(limits)]


class _SystemInput(NamedTuple):
    """An input of the system: its position in the request block, and where it goes."""

    position: int
    port: ConnectedVariable


@contextmanager
def errors_of_component(component: str) -> Iterator[None]:
    """Give errors of an FMU the name of its component."""
    try:
        yield
    except FmuError as error:
        # The time at which one FMU ended its simulation is not the end of the system.
        time = None if isinstance(error, FmuEndedError) else error.time
        sentence = f"component {component}: {error.sentence}"
        raise type(error)(sentence, error.messages, time) from error


class CoupledFmus(InstanceHost):
    """Several FMUs as one instance, and as its own housing, as `FmiAsset` needs them.

    Parameters
    ----------
    exchange : Exchange
        The request and reply of the system as one FMU.
    order : Schedule
        The order of the components.
    components : dict of str to SteppedComponent
        The components, by name.
    assets : dict of str to FmiAsset
        The FMUs of the components, by name.
    jacobi : bool
        Whether all components take the outputs at the beginning of the step.
    iterations : int
        The largest number of times that a step of a circle of components is made.
    tolerance : float
        The relative change at which the values in a circle have settled.
    """

    lost = False
    report_period = REPORT_PERIOD

    def __init__(
        self,
        exchange: Exchange,
        order: Schedule,
        components: dict[str, SteppedComponent],
        assets: dict[str, FmiAsset],
        *,
        jacobi: bool,
        iterations: int,
        tolerance: float,
    ) -> None:
        self._exchange = exchange
        self._system = cast("SystemDescription", exchange.description)
        self._schedule = order
        self._components = components
        self._jacobi = jacobi
        self.iterations = iterations
        self._tolerance = tolerance
        self.reset_trial = ResetTrial(comparable=False)
        # where each input of the request goes
        self._inputs: list[_SystemInput] = []
        for position, variable in enumerate(exchange.sent, start=_REQUEST_HEAD):
            for port in self._system.ends[variable.name]:
                self._inputs.append(_SystemInput(position, port))
        # all outputs that are read, one component after the other
        self._output_ends: list[Endpoint] = []
        self._output_slices: dict[str, slice] = {}
        for name, component in components.items():
            begin = len(self._output_ends)
            self._output_ends += component.ends
            self._output_slices[name] = slice(begin, len(self._output_ends))
        position_of_end = {end: index for index, end in enumerate(self._output_ends)}
        # who takes which of them
        self._fed_outputs = {
            name: OutputSelection(component.fed.values(), position_of_end)
            for name, component in components.items()
        }
        shown_ports = [self._system.ends[variable.name][0] for variable in exchange.read]
        self._shown_outputs = OutputSelection(shown_ports, position_of_end)
        self._begin(assets)

    def _begin(self, assets: dict[str, FmiAsset]) -> None:
        """Take FMUs that have not exchanged anything yet."""
        self.instance: Instance | None = self
        self.assets = assets
        self.request = (ctypes.c_double * (_REQUEST_HEAD + len(self._exchange.sent)))()
        self.reply = (ctypes.c_double * len(self._exchange.read))()
        self._reply_array = np.frombuffer(memoryview(self.reply).cast("B"))
        self._held_inputs: dict[str, dict[str, float]] = {}
        # outputs now, at the beginning of the last step, and at the beginning of the step before it
        self._outputs = np.zeros(len(self._output_ends))
        self._outputs_before = self._outputs.copy()
        self._outputs_two_before = self._outputs_before
        self._stepped: set[str] = set()
        self._at_different_times = False

    # ------------------------------------------------------------------ life

    def start(self, start: InstanceStart, *, renewed: bool = False) -> Self:
        """Bring the components to their start."""
        start.initialise(self)
        return self

    def replace_if_contradicted(self, request: bytes, reply: FloatArray) -> None:
        """Leave it to the components whether they began where they should."""

    def renew(self) -> Instance:
        """End the workers; the next start has new ones."""
        self.close()
        return self

    def reset(self) -> None:
        """Leave it to `initialise`, which resets the components."""

    def sibling(self) -> "CoupledFmus":
        """Return the same system with FMUs of its own."""
        sibling = copy(self)
        sibling._begin({name: asset.sibling() for name, asset in self.assets.items()})
        return sibling

    def close(self) -> None:
        """End all workers; the next start has new ones."""
        for asset in self.assets.values():
            asset.close()

    # ------------------------------------------------------------------ the interface of an
    # instance

    def initialise(self, start_time: float, parameters: InitialValues, with_inputs: bool) -> None:
        """Initialise the components in order, each with the initial outputs of its predecessors.

        An input whose source comes later starts at the FMU's own start value.

        Parameters
        ----------
        start_time : float
            Ignored: the components have it from their bindings.
        parameters : InitialValues
            Parameters of the system, by value reference.
        with_inputs : bool
            Whether the inputs in the request block hold already.
        """
        parameters_of = self._system.settings_of_components(parameters)
        self._held_inputs = {
            name: dict(component.constants) for name, component in self._components.items()
        }
        if with_inputs:
            self._take_inputs()
        self._at_different_times = True
        initialised: set[str] = set()
        for name in self._schedule.order:
            component, asset = self._components[name], self.assets[name]
            fed_values = self._fed_values(component, self._outputs, self._outputs)
            load = dict(self._held_inputs[name])
            for variable, source in component.fed.items():
                if source.end.component in initialised:
                    load[variable] = fed_values[variable]
            with errors_of_component(name):
                asset.reset(
                    {**component.settings, **parameters_of.get(name, {})}, load=load or None
                )
                self._outputs[self._output_slices[name]] = asset.observe().values
            initialised.add(name)
        self._outputs_before = self._outputs.copy()
        self._at_different_times = False

    def step(self) -> None:
        """Make the step that the request block describes."""
        if self._at_different_times:
            raise FmuStateError(
                "A step or a restoration failed, and the FMUs no longer stand at the same time; "
                "reset the asset or restore a state."
            )
        self._take_inputs()
        self._outputs_two_before = self._outputs_before
        self._outputs_before = self._outputs.copy()
        self._stepped.clear()
        self._at_different_times = True
        for group in self._schedule.groups:
            if self.iterations > 1 and group in self._schedule.circles:
                self._iterate(group)
            else:
                self._step_group(group, self._outputs_before if self._jacobi else self._outputs)
        self._at_different_times = False
        self.read()

    run = Instance.run

    def read(self) -> None:
        """Put the current outputs into the reply block."""
        self._reply_array[:] = self._shown_outputs.values(self._outputs, self._outputs_before)

    def save(self) -> bytes:
        """Return the states of the components and the values that they had exchanged."""
        states = [asset.save_state() for asset in self.assets.values()]
        held_inputs = {
            name: dict(sorted(inputs.items())) for name, inputs in self._held_inputs.items()
        }
        state = CoupledState(
            held=held_inputs,
            outputs=self._outputs.tolist(),
            before=self._outputs_before.tolist(),
            sizes=[len(state) for state in states],
            body=b"".join(states),
        )
        return state.to_bytes()

    def restore(self, content: bytes) -> None:
        """Bring the components to a state that `save` returned."""
        saved_state = CoupledState.from_bytes(content)
        component_states = saved_state.components
        self._at_different_times = True
        for (name, asset), state in zip(self.assets.items(), component_states, strict=True):
            with errors_of_component(name):
                asset.restore_state(state)
        self._held_inputs = saved_state.held
        self._outputs = np.array(saved_state.outputs)
        self._outputs_before = np.array(saved_state.before)
        self._at_different_times = False

    def take_log(self) -> list[tuple[int, str]]:
        """Return no messages: each component keeps its own log."""
        return []

    # ------------------------------------------------------------------ stepping

    def _take_inputs(self) -> None:
        """Hand on the inputs in the request block; NaN stands for one that nobody has given."""
        for position, port in self._inputs:
            value = self.request[position]
            if not math.isnan(value):
                inputs = self._held_inputs[port.end.component]
                inputs[port.end.variable] = port.conversion.to_fmu(value)

    def _step_group(self, group: Sequence[str], source_outputs: FloatArray) -> None:
        """Step components one after the other.

        Parameters
        ----------
        group : sequence of str
            The components.
        source_outputs : (O,) array
            The outputs that feed them: the current ones (Gauss-Seidel), which change on the way, or
            others (Jacobi).
        """
        for name in group:
            component, asset = self._components[name], self.assets[name]
            inputs = self._held_inputs[name]
            fed_values = self._fed_values(component, source_outputs, self._outputs_before)
            with errors_of_component(name):
                if component.linear:
                    line_begins = self._begin_lines(component, fed_values, source_outputs)
                    asset.hold(load=line_begins)
                inputs.update(fed_values)
                observation = asset.step(load=inputs)
                for _ in range(component.substeps - 1):
                    observation = asset.step()
            self._outputs[self._output_slices[name]] = observation.values
            if source_outputs is self._outputs:
                self._stepped.add(name)
        self._stepped.update(group)

    def _fed_values(
        self, component: SteppedComponent, outputs: FloatArray, outputs_before: FloatArray
    ) -> dict[str, float]:
        """Return the values that feed the inputs of a component, by the inputs' names.

        Parameters
        ----------
        component : SteppedComponent
            The component of the coupled system.
        outputs, outputs_before : (O,) array
            All outputs, now and at the beginning of the step.
        """
        values = self._fed_outputs[component.name].values(outputs, outputs_before)
        return dict(zip(component.fed, values.tolist(), strict=True))

    def _begin_lines(
        self, component: SteppedComponent, fed_values: dict[str, float], source_outputs: FloatArray
    ) -> dict[str, float]:
        """Return where the straight lines of a component's fed inputs begin.

        Where a source has not been stepped yet, the line of the step before goes on, within the
        range of the input; its end then takes the place of the value in `fed_values`.

        Parameters
        ----------
        component : SteppedComponent
            The component of the coupled system.
        fed_values : dict of str to float
            The ends of the lines by input; changed by this call.
        source_outputs : (O,) array
            The outputs that the ends come from.

        Returns
        -------
        dict of str to float
            The begins of the lines by input.
        """
        begins = self._fed_values(component, self._outputs_before, self._outputs_before)
        earlier_begins = self._fed_values(
            component, self._outputs_two_before, self._outputs_two_before
        )
        for variable, source in component.fed.items():
            if variable not in component.moving:
                begins[variable] = fed_values[variable]
                continue
            source_is_stepped = source.end.component in self._stepped
            if source.delayed or source_outputs is self._outputs_before or not source_is_stepped:
                low, high = self.assets[component.name].input_range("load", variable)
                extrapolated = 2.0 * begins[variable] - earlier_begins[variable]
                fed_values[variable] = min(max(extrapolated, low), high)
        return begins

    def _iterate(self, group: Sequence[str]) -> None:
        """Repeat the step of a circle of components until the exchanged values have converged.

        Raises
        ------
        IterationError
            If they have not after `iterations` steps.
        """
        begin_states = {name: self.assets[name].save_state() for name in group}
        exchanged = self._exchanged_in(group)
        for iteration in range(self.iterations):
            previous_outputs = self._outputs.copy()
            if iteration > 0:
                for name, state in begin_states.items():
                    with errors_of_component(name):
                        self.assets[name].restore_state(state)
            self._step_group(group, previous_outputs if self._jacobi else self._outputs)
            change = np.abs(self._outputs - previous_outputs)[exchanged]
            magnitude = np.maximum(1.0, np.abs(previous_outputs[exchanged]))
            if iteration > 0 and (change <= self._tolerance * magnitude).all():
                return
        worst = int(np.argmax(change))
        worst_end = self._output_ends[exchanged[worst]]
        time = self.request[0]
        raise IterationError(
            f"The components {comma_list(group)} did not settle in {self.iterations} iterations of "
            f"the step from t = {time:g} s ({worst_end} still changes by {change[worst]:.3g}); "
            "allow more iterations or a larger tolerance, make the step smaller, or delay one of "
            "their connections."
        )

    def _exchanged_in(self, group: Collection[str]) -> list[int]:
        """Return the positions of the outputs that components of a group pass to each other."""
        sources: set[Endpoint] = set()
        for name in group:
            sources.update(port.end for port in self._components[name].fed.values())
        positions = []
        for position, end in enumerate(self._output_ends):
            if end in sources and end.component in group:
                positions.append(position)
        return positions
