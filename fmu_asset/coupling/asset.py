"""`CoupledAsset`: several FMUs flown as one, with the face of `FmiAsset`."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np

from fmu_asset.door.binding import INPUT_ROLES, Binding
from fmu_asset.door.observation import Observation
from fmu_asset.door.session import FmiAsset
from fmu_asset.door.stepped import SteppedAsset
from fmu_asset.errors import (
    AlgebraicLoopError,
    BindingError,
    CouplingError,
    FmuError,
    FmuInputError,
    FmuStateError,
    IterationError,
)

from .layout import Layout
from .roles import Roles, resolve_roles
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
        parameters: Mapping[str, float] | None = None,
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
        self._roles: Roles = resolve_roles(self._wiring, binding)
        self._ranges = {
            (role, name): (
                -math.inf if item.minimum is None else item.minimum,
                math.inf if item.maximum is None else item.maximum,
            )
            for role in INPUT_ROLES
            for name, item in binding.inputs(role).items()
        }
        self._layout = Layout(self._wiring, binding, self._roles)
        self._parameters = {name: float(value) for name, value in (parameters or {}).items()}
        self._parameter_values = self._layout.parameters(self._parameters)
        self._held: list[dict[str, float]] = [dict(constants) for constants in self._layout.constants]
        self._now = [0.0] * self._layout.output_count
        self._before = self._earlier = list(self._now)
        self._stepped: set[int] = set()
        self._assets = self._open(isolated, step_timeout)
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
            (status, f"{name}: {text}")
            for name, asset in zip(self._layout.names, self._assets, strict=True)
            for status, text in asset.log
        )

    # ------------------------------------------------------------------ life

    def close(self) -> None:
        """End all workers; the asset can be opened again by `reset`."""
        self._phase = "closed"
        for asset in self._assets:
            asset.close()

    def reset(
        self,
        parameters: Mapping[str, float] | None = None,
        *,
        control: Mapping[str, float] | None = None,
        health: Mapping[str, float] | None = None,
        load: Mapping[str, float] | None = None,
    ) -> None:
        """Go back to the start; arguments and errors are those of `FmiAsset.reset`.

        The components are initialised in the order of `schedule`; each takes the initial outputs of those
        before it. An input whose source comes later starts at the FMU's own start value.
        """
        if parameters is not None:
            self._parameter_values = self._layout.parameters(parameters)
            self._parameters = {name: float(value) for name, value in parameters.items()}
        self._held[:] = [dict(constants) for constants in self._layout.constants]
        self._place(control, health, load)
        self._phase = "broken"
        known: set[int] = set()
        try:
            for index in self._layout.order:
                start = dict(self._held[index])
                names, pick = self._layout.fed[index]
                fed = zip(names, pick.places, pick.of(self._now, self._now), strict=True)
                start.update({name: value for name, place, value in fed if place in known})
                self._assets[index].reset(self._settings(index), load=start or None)
                span = self._layout.spans[index]
                self._now[span] = self._assets[index].observe().values.tolist()
                known.update(range(span.start, span.stop))
        except FmuError as error:
            self.close()
            raise self._named(error, index) from error
        self._before = list(self._now)
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
        self._place(control, health, load)
        self._earlier, self._before = self._before, list(self._now)
        self._stepped.clear()
        self._phase = "broken"
        for group, circular in self._layout.groups:
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
        return CoupledState(
            system=self._digest,
            index=self._index,
            parameters=self._parameters,
            held=self._held,
            outputs=self._now,
            before=self._before,
            components=[asset.save_state() for asset in self._assets],
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
        self._phase = "broken"
        self._parameter_values = self._layout.parameters(saved.parameters)
        self._parameters = dict(saved.parameters)
        for index, (asset, state) in enumerate(zip(self._assets, saved.components, strict=True)):
            try:
                asset.restore_state(state)
            except FmuError as error:
                raise self._named(error, index) from error
        self._held = [dict(held) for held in saved.held]
        self._now, self._before = list(saved.outputs), list(saved.before)
        self._index = saved.index
        self._phase = "ready"

    # ------------------------------------------------------------------ stepping

    def _pass(self, group: Sequence[int], source: list[float]) -> None:
        for index in group:
            held = self._held[index]
            names, pick = self._layout.fed[index]
            values = pick.of(source, self._before)
            asset = self._assets[index]
            try:
                if self._layout.linear[index]:
                    asset.hold(load=dict(zip(names, self._draw(index, values, source), strict=True)))
                held.update(zip(names, values, strict=True))
                seen = asset.step(load=held)
                for _ in range(self._layout.substeps[index] - 1):
                    seen = asset.step()
            except FmuError as error:
                raise self._named(error, index) from error
            self._now[self._layout.spans[index]] = seen.values.tolist()
            if source is self._now:
                self._stepped.add(index)
        self._stepped.update(group)

    def _draw(self, index: int, values: list[float], source: list[float]) -> list[float]:
        """Return where the lines of the inputs that others feed begin; `values` becomes where they end.

        Where the source is not there yet, its last line goes on, within the range of the input.
        """
        names, pick = self._layout.fed[index]
        begins = pick.of(self._before, self._before)
        earlier = pick.of(self._earlier, self._earlier)
        for position, tap in enumerate(pick.taps):
            if not self._layout.moving[index][position]:
                begins[position] = values[position]
            elif tap.delayed or source is self._before or self._layout.owner[tap.place] not in self._stepped:
                low, high = self._assets[index].input_range("load", names[position])
                values[position] = min(max(2.0 * begins[position] - earlier[position], low), high)
        return begins

    def _iterate(self, group: Sequence[int]) -> None:
        """Repeat the step of a circle of components until what they exchange has settled."""
        states = {index: self._assets[index].save_state() for index in group}
        spans = [self._layout.spans[index] for index in group]
        own = {place for span in spans for place in range(span.start, span.stop)}
        watched = sorted(own & {place for index in group for place in self._layout.fed[index][1].places})
        for iteration in range(self._iterations):
            last = list(self._now)
            if iteration:
                for index, state in states.items():
                    try:
                        self._assets[index].restore_state(state)
                    except FmuError as error:
                        raise self._named(error, index) from error
            self._pass(group, last if self._jacobi else self._now)
            change = {place: abs(self._now[place] - last[place]) for place in watched}
            if iteration and all(
                size <= self._tolerance * max(1.0, abs(last[place])) for place, size in change.items()
            ):
                return
        worst = max(watched, key=change.__getitem__)
        names = listed(self._layout.names[index] for index in group)
        last_change = f"{self._layout.output_name(worst)} still changes by {change[worst]:.3g}"
        raise IterationError(
            f"The components {names} did not settle in {self._iterations} iterations of the step from "
            f"t = {self.time:g} s ({last_change}); allow more iterations or a larger tolerance, make the "
            "step smaller, or delay one of their connections."
        )

    def _place(
        self,
        control: Mapping[str, float] | None,
        health: Mapping[str, float] | None,
        load: Mapping[str, float] | None,
    ) -> None:
        for role, values in zip(INPUT_ROLES, (control, health, load), strict=True):
            if not values:
                continue
            slots = self._layout.entries[role]
            for name, value in values.items():
                entries = slots.get(name)
                if entries is None:
                    raise BindingError(
                        f"The binding {self._binding.name} has no {role} {name!r}; it has {listed(slots)}."
                    )
                if not isinstance(value, int | float):
                    raise FmuInputError(f"{role}.{name} must be a number, but is {value!r}.")
                low, high = self._ranges[role, name]
                if value < low or value > high:
                    raise FmuInputError(
                        f"{role}.{name} = {value:g} lies outside {low:g} to {high:g}, its range in the "
                        f"binding {self._binding.name}."
                    )
                for index, variable, conversion in entries:
                    self._held[index][variable] = float(conversion.to_fmu(value))

    def _observation(self) -> Observation:
        now, before = self._now, self._before
        names, monitors = self._layout.monitored
        extra = dict(zip(names, monitors.of(now, before), strict=True))
        return Observation(np.array(self._layout.observed.of(now, before)), self.time, extra)

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

    def _named(self, error: FmuError, index: int) -> FmuError:
        sentence = f"component {self._layout.names[index]}: {error.sentence}"
        return type(error)(sentence, error.messages, error.time)

    def _open(self, isolated: bool, step_timeout: float | None) -> list[FmiAsset]:
        assets = []
        for index, component in enumerate(self._wiring.structure.components):
            try:
                asset = FmiAsset(
                    component.fmu,
                    self._layout.component_binding(index),
                    isolated=isolated,
                    step_timeout=step_timeout,
                    parameters=self._settings(index),
                )
            except FmuError as error:
                raise self._named(error, index) from error
            assets.append(asset)
        return assets

    def _settings(self, index: int) -> dict[str, float]:
        return {**self._layout.settings[index], **self._parameter_values[index]}

    def _check_restorable(self) -> None:
        for index in {i for group, circular in self._layout.groups if circular for i in group}:
            if self._assets[index].state_method != "serialised":
                raise CouplingError(
                    f"The component {self._layout.names[index]!r} cannot save and restore its state, which "
                    "iterations need; allow one iteration only, or delay a connection."
                )

    def describe(self) -> dict[str, Any]:
        """Return the system as plain records for a listing."""
        plan = self.schedule
        return {
            "system": self._wiring.structure.name,
            "components": {
                name: str(asset.description.path)
                for name, asset in zip(self._layout.names, self._assets, strict=True)
            },
            "order": list(plan.order),
            "linear": [name for name, on in zip(self._layout.names, self._layout.linear, strict=True) if on],
            "held": [f"{link.source} -> {link.target}" for link in plan.held],
            "loops": [" -> ".join(str(end) for end in loop) for loop in plan.loops],
            "binding": self._binding.name,
            "step_size": self._interval,
        }
