"""Any FMU with a binding as a model: its inputs loaded, its outputs read, internal forces at its ports."""

from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np

from discrepancy.campaign.records import Campaign, FloatArray, Trial, TrialKind
from discrepancy.errors import ModelError, said
from discrepancy.fmu_models.description import FmuModelDescription
from discrepancy.fmu_models.motion import FmuMotion, Sampled
from discrepancy.fmu_models.system import Case
from discrepancy.system.excitation import Course, LoadChange, divided, place_among, release_of
from discrepancy.system.interface import NO_PATCH
from discrepancy.system.model_file import DescribedModel
from discrepancy.system.response import Conditions, Outputs, PortedSystem, Response
from discrepancy.system.scales import PortScale, Scales
from fe.runtime.motion import Laws, laws_of
from fe.runtime.patch import SENSORS, LoadGain, LoadPlace, ModelPatch, PortForce, Primitive
from fmu_asset.door.runs import State

LATEST = 100.0
"""Lengths of a record after which its stamps count from elsewhere than the trial's start."""


class FmuModel(DescribedModel):
    """An FMU (`discrepancy.system.interface.Model`).

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

    holds_inputs: ClassVar[bool] = True

    def __init__(self, description: FmuModelDescription, folder: Path | str = ".") -> None:
        self.description: FmuModelDescription = description
        self.fmu = fmu = FmuMotion(description, Path(folder))
        self.names = names = fmu.names
        super().__init__(description, names.quantities)
        self.length, self.regions = description.scales.length, tuple(description.inputs.regions)
        self.stations = None if self.length is None else (0.0, self.length)
        flies = description.inputs.load_factor is not None
        self.kinds = frozenset(TrialKind) - {TrialKind.DRIVEN, *(() if flies else (TrialKind.FLIGHT,))}
        self._keys = [names.parameter(item.variable) for item in description.parameter]
        self._forces = {place: names.variable(name) for place, name in description.inputs.force.items()}
        self._inputs = {item.name: names.variable(item.variable) for item in description.input}
        self.load_places = tuple(self._forces)
        limits = (fmu.asset.input_range("load", name)[1] for name in self._forces.values())
        self.largest_force = 0.5 * min(limits, default=np.inf)
        mean = Conditions(self.prior_mean())
        fmu.nominal = self._state(_any_trial(TrialKind.RINGDOWN, 1.0), mean)

    @classmethod
    def load(cls, path: Path | str) -> "FmuModel":
        """Return the model of a TOML file; raises `ModelError`."""
        return cls(FmuModelDescription.read(path), Path(path).parent)

    def close(self) -> None:
        """End the FMU; it is opened again when it is needed."""
        self.fmu.close()

    def supports(self, primitive: type[Primitive]) -> bool:
        """Whether the model can carry a primitive."""
        inputs, effects = self.description.inputs, self.description.effects
        if primitive in SENSORS or primitive.kind in effects:
            return True
        if primitive in (LoadGain, LoadPlace):
            return bool(inputs.force) and (primitive is LoadGain or inputs.bending_moment is not None)
        return issubclass(primitive, PortForce) and bool(self.ports)

    def scales(self, campaign: Campaign) -> Scales:
        """Return the natural scales under a campaign: those of the file, else what the FMU shows."""
        given, fmu, trials = self.description.scales, self.fmu, campaign.trials
        conditions, largest = Conditions(self.prior_mean(campaign)), np.zeros(len(fmu.ports))
        for trial in trials:
            if trial.is_dynamic:
                moved, _ = self._moving(trial, conditions, NO_PATCH, fmu.x, [0] * len(fmu.x))
            else:
                own = replace(conditions, health=trial.health)
                moved = self._at_rest(trial, own, NO_PATCH)[:, fmu.x]
            largest = np.maximum(largest, np.max(np.abs(moved), axis=0))
        still = next((item for item in trials if not item.is_dynamic), _any_trial(TrialKind.STATIC, 1.0))
        flexible = np.diag(fmu.flexibility(self._state(still, conditions)))
        pairs = [(1.0 / own, 1.0 / own) for own in flexible.tolist()]
        frequency, moving = given.angular_frequency, next((item for item in trials if item.is_dynamic), None)
        if moving is not None:
            state = self._state(moving, conditions)
            frequency = frequency or fmu.pace(moving, state)[0]
            if (system := fmu.system(fmu.case(moving, state, self.ports))) is not None:
                pairs = [system.stiffness(column, number) for number, column in enumerate(fmu.x)]
        interval = 0.01
        for _ in range(0 if trials or frequency else 3):  # until the interval suits it
            frequency = fmu.pace(_any_trial(TrialKind.RINGDOWN, interval), fmu.nominal)[0]
            interval = 0.3 / frequency
        loaded = (
            pair for force, pair in zip(fmu.forces, pairs, strict=True) if force in self._forces.values()
        )
        modal, tip = next(loaded, (*pairs, (1.0, 1.0))[0])
        frequency = frequency or 1.0
        return Scales(
            length=given.length or 1.0,
            tip_stiffness=given.tip_stiffness or tip,
            modal_mass=given.modal_mass or modal / frequency**2,
            angular_frequency=frequency,
            **campaign.sizes,
            ports={
                port: PortScale(float(most) or 1.0, own, frequency, rest)
                for port, most, (own, rest) in zip(self.ports, largest, pairs, strict=True)
            },
        )

    # ------------------------------------------------------------ response

    def _respond(self, trial: Trial, outputs: Outputs, patch: ModelPatch, conditions: Conditions) -> Response:
        """Return the response of a trial; `transverse` and `shear` are never known.

        The force of a trial is (1 + gain) times the recorded one, plus the tare where it is not zero.
        """
        columns, orders = self._read(outputs)
        if trial.is_dynamic:
            return Response(*self._moving(trial, conditions, patch, columns, orders))
        if any(quantity.order > 0 for _, quantity in outputs):
            raise ModelError(said("models.speed_at_rest", trial=trial))
        return Response(self._at_rest(trial, conditions, patch)[:, columns])

    def _read(self, outputs: Outputs) -> tuple[list[int], list[int]]:
        """Return the columns of outputs, and how often each is derived."""
        orders = [quantity.derivatives_of(self.quantities[output]) for output, quantity in outputs]
        return [self.names.columns[output] for output, _ in outputs], orders

    def _moving(
        self, trial: Trial, conditions: Conditions, patch: ModelPatch, columns: list[int], orders: list[int],
        parts: int = 1,
    ) -> Sampled:  # fmt: skip
        """Return columns of the FMU's outputs in a dynamic trial, derived so many times, and their rates.

        At samples that are so many times as dense as those of the trial.
        """
        laws, times = self._laws(patch), divided(conditions.stamps(trial.time), parts)
        first, last = trial.time[[0, -1]].tolist()
        # an FMU begins at zero, and cannot be followed for hours to where a clock of the day begins
        if trial.kind is not TrialKind.RINGDOWN and not 0.0 <= first <= LATEST * (last - first):
            trial, times = replace(trial, time=trial.time - first), times - first
        case = self._case(trial, conditions, patch, laws)
        return self.fmu.motion(case, trial, times, laws, columns, orders, conditions.refinement)

    def _at_rest(self, trial: Trial, conditions: Conditions, patch: ModelPatch) -> FloatArray:
        """Return all outputs (N, C) of a static trial or a flight."""
        offsets, given = conditions.offset or (0.0,) * len(trial.inputs), dict[str, FloatArray]()
        for item, offset in zip(trial.inputs, offsets, strict=True):
            if item.name not in self._inputs:
                known = self._inputs
                raise ModelError(said("models.no_input", trial=trial, item=item, model=self, known=known))
            variable = self._inputs[item.name]
            given[variable] = self.names.input_factors[variable] * (item.values + offset)
        if trial.kind is TrialKind.FLIGHT:
            given = {self.names.variable(str(self.description.inputs.load_factor)): trial.load_factor}
        elif not given or np.any(trial.force):
            acting = self._load(patch).changed(trial.force, trial.force)
            given |= {name: acting * lever for name, lever in self._levers(trial, patch).items()}
        states = [self._state(trial, conditions, patch, row) for row in range(len(trial.time))]
        return self.fmu.at_rest(states, given, self._laws(patch), trial.name)

    # ------------------------------------------------------------ ports

    def _ported(self, trial: Trial, outputs: Outputs, parameters: FloatArray) -> PortedSystem:
        """Return the system by which outputs see missing forces, in the state of that of the prior means.

        Raises
        ------
        ModelError
            If the FMU is not linear, or its answers to forces at the ports do not tell its system.
        """
        fmu = self.fmu
        base, found = (
            fmu.system(fmu.case(trial, self._state(trial, conditions, self.patch), self.ports))
            for values in (self.prior_mean(), parameters)
            for conditions in [Conditions(values, health=trial.health[:1])]
        )
        columns, numbers = np.array(fmu.x, dtype=np.int64), np.arange(len(fmu.x))
        same = base and found and len(base.push) == len(found.push)
        if not (base and found and same) or found.jumps(columns, numbers):
            raise ModelError(said("models.unseen_ports", model=self))
        found = found.in_state_of(base)
        (position, _), (speed, _) = (found.rows(fmu.x, order) for order in (0, 1))
        rows, at_once = found.rows(*self._read(outputs))
        return PortedSystem(found.generator, self.ports, found.push.T, position, speed, rows, at_once.T)

    def port_motion(
        self, trial: Trial, conditions: Conditions, parts: int = 1
    ) -> tuple[FloatArray, FloatArray]:
        """Return positions and speeds (N, P) of the ports in a dynamic trial, without laws."""
        linear, x = self.patch.without(PortForce), self.fmu.x
        return self._moving(trial, conditions, linear, x, [0] * len(self.fmu.x), parts)

    # ------------------------------------------------------------ trials in its names and units

    def _laws(self, patch: ModelPatch) -> Laws:
        return laws_of(patch.of(PortForce), self.ports)

    def _load(self, patch: ModelPatch) -> LoadChange:
        return LoadChange.of(item for item in patch if item.kind not in self.description.effects)

    def _case(self, trial: Trial, conditions: Conditions, patch: ModelPatch, laws: Laws) -> Case:
        """Return what moves the FMU in a dynamic trial."""
        fmu, state = self.fmu, self._state(trial, conditions, patch)
        if trial.kind is not TrialKind.RINGDOWN:
            acting = self._load(patch).changed(trial.force, trial.force)
            case = fmu.case(trial, state, laws.ports, self._levers(trial, patch))
            return case._replace(course=Course(trial.time, acting, trial.hold))
        case = fmu.case(trial, state, laws.ports)
        release = release_of(trial)
        if not fmu.release:
            raise ModelError(said("models.no_release", model=self))
        first_mode = conditions.initial[0] if len(conditions.initial) else np.zeros(2)
        if release.at_rest:
            return case._replace(starts={fmu.release[0]: release.displacement * float(1.0 + first_mode[0])})
        if len(fmu.release) < 2:
            raise ModelError(said("models.moving_release", trial=trial, model=self))
        first = release.displacement * first_mode * (1.0, fmu.usual(trial)[0])
        return case._replace(starts=dict(zip(fmu.release, first.tolist(), strict=True)))

    def _levers(self, trial: Trial, patch: ModelPatch) -> dict[str, float]:
        """Return the inputs that a force at a place of a patch pushes, each with its lever."""
        inputs, load = self.description.inputs, self._load(patch)
        if load.along_chord and inputs.torque is None:
            raise ModelError(said("models.no_torque", model=self))
        moments = ((inputs.bending_moment, load.along_span), (inputs.torque, load.along_chord))
        place = place_among([*self._forces], trial.load_place, self.what, f"the trial {trial.name!r}")
        levers = {self.names.variable(name): lever for name, lever in moments if name is not None and lever}
        return {self._forces[place]: 1.0} | levers

    def _state(
        self, trial: Trial, conditions: Conditions, patch: ModelPatch = NO_PATCH, row: int = 0
    ) -> State:
        """Return parameters and constant inputs of a row of a trial, with what the FMU carries of a patch."""
        names, wanted, effects = self.names, self.description.inputs, self.description.effects
        losses = self.losses(trial, conditions.health)
        health = zip(wanted.regions.values(), losses[min(row, len(losses) - 1)], strict=True)
        inputs = {names.variable(name): value for name, value in health}
        if wanted.temperature is not None:
            warm = float(trial.temperature[0 if trial.is_dynamic else row])
            inputs[names.variable(wanted.temperature)] = (wanted.temperature_reference or 0.0) + warm
        table = self.description.motion if trial.is_dynamic else self.description.static
        parameters = {names.parameter(name): value for name, value in table.parameters.items()}
        parameters |= dict(zip(self._keys, conditions.parameters.tolist(), strict=True))
        for item in (item for item in patch if item.kind in effects):
            effect = f"effect.{effects[item.kind]}"
            if f"{effect}.active" in parameters:
                raise ModelError(f"Of the two primitives {item.kind!r} {self.what} carries one ({effect}).")
            values = {"active": 1.0, **item.to_mapping()}
            parameters |= {f"{effect}.{key}": float(value) for key, value in values.items() if key != "kind"}
        return State((), tuple(sorted(inputs.items()))).having(parameters)


def _any_trial(kind: TrialKind, interval: float) -> Trial:
    """Return a trial that asks for nothing, for scales without a campaign."""
    return Trial.plain("", kind, (), interval * np.arange(1.0 if kind is TrialKind.STATIC else 400.0))
