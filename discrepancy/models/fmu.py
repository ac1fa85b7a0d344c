"""Any FMU with a binding as a model: its inputs loaded, its outputs read, internal forces at its ports."""

from collections.abc import Mapping, Sequence
from math import ceil, inf
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from discrepancy.campaign import Campaign, Quantity, Trial, TrialKind
from discrepancy.compiled_motion import compiled_kernel
from discrepancy.errors import ModelError
from discrepancy.models.fmu_file import FmuModelDescription, load_fmu_model
from discrepancy.models.fmu_motion import Excitation, FmuMotion, State
from discrepancy.models.fmu_patch import NO_PATCH, SortedPatch, carries, sorted_patch
from discrepancy.models.fmu_runs import FmuRuns
from discrepancy.models.fmu_samples import sampled
from discrepancy.models.interface import Conditions, ModelParameter, PortScale, Response, Scales
from fe.errors import SolutionError
from fe.motion import Laws, static_solution
from fe.patch import (
    ModelPatch,
    Primitive,
)

FloatArray = NDArray[np.float64]

DEFAULT_PLACE = "tip_load"
STATIC_ITERATIONS = 30
STATIC_TOLERANCE = 1e-9


class FmuModel:
    """An FMU (`discrepancy.models.interface.Model`).

    Parameters
    ----------
    description : FmuModelDescription
        Content of its file.
    folder : path-like
        Where relative names in it begin.

    Raises
    ------
    ModelError
        If FMU, binding or a variable is missing, or of another causality or unit.

    Notes
    -----
    The FMU knows one release, so that only the first entry of `Conditions.initial` acts; deviations of single
    modes are passed over. `transverse` and `shear` are never known.
    """

    def __init__(self, description: FmuModelDescription, folder: Path | str = ".") -> None:
        self.description = description
        self.runs = FmuRuns(description, Path(folder))
        self._parameters = tuple(
            ModelParameter(item.name, item.mean, item.deviation, item.unit, item.low, item.high)
            for item in description.parameter
        )
        self._keys = [self.runs.parameter(item.variable or item.name) for item in description.parameter]
        self._ports = tuple(port.name for port in description.port)
        self._forces = {place: self.runs.variable(name) for place, name in description.inputs.forces.items()}
        self._check_settings()
        means = Conditions(np.array([item.mean for item in self._parameters]))
        nominal = self._state(_any_trial(TrialKind.RINGDOWN, 1.0), means, (), 0)
        self.motion = FmuMotion(description, self.runs, nominal)

    @classmethod
    def load(cls, path: Path | str) -> "FmuModel":
        """Return the model of a TOML file; raises `ModelError`."""
        return cls(load_fmu_model(path), Path(path).parent)

    def close(self) -> None:
        """End the FMU; it is opened again when it is needed."""
        self.runs.close()

    def _check_settings(self) -> None:
        """Refuse effects and parameters of trials that the FMU does not have."""
        asset = self.runs.asset
        names = {
            f"effects.{kind}": f"effect.{identifier}.active"
            for kind, identifier in self.description.effects.items()
        }
        bound = asset.binding.parameter
        for table in ("static", "motion"):
            for name in getattr(self.description, table).parameters:
                key = self.runs.parameter(name)
                names[f"{table}.parameters.{name}"] = bound[key].variable if key in bound else key
        for where, variable in names.items():
            found = asset.description.variable(variable)
            if found is None or found.causality != "parameter":
                what = (
                    "does not have" if found is None else f"declares as {found.causality}, not as parameter"
                )
                raise ModelError(
                    f"The FMU model {self.name!r}: {where} needs {variable!r}, which the FMU "
                    f"{asset.description.path} {what}."
                )

    # ------------------------------------------------------------ what it is

    @property
    def name(self) -> str:
        """Name for people."""
        return self.description.name

    @property
    def parameters(self) -> tuple[ModelParameter, ...]:
        """Calibrated parameters."""
        return self._parameters

    def output_quantity(self, output: str) -> Quantity | None:
        """Return what an output is, or None if the model has no such output."""
        found = self.runs.quantities.get(output)
        return None if found is None else Quantity(found)

    def supports(self, primitive: type[Primitive]) -> bool:
        """Whether the model can carry a primitive."""
        return carries(self.description, primitive)

    def ports(self) -> tuple[str, ...]:
        """Names of the ports."""
        return self._ports

    def stations(self) -> tuple[float, float] | None:
        """Return 0 and the length [m] if the file states one, else None."""
        length = self.description.scales.length
        return None if length is None else (0.0, length)

    def scales(self, campaign: Campaign) -> Scales:
        """Return the natural scales under a campaign: those of the file, else what the FMU shows."""
        given = self.description.scales
        values = np.array([campaign.parameters.get(p.name, (p.mean, 0.0))[0] for p in self._parameters])
        dynamic = [trial for trial in campaign.trials if trial.is_dynamic]
        still = [trial for trial in campaign.trials if not trial.is_dynamic]
        largest = dict.fromkeys(self._ports, 0.0)
        port_columns = [self.runs.columns[f"port.{port}.displacement"] for port in self._ports]
        for trial in campaign.trials:
            state = self._state(trial, Conditions(values), (), 0)
            if trial.is_dynamic:
                moved = self._free(trial, Conditions(values), state, NO_PATCH, 1)[0]
            else:
                moved = self._at_rest_values(trial, Conditions(values, health=trial.health), NO_PATCH)
            for port, column in zip(self._ports, port_columns, strict=True):
                largest[port] = max(largest[port], float(np.max(np.abs(moved[:, column]))))
        frequency = given.angular_frequency
        seen: dict[str, tuple[float, float]] = {}  # modal and static stiffness
        if dynamic:
            trial = dynamic[0]
            state = self._state(trial, Conditions(values), (), 0)
            step = self.motion.step(trial, 1)
            seen = {
                port: self.motion.stiffness(number, state, step) for number, port in enumerate(self._ports)
            }
            frequency = frequency or self.motion.measured_frequency(trial, state)
        else:
            some = still[0] if still else _any_trial(TrialKind.STATIC, 1.0)
            state = self._state(some, Conditions(values, health=some.health), (), 0)
            for number, port in enumerate(self._ports):
                flexible = float(self._flexibility(state)[number, number])
                seen[port] = (1.0 / flexible, 1.0 / flexible)
            if not still and frequency is None:
                interval = 0.01
                for _ in range(3):  # until the interval suits the frequency
                    trial = _any_trial(TrialKind.RINGDOWN, interval)
                    frequency = self.motion.measured_frequency(
                        trial, self._state(trial, Conditions(values), (), 0)
                    )
                    interval = 0.3 / frequency
        frequency = frequency or 1.0
        at_force = next(
            (
                p.name
                for p in self.description.port
                if self.runs.variable(p.force) in self._forces.values() and p.name in seen
            ),
            None,
        )
        tip, modal = seen.get(at_force, (1.0, 1.0)) if at_force else next(iter(seen.values()), (1.0, 1.0))
        moments = [t.start + t.time if t.is_dynamic else t.time for t in campaign.trials]
        span = float(max(map(np.max, moments)) - min(map(np.min, moments))) if moments else 0.0
        return Scales(
            length=given.length or 1.0,
            tip_stiffness=given.tip_stiffness or modal,
            modal_mass=given.modal_mass or tip / frequency**2,
            angular_frequency=frequency,
            force=max((float(np.max(np.abs(t.force))) for t in campaign.trials), default=0.0),
            load_factor=max((float(np.max(np.abs(t.load_factor))) for t in campaign.trials), default=0.0),
            duration=max((float(t.time[-1] - t.time[0]) for t in dynamic), default=1.0),
            campaign_time=span if span > 0.0 else 1.0,
            ports={
                port: PortScale(largest[port] or 1.0, seen[port][0], frequency, seen[port][1])
                for port in self._ports
            },
        )

    # ------------------------------------------------------------ response

    def respond(
        self,
        trial: Trial,
        outputs: tuple[tuple[str, Quantity], ...],
        patch: ModelPatch,
        conditions: Conditions,
        *,
        components: bool = False,
        refinement: int = 1,
    ) -> Response:
        """Return the response of a trial, see `Model.respond`; `transverse` and `shear` are never known.

        The force of a trial is (1 + gain) times the recorded one, plus the tare where it is not zero.
        """
        if conditions.parameters.shape != (len(self._parameters),):
            raise ModelError(
                f"The FMU model {self.name!r} has {len(self._parameters)} parameters, but "
                f"{conditions.parameters.size} came."
            )
        columns = self._columns(outputs)
        parts = sorted_patch(patch, self.description)
        if not trial.is_dynamic:
            moving = (Quantity.VELOCITY, Quantity.ACCELERATION)
            if any(quantity in moving for _, quantity in outputs):
                raise ModelError(
                    f"The trial {trial.name!r} is at rest, but a channel measures velocity or acceleration."
                )
            return Response(self._at_rest_values(trial, conditions, parts)[:, columns])
        state = self._state(trial, conditions, parts.settings, 0)
        values, step = self._moving(trial, conditions, state, parts, refinement)
        rate, zero = conditions.clock
        derivatives = [self._derivatives(output, quantity) for output, quantity in outputs]
        return sampled(values[:, columns], step, (1.0 + rate) * trial.time + zero, derivatives)

    def _moving(
        self, trial: Trial, conditions: Conditions, state: State, patch: SortedPatch, refinement: int
    ) -> tuple[FloatArray, float]:
        """Return all outputs (K, C) on the grid of the communication step [s], and the step."""
        if not len(patch.laws):
            return self._free(trial, conditions, state, patch, refinement)
        return self.motion.with_laws(
            patch.laws,
            lambda refined: self._excitations(trial, conditions, state, patch, refined),
            trial,
            state,
            refinement,
        )

    def _free(
        self, trial: Trial, conditions: Conditions, state: State, patch: SortedPatch, refinement: int
    ) -> tuple[FloatArray, float]:
        step, steps, loads = self._excitations(trial, conditions, state, patch, refinement)
        return self.motion.free(state, step, steps, loads), step

    def _excitations(
        self, trial: Trial, conditions: Conditions, state: State, patch: SortedPatch, refinement: int
    ) -> tuple[float, int, list[tuple[Excitation, float]]]:
        """Return step, number of steps, and what excites the FMU, each with its factor."""
        step = self.motion.step(trial, refinement)
        rate, zero = conditions.clock
        end = max((1.0 + rate) * float(trial.time[-1]) + zero, float(trial.time[-1]))
        # a little longer, so that a clock that is being fitted does not ask for another run
        steps = ceil(end / step * (1.0 + 2e-9) - 1e-6) + (0 if (rate, zero) == (0.0, 0.0) else 1)
        if trial.kind is TrialKind.RINGDOWN:
            return step, steps, self._release(trial, conditions)
        return step, steps, self._forced(trial, patch, step, steps)

    def _release(self, trial: Trial, conditions: Conditions) -> list[tuple[Excitation, float]]:
        release, way = trial.release, self.description.release
        if release is None:
            raise ModelError(f"The ring-down {trial.name!r} does not say how it was released.")
        if way is None:
            raise ModelError(
                f"The FMU model {self.name!r} cannot ring down: state in [release] the FMU's parameter of "
                f"the release displacement, or the force that holds it."
            )
        first = conditions.initial[0] if len(conditions.initial) else np.zeros(2)
        if release.at_rest:
            size = release.displacement * (1.0 + float(first[0]))
            kind = "hold" if way.displacement is None else "displacement"
            return [(Excitation(kind), size)]
        if way.displacement is None or way.velocity is None:
            raise ModelError(
                f"The ring-down {trial.name!r} does not begin at rest, which the FMU model {self.name!r} can "
                f"follow only if [release] names parameters of displacement and velocity."
            )
        unit = release.displacement
        speed = self.motion.angular_frequency(trial)
        return [
            (Excitation("displacement"), unit * float(first[0])),
            (Excitation("velocity"), unit * speed * float(first[1])),
        ]

    def _forced(
        self, trial: Trial, patch: SortedPatch, step: float, steps: int
    ) -> list[tuple[Excitation, float]]:
        at_ends = np.interp(step * np.arange(steps + 1), trial.time, trial.force)
        held = 0.5 * (at_ends[1:] + at_ends[:-1])
        on = (at_ends[1:] != 0.0) | (at_ends[:-1] != 0.0)
        name = self._input_of(trial.load_place)
        loads = [(Excitation("input", name, held, float(trial.force[0])), 1.0 + patch.gain)]
        if patch.tare:
            loads.append(
                (Excitation("input", name, on.astype(float), float(trial.force[0] != 0.0)), patch.tare)
            )
        inputs = self.description.inputs
        for lever, moment in (
            (patch.along_span, inputs.bending_moment),
            (patch.along_chord, inputs.torque),
        ):
            if lever and moment is not None:
                begin, variable = float(trial.force[0]), self.runs.variable(moment)
                loads.append((Excitation("input", variable, held, begin), (1.0 + patch.gain) * lever))
                if patch.tare:
                    loads.append(
                        (
                            Excitation("input", variable, on.astype(float), float(begin != 0.0)),
                            patch.tare * lever,
                        )
                    )
        return loads

    # ------------------------------------------------------------ rest

    def _at_rest_values(self, trial: Trial, conditions: Conditions, patch: SortedPatch) -> FloatArray:
        """Return all outputs (N, C) of a static trial or a flight."""
        inputs = self.description.inputs
        flight = trial.kind is TrialKind.FLIGHT
        if flight and inputs.load_factor is None:
            raise ModelError(
                f"The trial {trial.name!r} is a flight, but the FMU model {self.name!r} names no load_factor "
                f"in [inputs]; leave it out."
            )
        count = len(trial.force)
        loads: list[dict[str, float]] = []
        for row in range(count):
            if flight:
                loads.append({self.runs.variable(str(inputs.load_factor)): float(trial.load_factor[row])})
                continue
            recorded = float(trial.force[row])
            acting = recorded * (1.0 + patch.gain) + patch.tare * (recorded != 0.0)
            given = {self._input_of(trial.load_place): acting}
            for lever, moment in (
                (patch.along_span, inputs.bending_moment),
                (patch.along_chord, inputs.torque),
            ):
                if lever and moment is not None:
                    given[self.runs.variable(moment)] = acting * lever
            loads.append(given)
        states = [self._state(trial, conditions, patch.settings, row) for row in range(count)]
        if not len(patch.laws):
            return np.stack([self.motion.rest(s, g) for s, g in zip(states, loads, strict=True)])
        return self._with_laws_at_rest(trial, states, loads, patch.laws)

    def _with_laws_at_rest(
        self, trial: Trial, states: list[State], loads: list[dict[str, float]], laws: Laws
    ) -> FloatArray:
        """Return all outputs (N, C) where laws follow the load path; the FMU itself is asked at the end.

        Raises
        ------
        ModelError
            If the law has no solution, or the FMU does not confirm it.
        """
        index = [self._ports.index(port) for port in laws.ports]
        columns = [self.runs.columns[f"port.{self._ports[p]}.displacement"] for p in index]
        inputs = [self.runs.variable(self.description.port[p].force) for p in index]
        values = np.empty((len(states), max(self.runs.columns.values()) + 1))
        memory: FloatArray | None = None
        before = np.zeros(len(laws))
        for row, (state, load) in enumerate(zip(states, loads, strict=True)):
            compliance = self._flexibility(state)[np.ix_(index, index)]
            linear = self.motion.rest(state, load)[columns]
            for _ in range(STATIC_ITERATIONS):
                try:
                    solution = static_solution(
                        laws, linear[None], compliance, memory=memory, start=before, kernel=compiled_kernel()
                    )
                except SolutionError as cause:
                    raise ModelError(str(cause)) from cause
                forces = solution.forces[0]
                given = dict(load)
                for name, force in zip(inputs, forces, strict=True):
                    given[name] = given.get(name, 0.0) - float(force)
                values[row] = self.motion.rest(state, given)
                # where the FMU is not linear, the law is solved again about the point that was reached
                again = values[row, columns] + compliance @ forces
                change = np.max(np.abs(again - linear))
                linear = again
                if change <= STATIC_TOLERANCE * max(np.max(np.abs(again)), 1e-300):
                    break
            else:
                raise ModelError(
                    f"The law at {', '.join(dict.fromkeys(laws.ports))} and the FMU model {self.name!r} did "
                    f"not agree at load level {row + 1} of {trial.name!r} within {STATIC_ITERATIONS} "
                    f"iterations; the force is too strong for the FMU."
                )
            memory, before = solution.memory, linear
        return values

    def _flexibility(self, state: State) -> FloatArray:
        """Return the displacements (P, P) of the ports at rest under unit forces at each."""
        columns = [self.runs.columns[f"port.{port}.displacement"] for port in self._ports]
        zero = self.motion.rest(state, {})[columns]
        result = np.empty((len(columns), len(columns)))
        for number, port in enumerate(self.description.port):
            name = self.runs.variable(port.force)
            size = min(1.0, 0.1 * self.runs.input_limit(port.force))
            result[:, number] = (self.motion.rest(state, {name: size})[columns] - zero) / size
        return result

    # ------------------------------------------------------------ parts

    def _state(
        self, trial: Trial, conditions: Conditions, settings: tuple[tuple[str, float], ...], row: int
    ) -> State:
        """Return parameters and constant inputs of a row of a trial."""
        wanted = self.description.inputs
        inputs: dict[str, float] = {}
        health = conditions.health[min(row, len(conditions.health) - 1)]
        for name, value in ((wanted.z1, health[0]), (wanted.z2, health[1])):
            if name is not None:
                inputs[self.runs.variable(name)] = float(value)
        if wanted.temperature is not None:
            base = wanted.temperature_reference or 0.0
            at = 0 if trial.is_dynamic else row
            inputs[self.runs.variable(wanted.temperature)] = base + float(trial.temperature[at])
        table = self.description.motion if trial.is_dynamic else self.description.static
        parameters = {self.runs.parameter(name): value for name, value in table.parameters.items()}
        for key, value in zip(self._keys, conditions.parameters, strict=True):
            parameters[key] = float(value)
        parameters |= dict(settings)
        return State(tuple(sorted(parameters.items())), tuple(sorted(inputs.items())))

    def _derivatives(self, output: str, quantity: Quantity) -> int:
        """Return how often an output is derived for a channel of a quantity."""
        if quantity is Quantity.SIGNAL:
            return 0
        return max(_ORDER.get(quantity, 0) - _ORDER.get(Quantity(self.runs.quantities[output]), 0), 0)

    def _columns(self, outputs: Sequence[tuple[str, Quantity]]) -> list[int]:
        columns = []
        for output, quantity in outputs:
            own = self.output_quantity(output)
            if own is None:
                raise ModelError(
                    f"The FMU model {self.name!r} has no output {output!r}; it has "
                    f"{', '.join(self.runs.quantities)}."
                )
            derived = _ORDER.get(quantity, -1) > _ORDER.get(own, inf)
            if quantity not in (own, Quantity.SIGNAL) and not derived:
                raise ModelError(
                    f"The output {output!r} of {self.name!r} is a {own.value}, but a channel measures "
                    f"{quantity.value}."
                )
            columns.append(self.runs.columns[output])
        return columns

    def _input_of(self, place: str | tuple[float, float]) -> str:
        if place == DEFAULT_PLACE and place not in self._forces and len(self._forces) == 1:
            return next(iter(self._forces.values()))
        if not isinstance(place, str) or place not in self._forces:
            known = ", ".join(self._forces) or "none"
            raise ModelError(
                f"The load place {place!r} has no force input in the FMU model {self.name!r}; it has {known}."
            )
        return self._forces[place]


def _any_trial(kind: TrialKind, interval: float) -> Trial:
    """Return a trial that asks for nothing, for scales without a campaign."""
    count = 1 if kind is TrialKind.STATIC else 400
    zeros, empty = np.zeros(count), np.zeros((count, 0))
    time = np.asarray(interval * np.arange(count), dtype=np.float64)
    return Trial(
        "", kind, (), empty, empty.astype(bool), time, zeros, zeros, DEFAULT_PLACE, zeros,
        0.0, "", np.zeros((1, 2)), np.zeros((1, 2)),
    )  # fmt: skip


_ORDER: Mapping[Quantity, int] = {
    Quantity.DISPLACEMENT: 0, Quantity.VELOCITY: 1, Quantity.ACCELERATION: 2,
}  # fmt: skip
