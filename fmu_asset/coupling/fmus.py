"""Steps several FMUs as one: exchanges their values in each step, and saves their state.

To `CoupledAsset`, which is an `FmiAsset`, `CoupledFmus` looks like one FMU: a request with the
inputs, a step, a reply with the outputs.
"""

import math
from array import array
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import copy
from itertools import accumulate, pairwise
from typing import NamedTuple, Self, cast

import numpy as np

from fe.runtime.arrays import FloatArray
from fmu_asset.client.blocks import REQUEST_HEAD, Blocks
from fmu_asset.client.instance_host import Host
from fmu_asset.client.reset_trial import InstanceStart, ResetTrial
from fmu_asset.client.saved_state import PackedState
from fmu_asset.client.session import FmiAsset
from fmu_asset.client.units import IDENTITY
from fmu_asset.errors import (
    FmuEndedError,
    FmuError,
    FmuStateError,
    IterationError,
)
from fmu_asset.instances.plan import run_steps
from reporting.words import comma_list

from .schedule import Schedule
from .structure import Endpoint
from .system import (
    SteppedComponent,
    SystemDescription,
)
from .wiring import ConnectedVariable


class CoupledState(PackedState):
    """A saved state of coupled FMUs, whose states follow one another in the body.

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
    """An input of the system: its position in the request, and where it goes."""

    position: int
    port: ConnectedVariable


@contextmanager
def errors_of_component(component: str) -> Iterator[None]:
    """Raise errors of an FMU again with the name of its component in the message."""
    try:
        yield
    except FmuError as error:
        # The time at which one FMU ended its simulation is not the end of the system.
        time = None if isinstance(error, FmuEndedError) else error.time
        sentence = f"component {component}: {error.sentence}"
        raise type(error)(sentence, error.messages, time) from error


class OutputSelection:
    """Selects some outputs of a system, and converts them to the units of their reader.

    Parameters
    ----------
    ports : iterable of ConnectedVariable
        The selected outputs, in order.
    position : mapping of Endpoint to int
        The position of each output among all outputs that are read.
    """

    def __init__(
        self, ports: Iterable[ConnectedVariable], position: Mapping[Endpoint, int]
    ) -> None:
        # Delayed outputs are taken from a second copy of all outputs, behind the first.
        output_count = len(position)
        indices = []
        factors = []
        offsets = []
        is_identity = True
        for port in ports:
            index = position[port.end]
            indices.append(index + output_count if port.delayed else index)
            factors.append(port.conversion.factor)
            offsets.append(port.conversion.offset)
            is_identity = is_identity and port.conversion == IDENTITY
        self._indices = np.array(indices, np.intp)
        self._factors = np.array(factors)
        self._offsets = np.array(offsets)
        self._is_identity = is_identity

    def values(self, outputs: FloatArray, outputs_before: FloatArray) -> FloatArray:
        """Return the selected outputs in the reader's units, given all outputs (O,).

        `outputs_before` are those at the beginning of the step, for delayed connections.
        """
        values: FloatArray = np.concatenate((outputs, outputs_before))[self._indices]
        if self._is_identity:
            return values
        converted: FloatArray = self._factors * values + self._offsets
        return converted


class CoupledFmus(Host):
    """Several FMUs that run as one.

    Parameters
    ----------
    blocks : Blocks
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
        The largest number of times that a step of a cycle of components is made.
    tolerance : float
        The relative change below which the values in a cycle have converged.
    """

    def __init__(
        self,
        blocks: Blocks,
        order: Schedule,
        components: dict[str, SteppedComponent],
        assets: dict[str, FmiAsset],
        *,
        jacobi: bool,
        iterations: int,
        tolerance: float,
    ) -> None:
        self._blocks = blocks
        self._system = cast("SystemDescription", blocks.description)
        self._schedule = order
        self._components = components
        self._jacobi = jacobi
        self.iterations = iterations
        self._tolerance = tolerance
        self.reset_trial = ResetTrial(comparable=False)
        # where each input of the request goes
        self._inputs: list[_SystemInput] = []
        for position, variable in enumerate(blocks.request.layout.variables, start=REQUEST_HEAD):
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
        read_variables = blocks.reply.layout.variables
        shown_ports = [self._system.ends[variable.name][0] for variable in read_variables]
        self._shown_outputs = OutputSelection(shown_ports, position_of_end)
        self._attach(assets)

    def _attach(self, assets: dict[str, FmiAsset]) -> None:
        """Take FMUs that have not exchanged anything yet."""
        self.assets = assets
        value_count = REQUEST_HEAD + len(self._blocks.request.layout.variables)
        self._request = memoryview(bytearray(8 * value_count)).cast("d")
        self._reply = np.zeros(len(self._blocks.reply.layout.variables))
        self._held_inputs: dict[str, dict[str, float]] = {}
        # outputs now, at the beginning of the last step, and at the beginning of the step before it
        self._outputs = np.zeros(len(self._output_ends))
        self._outputs_before = self._outputs.copy()
        self._outputs_two_steps_before = self._outputs_before
        self._stepped: set[str] = set()
        self._at_different_times = False

    # ------------------------------------------------------------------ life

    @property
    def request(self) -> "memoryview[float]":
        """Time, step size and inputs of the system."""
        return self._request

    @property
    def reply(self) -> FloatArray:
        """The outputs of the system that are read."""
        return self._reply

    @property
    def lost(self) -> bool:
        """False: a component replaces what it has lost."""
        return False

    @property
    def log(self) -> tuple[tuple[str, str], ...]:
        """The last messages of the FMUs: status, and component with text."""
        messages = []
        for name, asset in self.assets.items():
            for status, text in asset.log:
                messages.append((status, f"{name}: {text}"))
        return tuple(messages)

    def note_errors(self, messages: Iterable[str]) -> None:
        """Leave the log to the components, which have noted their errors."""

    @property
    def worker(self) -> None:
        """None: each component has its own worker."""

    def renew(self) -> None:
        """End the workers; the next start has new ones."""
        self.close()

    def sibling(self) -> Self:
        """Return the same system with FMUs of its own."""
        sibling = copy(self)
        sibling._attach({name: asset.sibling() for name, asset in self.assets.items()})
        return sibling

    def close(self) -> None:
        """End all workers; the next start has new ones."""
        for asset in self.assets.values():
            asset.close()

    def start(self, start: InstanceStart, *, renewed: bool = False) -> None:
        """Initialise the components in order, each with the initial outputs of its predecessors.

        An input whose source comes later starts at the FMU's own start value. The components have
        the start time from their bindings, and decide themselves whether they need new instances.
        """
        self._request[:] = array("d", start.request)
        parameters_of = self._system.settings_of_components(start.settings)
        self._held_inputs = {
            name: dict(component.constants) for name, component in self._components.items()
        }
        if start.with_inputs:
            self._hold_inputs()
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
        """Step all components once, in the order of the schedule.

        The request has the time, the step size and the inputs of the system. A group is a component
        alone, or a cycle of components, whose step may be iterated. With Jacobi's method a
        component takes the outputs that the others had before the step, else the latest ones.
        """
        if self._at_different_times:
            raise FmuStateError(
                "A step or a restoration failed, and the FMUs no longer stand at the same time; "
                "reset the asset or restore a state."
            )
        self._hold_inputs()
        self._outputs_two_steps_before = self._outputs_before
        self._outputs_before = self._outputs.copy()
        self._stepped.clear()
        self._at_different_times = True
        for group in self._schedule.groups:
            if self.iterations > 1 and group in self._schedule.cycles:
                self._iterate(group)
            else:
                self._step_group(group, self._outputs_before if self._jacobi else self._outputs)
        self._at_different_times = False
        self.read()

    def run(
        self, requests: FloatArray, replies: FloatArray, report: Callable[[int], object]
    ) -> None:
        """Make many steps; stop after one whose outputs are not all finite."""
        request = np.asarray(self._request)
        run_steps(self.step, requests, replies, report, request=request, reply=self._reply)

    def read(self) -> None:
        """Write the present outputs to the reply."""
        self._reply[:] = self._shown_outputs.values(self._outputs, self._outputs_before)

    def save(self) -> bytes:
        """Return the states of the components with the values that they have exchanged."""
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
        """Restore a state that `save` returned."""
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

    # ------------------------------------------------------------------ stepping

    def _hold_inputs(self) -> None:
        """Convert the inputs in the request for the components; NaN means that nobody gave one."""
        for position, port in self._inputs:
            value = self._request[position]
            if not math.isnan(value):
                inputs = self._held_inputs[port.end.component]
                inputs[port.end.variable] = port.conversion.to_fmu(value)

    def _step_group(self, group: Sequence[str], source_outputs: FloatArray) -> None:
        """Step components one after the other.

        `source_outputs` (O,) feed them: the current outputs, which change on the way
        (Gauss-Seidel), or those before the step (Jacobi).
        """
        for name in group:
            component, asset = self._components[name], self.assets[name]
            inputs = self._held_inputs[name]
            fed_values = self._fed_values(component, source_outputs, self._outputs_before)
            with errors_of_component(name):
                if component.linear:
                    start_values = self._interpolation_starts(component, fed_values, source_outputs)
                    asset.hold(load=start_values)
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
        """Return the values of a component's fed inputs by name, given all outputs (O,).

        `outputs_before` are those at the beginning of the step, for delayed connections.
        """
        values = self._fed_outputs[component.name].values(outputs, outputs_before)
        return dict(zip(component.fed, values.tolist(), strict=True))

    def _interpolation_starts(
        self, component: SteppedComponent, fed_values: dict[str, float], source_outputs: FloatArray
    ) -> dict[str, float]:
        """Return the values of a component's fed inputs at the beginning of an interpolated step.

        A source that has not been stepped yet has no value at the end of the step. It is
        extrapolated linearly from the step before, within the range of the input, and replaces the
        one in `fed_values`.
        """
        start_values = self._fed_values(component, self._outputs_before, self._outputs_before)
        previous_starts = self._fed_values(
            component, self._outputs_two_steps_before, self._outputs_two_steps_before
        )
        for variable, source in component.fed.items():
            if variable not in component.moving:
                start_values[variable] = fed_values[variable]
                continue
            source_is_stepped = source.end.component in self._stepped
            if source.delayed or source_outputs is self._outputs_before or not source_is_stepped:
                low, high = self.assets[component.name].input_range("load", variable)
                extrapolated = 2.0 * start_values[variable] - previous_starts[variable]
                fed_values[variable] = min(max(extrapolated, low), high)
        return start_values

    def _iterate(self, group: Sequence[str]) -> None:
        """Repeat the step of a cycle of components until the exchanged values have converged.

        An `IterationError` is raised if they have not converged after `iterations` steps.
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
        time = self._request[0]
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
