"""`CoupledAsset`: several FMUs flown as one `FmiAsset`; what they exchange in a step, and their state."""

import ctypes
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import copy
from itertools import accumulate, pairwise
from typing import Literal, Self, cast

import numpy as np

from fe.runtime.arrays import FloatArray
from fmu_asset.client.binding import Binding
from fmu_asset.client.exchange import Exchange
from fmu_asset.client.instance_host import InstanceHost
from fmu_asset.client.reset_trial import InstanceStart, ResetTrial
from fmu_asset.client.saved_state import PackedState
from fmu_asset.client.session import FmiAsset
from fmu_asset.client.units import IDENTITY
from fmu_asset.client.values import Values
from fmu_asset.errors import (
    BindingError,
    CouplingError,
    FmuEndedError,
    FmuError,
    FmuStateError,
    IterationError,
    said,
)
from fmu_asset.instances.plan import InitialValues, Instance

from .structure import Endpoint, SystemStructure
from .system import Part, SystemDescription, parts_of, system_description, wiring_hash
from .wiring import ConnectedVariable, Schedule, Wiring, loop_sentence

Algorithm = Literal["gauss_seidel", "jacobi"]
ALGORITHMS: tuple[Algorithm, ...] = ("gauss_seidel", "jacobi")


class CoupledState(PackedState):
    """A saved state of coupled FMUs; its body holds the states of the components, one behind the other."""

    magic = b"UAVSYSTM"
    what = "coupled FMUs"

    held: dict[str, dict[str, float]]
    outputs: list[float]
    before: list[float]
    sizes: list[int]

    @property
    def components(self) -> list[bytes]:
        """States of the components; raises `FmuStateError` if the body is damaged."""
        ends = list(accumulate(self.sizes, initial=0))
        if ends[-1] != len(self.body):
            raise FmuStateError(f"What was given is not a state of {self.what}, or it is damaged.")
        return [self.body[begin:end] for begin, end in pairwise(ends)]


class Taps:
    """Outputs that are wanted together, in the units of who wants them.

    Parameters
    ----------
    ports : iterable of ConnectedVariable
        The outputs, in order.
    place : mapping of Endpoint to int
        Where each output stands among all that are read.
    """

    def __init__(self, ports: Iterable[ConnectedVariable], place: Mapping[Endpoint, int]) -> None:
        wanted = list(ports)
        self._index = np.array([place[port.end] + port.delayed * len(place) for port in wanted], np.intp)
        scales = np.array([port.conversion for port in wanted]).reshape(-1, 2)
        self._scale = None if (scales == IDENTITY).all() else (scales[:, 0], scales[:, 1])

    def of(self, now: FloatArray, before: FloatArray) -> FloatArray:
        """Return the values, from all outputs of this moment and of the beginning of the step."""
        values = np.concatenate((now, before))[self._index]
        return values if self._scale is None else self._scale[0] * values + self._scale[1]


@contextmanager
def naming(component: str) -> Iterator[None]:
    """Give an error of an FMU the name of its component."""
    try:
        yield
    except FmuError as error:
        # Where one of them ended is no moment of the system.
        time = None if isinstance(error, FmuEndedError) else error.time
        sentence = f"component {component}: {error.sentence}"
        raise type(error)(sentence, error.messages, time) from error


class CoupledFmus(InstanceHost):
    """Several FMUs as one instance, and where it lives: what `FmiAsset` asks of an instance and its housing.

    Parameters
    ----------
    exchange : Exchange
        What a request and a reply hold of the system as one FMU.
    order : Schedule
        The order of the components.
    parts : dict of str to Part
        The components, by name.
    assets : dict of str to FmiAsset
        Their FMUs.
    jacobi : bool
        Whether all components take the outputs of the beginning of the step.
    iterations : int
        How often a step of a circle of components may be made.
    tolerance : float
        When the values in a circle have settled.
    """

    lost = False

    def __init__(
        self, exchange: Exchange, order: Schedule, parts: dict[str, Part], assets: dict[str, FmiAsset],
        *, jacobi: bool, iterations: int, tolerance: float,
    ) -> None:  # fmt: skip
        self._exchange, self._schedule, self._parts = exchange, order, parts
        self._jacobi, self.iterations, self._tolerance = jacobi, iterations, tolerance
        self._system = cast("SystemDescription", exchange.description)
        ends = self._system.ends
        self.reset_trial = ResetTrial(comparable=False)
        self._inputs = [(n, port) for n, sent in enumerate(exchange.sent, 2) for port in ends[sent.name]]
        self._ends = [end for part in parts.values() for end in part.ends]
        place = {end: index for index, end in enumerate(self._ends)}
        self._spans = {
            name: slice(place[part.ends[0]], place[part.ends[-1]] + 1) for name, part in parts.items()
        }
        self._taps = {name: Taps(part.fed.values(), place) for name, part in parts.items()}
        self._shown = Taps((ends[read.name][0] for read in exchange.read), place)
        self._begin(assets)

    def _begin(self, assets: dict[str, FmiAsset]) -> None:
        """Take the FMUs, which have exchanged nothing."""
        self.instance: Instance | None = self
        self.assets = assets
        self.request = (ctypes.c_double * (2 + len(self._exchange.sent)))()
        self.reply = (ctypes.c_double * len(self._exchange.read))()
        self._answer = np.frombuffer(memoryview(self.reply).cast("B"))
        self._held: dict[str, dict[str, float]] = {}
        self._now = np.zeros(len(self._ends))
        self._before = self._earlier = self._now.copy()
        self._stepped: set[str] = set()
        self._broken = False

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
        other = copy(self)
        other._begin({name: asset.sibling() for name, asset in self.assets.items()})
        return other

    def close(self) -> None:
        """End all workers; the next start has new ones."""
        for asset in self.assets.values():
            asset.close()

    # ------------------------------------------------------------------ what an asset asks

    def initialise(self, start_time: float, parameters: InitialValues, with_inputs: bool) -> None:
        """Initialise the components in their order; each takes the initial outputs of those before it.

        An input whose source comes later starts at the FMU's own start value.
        """
        tuned = self._system.of_components(parameters)
        self._held = {name: dict(part.constants) for name, part in self._parts.items()}
        if with_inputs:
            self._take()
        self._broken = True
        known: set[str] = set()
        for name in self._schedule.order:
            part, asset = self._parts[name], self.assets[name]
            values = self._fed(part, self._now, self._now)
            fed = {key: values[key] for key, port in part.fed.items() if port.end.component in known}
            with naming(name):
                asset.reset({**part.settings, **tuned.get(name, {})}, load=(self._held[name] | fed) or None)
                self._now[self._spans[name]] = asset.observe().values
            known.add(name)
        self._before = self._now.copy()
        self._broken = False

    def step(self) -> None:
        """Make the step that the request block describes."""
        if self._broken:
            raise FmuStateError(said("coupling.apart"))
        self._take()
        self._earlier, self._before = self._before, self._now.copy()
        self._stepped.clear()
        self._broken = True
        for group in self._schedule.groups:
            if self.iterations > 1 and group in self._schedule.circles:
                self._iterate(group)
            else:
                self._pass(group, self._before if self._jacobi else self._now)
        self._broken = False
        self.read()

    run = Instance.run

    def read(self) -> None:
        """Put the outputs of this moment into the reply block."""
        self._answer[:] = self._shown.of(self._now, self._before)

    def save(self) -> bytes:
        """Return the states of the components and what they had exchanged."""
        states = [asset.save_state() for asset in self.assets.values()]
        return CoupledState(
            held={name: dict(sorted(held.items())) for name, held in self._held.items()},
            outputs=self._now.tolist(),
            before=self._before.tolist(),
            sizes=[len(state) for state in states],
            body=b"".join(states),
        ).to_bytes()

    def restore(self, content: bytes) -> None:
        """Bring the components to a state that `save` returned."""
        saved = CoupledState.from_bytes(content)
        components = saved.components
        self._broken = True
        for (name, asset), state in zip(self.assets.items(), components, strict=True):
            with naming(name):
                asset.restore_state(state)
        self._held = saved.held
        self._now, self._before = np.array(saved.outputs), np.array(saved.before)
        self._broken = False

    def take_log(self) -> list[tuple[int, str]]:
        """Return nothing: each component keeps its own log."""
        return []

    # ------------------------------------------------------------------ stepping

    def _take(self) -> None:
        """Hand on the inputs of the request; one that nobody has given is not a number."""
        for place, port in self._inputs:
            value = self.request[place]
            if not math.isnan(value):
                self._held[port.end.component][port.end.variable] = port.conversion.to_fmu(value)

    def _pass(self, group: Sequence[str], source: FloatArray) -> None:
        for name in group:
            part, asset, held = self._parts[name], self.assets[name], self._held[name]
            fed = self._fed(part, source, self._before)
            with naming(name):
                if part.linear:
                    asset.hold(load=self._draw(part, fed, source))
                held.update(fed)
                seen = asset.step(load=held)
                for _ in range(part.substeps - 1):
                    seen = asset.step()
            self._now[self._spans[name]] = seen.values
            if source is self._now:
                self._stepped.add(name)
        self._stepped.update(group)

    def _fed(self, part: Part, now: FloatArray, before: FloatArray) -> dict[str, float]:
        """Return what the inputs of a component are fed, by their names."""
        return dict(zip(part.fed, self._taps[part.name].of(now, before).tolist(), strict=True))

    def _draw(self, part: Part, fed: dict[str, float], source: FloatArray) -> dict[str, float]:
        """Return where the lines of the inputs that others feed begin; `fed` becomes where they end.

        Where the source is not there yet, its last line goes on, within the range of the input.
        """
        begins = self._fed(part, self._before, self._before)
        earlier = self._fed(part, self._earlier, self._earlier)
        for variable, port in part.fed.items():
            if variable not in part.moving:
                begins[variable] = fed[variable]
            elif port.delayed or source is self._before or port.end.component not in self._stepped:
                low, high = self.assets[part.name].input_range("load", variable)
                end = 2.0 * begins[variable] - earlier[variable]
                fed[variable] = min(max(end, low), high)
        return begins

    def _iterate(self, group: Sequence[str]) -> None:
        """Repeat the step of a circle of components until what they exchange has settled."""
        states = {name: self.assets[name].save_state() for name in group}
        exchanged = {port.end for name in group for port in self._parts[name].fed.values()}
        watched = [i for i, end in enumerate(self._ends) if end in exchanged and end.component in group]
        for iteration in range(self.iterations):
            last = self._now.copy()
            if iteration:
                for name, state in states.items():
                    with naming(name):
                        self.assets[name].restore_state(state)
            self._pass(group, last if self._jacobi else self._now)
            change = np.abs(self._now - last)[watched]
            if iteration and (change <= self._tolerance * np.maximum(1.0, np.abs(last[watched]))).all():
                return
        worst = int(np.argmax(change))
        left = self._ends[watched[worst]], change[worst]
        raise IterationError(said("coupling.unsettled", self=self, group=group, left=left))


class CoupledAsset(FmiAsset):
    """Several FMUs that are flown step by step as one asset, through a binding.

    The step size of the binding is that of the system: outputs are exchanged once a step. With
    ``"gauss_seidel"`` each component takes the newest outputs of those that were stepped before it, in the
    order of `schedule`; with ``"jacobi"`` all take the outputs of the beginning of the step. With more than
    one iteration, components that are connected in a circle repeat the step until what they exchange has
    settled.

    After a step that failed, the components no longer stand at the same time: reset the asset or restore a
    state of it. Where an FMU ends its simulation, `simulate` ends with the step before.

    Parameters
    ----------
    structure : SystemStructure or Wiring
        The system.
    binding : Binding
        Its variables are connectors of the system, or `component.variable`.
    algorithm : {"gauss_seidel", "jacobi"}
        How values are passed on within a step.
    iterations : int
        Largest number of times that a step of a circle of components is made.
    tolerance : float
        A circle has settled when no value exchanged in it changes by more than this times the larger of one
        and its magnitude.
    isolated : bool
        Whether each FMU runs in a worker process of its own.
    step_timeout : float, optional
        Wall-clock limit of one step of one FMU [s], instead of the binding's.
    parameters : mapping of str to float, optional
        Parameters by the binding's names and in its units.

    Raises
    ------
    CouplingError
        If the system cannot be joined, or has an algebraic loop, and the algorithm is Gauss-Seidel without
        iterations.
    BindingError
        If the binding does not fit.
    FmuFileError, FmuUnsupportedError
        If an FMU cannot be used.
    """

    def __init__(
        self,
        structure: SystemStructure | Wiring,
        binding: Binding,
        *,
        algorithm: Algorithm = "gauss_seidel",
        iterations: int = 1,
        tolerance: float = 1e-9,
        isolated: bool = True,
        step_timeout: float | None = None,
        parameters: Values | None = None,
    ) -> None:
        if algorithm not in ALGORITHMS:
            raise CouplingError(said("coupling.algorithm", known=ALGORITHMS, algorithm=algorithm))
        if iterations < 1 or not (tolerance > 0.0 and math.isfinite(tolerance)):
            raise CouplingError(said("coupling.iterations", iterations=iterations, tolerance=tolerance))
        self._wiring = wiring = structure if isinstance(structure, Wiring) else Wiring(structure)
        if binding.binding.decimation != 1:
            raise BindingError(said("coupling.decimation", binding=binding))
        jacobi, plan = algorithm == "jacobi", wiring.schedule
        if plan.loops and iterations == 1 and not jacobi:  # Jacobi delays every connection
            raise CouplingError(loop_sentence(plan.loops))
        system = system_description(wiring, wiring_hash(wiring, binding, algorithm, iterations, tolerance))
        # Lines are drawn at the components.
        exchange = Exchange(system, binding.with_header(interpolation="zero-order"))
        if exchange.health_slots:
            names = ", ".join(exchange.health_slots)
            raise BindingError(
                f"The binding {binding.name} has the health {names}, which the system "
                f"{wiring.structure.name} takes at its start only; in a system a health must be an input "
                "or, in co-simulation, a tunable parameter."
            )
        parts = parts_of(wiring, exchange, linear=binding.binding.interpolation == "linear")
        tuned = system.of_components(exchange.settings(parameters or {}))
        assets = {}
        for name, part in parts.items():
            with naming(name):
                assets[name] = FmiAsset(
                    wiring.declared[name],
                    part.binding,
                    isolated=isolated,
                    step_timeout=step_timeout,
                    parameters={**part.settings, **tuned.get(name, {})},
                )
        for name in (name for group in plan.circles if iterations > 1 for name in group):
            if assets[name].state_method != "serialised":
                raise CouplingError(said("coupling.no_state", name=name))
        housing = CoupledFmus(
            exchange, plan, parts, assets, jacobi=jacobi, iterations=iterations, tolerance=tolerance
        )
        self._parts = parts
        self._set_up(exchange, housing, parameters or {})

    @property
    def schedule(self) -> Schedule:
        """Order of the components."""
        return self._wiring.schedule

    @property
    def log(self) -> tuple[tuple[str, str], ...]:
        """The last messages of the FMUs: status, and component with text."""
        return tuple(
            (status, f"{name}: {text}")
            for name, asset in cast("CoupledFmus", self._host).assets.items()
            for status, text in asset.log
        )
