"""`CoupledAsset`: several FMUs flown as one, with the face of `FmiAsset`."""

import math
import operator
from collections.abc import Mapping, Sequence
from typing import Any, Literal, Unpack

import numpy as np

from fmu_asset.door.binding import Binding
from fmu_asset.door.exchange import Inputs, Values, check_roles
from fmu_asset.door.reading import Observation, ObservationHistory
from fmu_asset.door.session import FmiAsset
from fmu_asset.door.simulation import SteppedAsset
from fmu_asset.errors import (
    AlgebraicLoopError,
    BindingError,
    CouplingError,
    FmuEndedError,
    FmuError,
    FmuInputError,
    FmuStateError,
    IterationError,
)
from reporting.progress import Progress, SilentProgress

from .layout import FloatArray, Part, Taps, naming, parts_of
from .roles import parameter_values, resolve_roles
from .saved import CoupledState, wiring_hash
from .schedule import Schedule, loop_sentence
from .structure import SystemStructure, listed
from .wiring import Wiring

Algorithm = Literal["gauss_seidel", "jacobi"]
ALGORITHMS: tuple[Algorithm, ...] = ("gauss_seidel", "jacobi")


class CoupledAsset(SteppedAsset):
    """Several FMUs that are flown step by step as one asset, through a binding.

    The step size of the binding is that of the system: outputs are exchanged once a step. With
    ``"gauss_seidel"`` each component takes the newest outputs of those that were stepped before it, in the
    order of `schedule`; with ``"jacobi"`` all take the outputs of the beginning of the step. With more than
    one iteration, components that are connected in a circle repeat the step until what they exchange has
    settled.

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
        If the system cannot be joined.
    AlgebraicLoopError
        If it has an algebraic loop, and the algorithm is Gauss-Seidel without iterations.
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
            raise CouplingError(f"The algorithm must be one of {listed(ALGORITHMS)}, and {algorithm!r} came.")
        if iterations < 1 or not (tolerance > 0.0 and math.isfinite(tolerance)):
            raise CouplingError(
                f"Iterations must be at least 1 and the tolerance positive; {iterations!r} and "
                f"{tolerance!r} came."
            )
        self._wiring = structure if isinstance(structure, Wiring) else Wiring(structure)
        super().__init__(binding)
        self._jacobi, self._iterations, self._tolerance = algorithm == "jacobi", iterations, tolerance
        loops = self._wiring.schedule.loops
        if loops and iterations == 1 and not self._jacobi:  # Jacobi delays every connection
            raise AlgebraicLoopError(loop_sentence(loops))
        self._roles = resolve_roles(self._wiring, binding)
        self._parts = parts_of(self._wiring, binding, self._roles)
        self._take_parameters(parameters or {})
        self._held = {name: dict(part.constants) for name, part in self._parts.items()}
        self._ends = [end for part in self._parts.values() for end in part.ends]
        place = {end: index for index, end in enumerate(self._ends)}
        self._spans = {
            name: slice(place[part.ends[0]], place[part.ends[-1]] + 1) for name, part in self._parts.items()
        }
        self._taps = {name: Taps(part.fed.values(), place) for name, part in self._parts.items()}
        self._observed = Taps(self._roles.observations, place)
        self._monitored = Taps(self._roles.monitors.values(), place)
        self._now = np.zeros(len(self._ends))
        self._before = self._earlier = self._now.copy()
        self._stepped: set[str] = set()
        self._assets = {
            name: self._open(part, isolated=isolated, step_timeout=step_timeout)
            for name, part in self._parts.items()
        }
        if iterations > 1:
            self._check_restorable()
        self._digest = wiring_hash(self._wiring, binding, algorithm, iterations, tolerance)

    # ------------------------------------------------------------------ what it is

    @property
    def recorded_units(self) -> dict[str, str]:
        """Units of `Observation.extra` by name."""
        return {name: scalar.unit for name, scalar in self._binding.monitor.items()}

    @property
    def wiring(self) -> Wiring:
        """The system, checked."""
        return self._wiring

    @property
    def schedule(self) -> Schedule:
        """Order of the components."""
        return self._wiring.schedule

    @property
    def log(self) -> tuple[tuple[str, str], ...]:
        """The last messages of the FMUs: status, and component with text."""
        return tuple(
            (status, f"{name}: {text}") for name, asset in self._assets.items() for status, text in asset.log
        )

    # ------------------------------------------------------------------ life

    def close(self) -> None:
        """End all workers; the asset can be opened again by `reset`."""
        self._phase = "closed"
        for asset in self._assets.values():
            asset.close()

    def reset(self, parameters: Values | None = None, **inputs: Unpack[Inputs]) -> None:
        """Go back to the start; arguments and errors are those of `FmiAsset.reset`.

        The components are initialised in the order of `schedule`; each takes the initial outputs of those
        before it. An input whose source comes later starts at the FMU's own start value.
        """
        check_roles(inputs)
        if parameters is not None:
            self._take_parameters(parameters)
        self._held = {name: dict(part.constants) for name, part in self._parts.items()}
        self._place(inputs)
        self._phase = "broken"
        known: set[str] = set()
        for name in self.schedule.order:
            part, asset = self._parts[name], self._assets[name]
            values = self._fed(part, self._now, self._now)
            fed = {key: values[key] for key, port in part.fed.items() if port.end.component in known}
            try:
                with naming(name):
                    asset.reset(self._settings(part), load=(self._held[name] | fed) or None)
                    self._now[self._spans[name]] = asset.observe().values
            except FmuError:
                self.close()
                raise
            known.add(name)
        self._before = self._now.copy()
        self._index = 0
        self._phase = "ready"

    def step(
        self,
        control: Mapping[str, float] | None = None,
        health: Mapping[str, float] | None = None,
        load: Mapping[str, float] | None = None,
    ) -> Observation:
        """Make one step of the system; arguments and result are those of `FmiAsset.step`.

        After a step that failed, the components no longer stand at the same time: reset the asset or restore
        a state of it.

        Raises
        ------
        FmuError
            As `FmiAsset.step`, with the name of the component.
        IterationError
            If a circle of components does not settle.
        """
        self._opened()
        self._place({"control": control, "health": health, "load": load})
        self._earlier, self._before = self._before, self._now.copy()
        self._stepped.clear()
        self._phase = "broken"
        for group, circular in zip(self.schedule.groups, self.schedule.circular, strict=True):
            if circular and self._iterations > 1:
                self._iterate(group)
            else:
                self._pass(group, self._before if self._jacobi else self._now)
        self._index += 1
        self._phase = "ready"
        return self._observation()

    def observe(self) -> Observation:
        """Return the observation of this moment without a step."""
        self._opened()
        return self._observation()

    def simulate(self, *, steps: int | None = None, progress: Progress | None = None) -> ObservationHistory:
        """Make many steps of the system from where it is, its inputs held.

        Where an FMU ends its simulation, the result ends with the step before and says so in `ended`.

        Parameters
        ----------
        steps : int, optional
            Number of steps N; one if absent.
        progress : Progress, optional
            Where progress is shown.

        Raises
        ------
        FmuInputError
            If `steps` is below 1.
        FmuError
            As `step`.
        """
        count, seen, ended = 1 if steps is None else operator.index(steps), [], ""
        if count < 1:
            raise FmuInputError(f"steps must be at least 1, but is {count}.")
        with (progress or SilentProgress()).stage("Simulating", total=count, unit="steps") as stage:
            for _ in range(count):
                try:
                    seen.append(self.step())
                except FmuEndedError as error:
                    ended = error.sentence
                    break
                stage.advance()
        return ObservationHistory(
            np.array([item.time for item in seen]),
            np.array([item.values for item in seen]).reshape(len(seen), len(self._roles.observations)),
            {name: np.array([item.extra[name] for item in seen]) for name in self._roles.monitors},
            ended,
        )

    # ------------------------------------------------------------------ state

    def save_state(self) -> bytes:
        """Return the state of all components as bytes, for `restore_state` in this or another process.

        Raises
        ------
        FmuStateError
            If the asset is not open.
        """
        if self._phase != "ready":
            raise FmuStateError("There is no state to save before the first reset or step.")
        states = [asset.save_state() for asset in self._assets.values()]
        return CoupledState(
            system=self._digest,
            index=self._index,
            parameters=self._parameters,
            held={name: dict(sorted(held.items())) for name, held in self._held.items()},
            outputs=self._now.tolist(),
            before=self._before.tolist(),
            sizes=[len(state) for state in states],
            body=b"".join(states),
        ).to_bytes()

    def restore_state(self, content: bytes) -> None:
        """Bring the asset to a state that `save_state` returned.

        Raises
        ------
        FmuStateError
            If it is damaged, or belongs to another system.
        """
        saved = CoupledState.from_bytes(content)
        if saved.system != self._digest:
            raise FmuStateError(
                "The state was saved with another system of FMUs, binding or algorithm; use that one."
            )
        components = saved.components
        self._phase = "broken"
        self._take_parameters(saved.parameters)
        for (name, asset), state in zip(self._assets.items(), components, strict=True):
            with naming(name):
                asset.restore_state(state)
        self._held = saved.held
        self._now, self._before = np.array(saved.outputs), np.array(saved.before)
        self._index = saved.index
        self._phase = "ready"

    # ------------------------------------------------------------------ stepping

    def _pass(self, group: Sequence[str], source: FloatArray) -> None:
        for name in group:
            part, asset, held = self._parts[name], self._assets[name], self._held[name]
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
        if not part.fed:
            return {}
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
                low, high = self._assets[part.name].input_range("load", variable)
                end = 2.0 * begins[variable] - earlier[variable]
                fed[variable] = min(max(end, low), high)
        return begins

    def _iterate(self, group: Sequence[str]) -> None:
        """Repeat the step of a circle of components until what they exchange has settled."""
        states = {name: self._assets[name].save_state() for name in group}
        exchanged = {port.end for name in group for port in self._parts[name].fed.values()}
        watched = [i for i, end in enumerate(self._ends) if end in exchanged and end.component in group]
        for iteration in range(self._iterations):
            last = self._now.copy()
            if iteration:
                for name, state in states.items():
                    with naming(name):
                        self._assets[name].restore_state(state)
            self._pass(group, last if self._jacobi else self._now)
            change = np.abs(self._now - last)[watched]
            if iteration and (change <= self._tolerance * np.maximum(1.0, np.abs(last[watched]))).all():
                return
        worst = int(np.argmax(change))
        raise IterationError(
            f"The components {listed(group)} did not settle in {self._iterations} iterations of the step "
            f"from t = {self.time:g} s ({self._ends[watched[worst]]} still changes by {change[worst]:.3g}); "
            "allow more iterations or a larger tolerance, make the step smaller, or delay one of their "
            "connections."
        )

    def _place(self, inputs: Mapping[str, Any]) -> None:
        for role, values in inputs.items():
            slots = self._roles.inputs.get(role, {})
            for name, value in (values or {}).items():
                if name not in slots:
                    raise BindingError(
                        f"The binding {self._binding.name} has no {role} {name!r}; it has {listed(slots)}."
                    )
                if not isinstance(value, int | float):
                    raise FmuInputError(f"{role}.{name} must be a number, but is {value!r}.")
                low, high = self._binding.inputs(role)[name].ends
                if value < low or value > high:
                    raise FmuInputError(
                        f"{role}.{name} = {value:g} lies outside {low:g} to {high:g}, its range in the "
                        f"binding {self._binding.name}."
                    )
                for port in slots[name]:
                    number = float(port.conversion.to_fmu(value))
                    self._held[port.end.component][port.end.variable] = number

    def _observation(self) -> Observation:
        extra = {}
        if self._roles.monitors:
            monitored = self._monitored.of(self._now, self._before).tolist()
            extra = dict(zip(self._roles.monitors, monitored, strict=True))
        return Observation(self._observed.of(self._now, self._before), self.time, extra)

    def _opened(self) -> None:
        if self._phase == "broken":
            raise FmuStateError(
                "A step or a restoration failed, and the FMUs no longer stand at the same time; reset the "
                "asset or restore a state."
            )
        if self._phase == "closed":
            raise FmuStateError("The asset is closed; reset it to start anew.")
        if self._phase == "new":
            self.reset()

    def _open(self, part: Part, *, isolated: bool, step_timeout: float | None) -> FmiAsset:
        with naming(part.name):
            return FmiAsset(
                self._wiring.structure.component(part.name).fmu,
                part.binding,
                isolated=isolated,
                step_timeout=step_timeout,
                parameters=self._settings(part),
            )

    def _take_parameters(self, given: Mapping[str, Any]) -> None:
        self._tuned = parameter_values(self._binding, self._roles, given)
        self._parameters = {name: float(value) for name, value in sorted(given.items())}

    def _settings(self, part: Part) -> dict[str, float]:
        return part.settings | self._tuned.get(part.name, {})

    def _check_restorable(self) -> None:
        for group, circular in zip(self.schedule.groups, self.schedule.circular, strict=True):
            for name in group if circular else ():
                if self._assets[name].state_method != "serialised":
                    raise CouplingError(
                        f"The component {name!r} cannot save and restore its state, which iterations need; "
                        "allow one iteration only, or delay a connection."
                    )

    def describe(self) -> dict[str, Any]:
        """Return the system as plain records for a listing."""
        plan = self.schedule
        return {
            "system": self._wiring.structure.name,
            "components": {name: str(asset.description.path) for name, asset in self._assets.items()},
            "order": list(plan.order),
            "linear": [name for name, part in self._parts.items() if part.linear],
            "held": [f"{link.source} -> {link.target}" for link in plan.held],
            "loops": [" -> ".join(str(end) for end in loop) for loop in plan.loops],
            "binding": self._binding.name,
            "step_size": self._interval,
        }
