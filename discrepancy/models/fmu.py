"""Any FMU with a binding as a model: its inputs loaded, its outputs read, internal forces at its ports."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import ClassVar, NamedTuple

import numpy as np

from discrepancy.campaign.records import Campaign, FloatArray, Trial, TrialKind
from discrepancy.errors import ModelError
from discrepancy.models.acting import Course, LoadChange, divided, place_among, release_of
from discrepancy.models.fmu_file import FmuModelDescription
from discrepancy.models.fmu_motion import FmuMotion, Sampled
from discrepancy.models.fmu_pace import Motive, record_of
from discrepancy.models.fmu_runs import State
from discrepancy.models.interface import NO_PATCH, Conditions, Outputs, PortedSystem, Response
from discrepancy.models.model_file import DescribedModel
from discrepancy.models.scales import PortScale, Scales, campaign_sizes
from fe.runtime import patch as changes
from fe.runtime.motion import NO_LAWS, Laws, laws_of
from fe.runtime.patch import INTERNAL_FORCES, SENSORS, ModelPatch, Primitive
from fmu_asset.errors import FmuError


class Asked(NamedTuple):
    """What is asked of the FMU: a trial, in conditions and under a patch by what is done with it.

    Attributes
    ----------
    trial, conditions : Trial, Conditions
        As they come.
    laws : Laws
        Internal forces at ports.
    settings : mapping of str to float
        Parameters that the FMU itself has for primitives.
    load : LoadChange
        Of the recorded force.
    """

    trial: Trial
    conditions: Conditions
    laws: Laws = NO_LAWS
    settings: Mapping[str, float] = MappingProxyType({})
    load: LoadChange = LoadChange()


class FmuModel(DescribedModel):
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

    holds_inputs: ClassVar[bool] = True

    def __init__(self, description: FmuModelDescription, folder: Path | str = ".") -> None:
        self.description: FmuModelDescription = description
        self.fmu = fmu = FmuMotion(description, Path(folder))
        super().__init__(description, fmu.quantities)
        self.length, self.regions = description.scales.length, tuple(description.inputs.regions)
        self.stations = None if self.length is None else (0.0, self.length)
        flies = description.inputs.load_factor is not None
        self.kinds = frozenset(TrialKind) - {TrialKind.DRIVEN, *(() if flies else (TrialKind.FLIGHT,))}
        self._keys = [fmu.parameter(item.variable or item.name) for item in description.parameter]
        self._forces = {place: fmu.variable(name) for place, name in description.inputs.forces.items()}
        self._inputs = {item.name: fmu.variable(item.variable or item.name) for item in description.input}
        self.load_places = tuple(self._forces)
        limits = (fmu.asset.input_range("load", name)[1] for name in self._forces.values())
        self.largest_force = 0.5 * min(limits, default=np.inf)
        for key, item in zip(self._keys, description.parameter, strict=True):
            for end in (item.low, item.high):  # beyond its own range it refuses, and a posterior is cut there
                try:
                    fmu.asset.check_parameters({key: end})
                except FmuError as cause:
                    raise ModelError(
                        f"The FMU model {self.name!r}: [[parameter]] {item.name} has the range {item.low:g} "
                        f"to {item.high:g}, which the FMU {fmu.asset.description.path} cannot have: {cause}"
                    ) from cause
        fmu.nominal = self._state(Asked(_any_trial(TrialKind.RINGDOWN, 1.0), Conditions(self.prior_mean())))

    @classmethod
    def load(cls, path: Path | str) -> "FmuModel":
        """Return the model of a TOML file; raises `ModelError`."""
        return cls(FmuModelDescription.read(path), Path(path).parent)

    def close(self) -> None:
        """End the FMU; it is opened again when it is needed."""
        self.fmu.close()

    def supports(self, primitive: type[Primitive]) -> bool:
        """Whether the model can carry a primitive."""
        description, forces = self.description, bool(self.description.inputs.forces)
        carried = {
            changes.LoadGain: forces,
            changes.LoadPlace: forces and description.inputs.bending_moment is not None,
            changes.StiffnessDrift: False,
        }
        at_port = primitive in INTERNAL_FORCES and bool(description.port)
        own = primitive in SENSORS or primitive.kind in description.effects
        return own or carried.get(primitive, at_port)

    def scales(self, campaign: Campaign) -> Scales:
        """Return the natural scales under a campaign: those of the file, else what the FMU shows."""
        given, fmu, trials = self.description.scales, self.fmu, campaign.trials
        conditions, largest = Conditions(self.prior_mean(campaign)), np.zeros(len(fmu.ports))
        for trial in trials:
            if trial.is_dynamic:
                moved, _ = self._moving(Asked(trial, conditions), fmu.x, [0] * len(fmu.x))
            else:
                moved = self._at_rest(Asked(trial, replace(conditions, health=trial.health)))[:, fmu.x]
            largest = np.maximum(largest, np.max(np.abs(moved), axis=0))
        still = next((item for item in trials if not item.is_dynamic), _any_trial(TrialKind.STATIC, 1.0))
        flexible = fmu.flexibility(self._state(Asked(still, conditions)), range(len(largest)))
        stiffness = [(1.0 / own, 1.0 / own) for own in np.diag(flexible).tolist()]
        frequency, moving = given.angular_frequency, next((item for item in trials if item.is_dynamic), None)
        if moving is not None:
            state = self._state(Asked(moving, conditions))
            frequency = frequency or fmu.pace(moving, state)[0]
            stiffness = fmu.stiffness(state, fmu.usual(moving)[1], record_of(moving)) or stiffness
        interval = 0.01
        for _ in range(0 if trials or frequency else 3):  # until the interval suits it
            trial = _any_trial(TrialKind.RINGDOWN, interval)
            frequency = fmu.pace(trial, self._state(Asked(trial, conditions)))[0]
            interval = 0.3 / frequency
        forces = zip(fmu.forces, stiffness, strict=True)
        pushed = [pair for force, pair in forces if force in self._forces.values()]
        modal, tip = (pushed or stiffness or [(1.0, 1.0)])[0]
        frequency = frequency or 1.0
        return Scales(
            length=given.length or 1.0,
            tip_stiffness=given.tip_stiffness or tip,
            modal_mass=given.modal_mass or modal / frequency**2,
            angular_frequency=frequency,
            **campaign_sizes(campaign),
            ports={
                port: PortScale(float(most) or 1.0, own[0], frequency, own[1])
                for port, most, own in zip(self.ports, largest, stiffness, strict=True)
            },
        )

    # ------------------------------------------------------------ response

    def _respond(self, trial: Trial, outputs: Outputs, patch: ModelPatch, conditions: Conditions) -> Response:
        """Return the response of a trial; `transverse` and `shear` are never known.

        The force of a trial is (1 + gain) times the recorded one, plus the tare where it is not zero.
        """
        asked, (columns, orders) = self._asked(trial, conditions, patch), self._read(outputs)
        if not trial.is_dynamic:
            if any(quantity.order > 0 for _, quantity in outputs):
                raise ModelError(
                    f"The trial {trial.name!r} is at rest, but a channel measures velocity or acceleration."
                )
            return Response(self._at_rest(asked)[:, columns])
        return Response(*self._moving(asked, columns, orders))

    def _read(self, outputs: Outputs) -> tuple[list[int], list[int]]:
        """Return the columns of outputs, and how often each is derived."""
        orders = [quantity.derivatives_of(self.quantities[output]) for output, quantity in outputs]
        return [self.fmu.columns[output] for output, _ in outputs], orders

    def _moving(self, asked: Asked, columns: list[int], orders: list[int], parts: int = 1) -> Sampled:
        """Return columns of the FMU's outputs in a dynamic trial, derived so many times, and their rates.

        At samples that are so many times as dense as those of the trial.
        """
        trial, conditions, laws, *_ = asked
        return self.fmu.motion(
            trial, divided(conditions.stamps(trial.time), parts), self._state(asked), self._motive(asked),
            laws, columns, orders, conditions.refinement,
        )  # fmt: skip

    def _at_rest(self, asked: Asked) -> FloatArray:
        """Return all outputs (N, C) of a static trial or a flight."""
        trial, conditions, laws, _, change = asked
        offsets, given = conditions.offset or (0.0,) * len(trial.inputs), dict[str, FloatArray]()
        for item, offset in zip(trial.inputs, offsets, strict=True):
            if item.name not in self._inputs:
                raise ModelError(
                    f"The trial {trial.name!r} holds the input {item.name!r}, which the FMU model "
                    f"{self.name!r} does not have; it has {', '.join(self._inputs) or 'none'}: name it in "
                    "[[input]]."
                )
            variable = self._inputs[item.name]
            given[variable] = self.fmu.input_factors[variable] * (item.values + offset)
        if trial.kind is TrialKind.FLIGHT:
            given = {self.fmu.variable(str(self.description.inputs.load_factor)): trial.load_factor}
        elif not given or np.any(trial.force):
            acting = change.changed(trial.force, trial.force)
            given |= {name: acting * lever for name, lever in self._levers(asked).items()}
        loads = [dict(zip(given, row, strict=True)) for row in np.array([*given.values()]).T.tolist()]
        states = [self._state(asked, row) for row in range(len(loads))]
        return self.fmu.at_rest(states, loads, laws, trial.name)

    # ------------------------------------------------------------ ports

    def _ported(self, trial: Trial, outputs: Outputs, parameters: FloatArray) -> PortedSystem:
        """Return the system by which outputs see missing forces, in the state of that of the prior means.

        Raises
        ------
        ModelError
            If the FMU is not linear, or its answers to forces at the ports do not tell its system.
        """
        fmu, motive = self.fmu, Motive(self.ports, record=record_of(trial))
        base, found = (
            fmu.system(self._state(self._asked(trial, conditions, self.patch)), fmu.usual(trial)[1], motive)
            for values in (self.prior_mean(), parameters)
            for conditions in [Conditions(values, health=trial.health[:1])]
        )
        if base is None or found is None or len(base.push) != len(found.push):
            raise ModelError(
                f"The FMU model {self.name!r} does not tell by its answers to single forces how its ports "
                "move; it is not linear, or they are too few or too rough."
            )
        found = found.in_state_of(base)
        (position, _), (speed, _) = (found.rows(fmu.x, order) for order in (0, 1))
        rows, at_once = found.rows(*self._read(outputs))
        return PortedSystem(found.generator, self.ports, found.push.T, position, speed, rows, at_once.T)

    def port_motion(
        self, trial: Trial, conditions: Conditions, parts: int = 1
    ) -> tuple[FloatArray, FloatArray]:
        """Return positions and speeds (N, P) of the ports in a dynamic trial, without laws."""
        asked = self._asked(trial, conditions, self.patch)._replace(laws=NO_LAWS)
        return self._moving(asked, self.fmu.x, [0] * len(self.fmu.x), parts)

    # ------------------------------------------------------------ trials in its names and units

    def _asked(self, trial: Trial, conditions: Conditions, patch: ModelPatch = NO_PATCH) -> Asked:
        """Return what is asked under a patch; raises `ModelError` if the file lacks what it needs."""
        effects, what = self.description.effects, f"the FMU model {self.name!r}"
        rest = ModelPatch(tuple(item for item in patch if item.kind not in effects))
        load, settings = LoadChange.of(rest), dict[str, float]()
        if load.along_chord and self.description.inputs.torque is None:
            raise ModelError(f"T{what[1:]} names no torque in [inputs], so no load moves along the chord.")
        for item in (item for item in patch if item.kind in effects):
            effect = f"effect.{effects[item.kind]}"
            if f"{effect}.active" in settings:
                raise ModelError(f"Of the two primitives {item.kind!r} {what} carries one ({effect}).")
            values = {"active": 1.0, **item.to_mapping()}
            settings |= {f"{effect}.{key}": float(value) for key, value in values.items() if key != "kind"}
        laws = laws_of(rest.of(*INTERNAL_FORCES), self.ports)
        return Asked(trial, conditions, laws, settings, load)

    def _motive(self, asked: Asked) -> Motive:
        """Return what moves the FMU in a dynamic trial."""
        (trial, conditions, laws, _, load), fmu = asked, self.fmu
        motive = Motive(tuple(dict.fromkeys(laws.ports)), record=record_of(trial))
        if trial.kind is not TrialKind.RINGDOWN:
            course = Course(trial.time, load.changed(trial.force, trial.force), trial.hold)
            return motive._replace(levers=self._levers(asked), course=course)
        release = release_of(trial)
        if not fmu.release:
            raise ModelError(
                f"The FMU model {self.name!r} cannot ring down: state in [release] the FMU's parameter of "
                f"the release displacement, or the force that holds it."
            )
        first_mode = conditions.initial[0] if len(conditions.initial) else np.zeros(2)
        if release.at_rest:
            return motive._replace(starts={fmu.release[0]: release.displacement * float(1.0 + first_mode[0])})
        if len(fmu.release) < 2:
            raise ModelError(
                f"The ring-down {trial.name!r} does not begin at rest, which the FMU model {self.name!r} "
                f"can follow only if [release] names parameters of displacement and velocity."
            )
        first = release.displacement * first_mode * (1.0, fmu.usual(trial)[0])
        return motive._replace(starts=dict(zip(fmu.release, first.tolist(), strict=True)))

    def _levers(self, asked: Asked) -> dict[str, float]:
        """Return the inputs that a force at a place of a patch pushes, each with its lever."""
        inputs, trial, load = self.description.inputs, asked.trial, asked.load
        moments = ((inputs.bending_moment, load.along_span), (inputs.torque, load.along_chord))
        place = place_among([*self._forces], trial.load_place, self.what, f"the trial {trial.name!r}")
        levers = {self.fmu.variable(name): lever for name, lever in moments if name is not None and lever}
        return {self._forces[place]: 1.0} | levers

    def _state(self, asked: Asked, row: int = 0) -> State:
        """Return parameters and constant inputs of a row of a trial."""
        (trial, conditions, *_), fmu, wanted = asked, self.fmu, self.description.inputs
        losses = self.losses(trial, conditions.health)
        health = zip(wanted.regions.values(), losses[min(row, len(losses) - 1)], strict=True)
        inputs = {fmu.variable(name): value for name, value in health}
        if wanted.temperature is not None:
            warm = float(trial.temperature[0 if trial.is_dynamic else row])
            inputs[fmu.variable(wanted.temperature)] = (wanted.temperature_reference or 0.0) + warm
        table = self.description.motion if trial.is_dynamic else self.description.static
        parameters = {fmu.parameter(name): value for name, value in table.parameters.items()}
        parameters |= dict(zip(self._keys, conditions.parameters.tolist(), strict=True))
        return State((), tuple(sorted(inputs.items()))).having(parameters | dict(asked.settings))


def _any_trial(kind: TrialKind, interval: float) -> Trial:
    """Return a trial that asks for nothing, for scales without a campaign."""
    return Trial.plain("", kind, (), interval * np.arange(1.0 if kind is TrialKind.STATIC else 400.0))
