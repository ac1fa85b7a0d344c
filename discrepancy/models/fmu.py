"""Any FMU with a binding as a model: its inputs loaded, its outputs read, internal forces at its ports."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import ClassVar

import numpy as np

from discrepancy.campaign.records import Campaign, FloatArray, Trial, TrialKind
from discrepancy.errors import ModelError
from discrepancy.models.fmu_file import FmuModelDescription, load_fmu_model
from discrepancy.models.fmu_laws import FmuLaws
from discrepancy.models.fmu_motion import FmuMotion
from discrepancy.models.fmu_ports import FmuPorts
from discrepancy.models.fmu_runs import FmuRuns, State
from discrepancy.models.fmu_trials import Asked, FmuPatch, FmuTrials, sampled
from discrepancy.models.interface import (
    Conditions,
    Outputs,
    PortedSystem,
    PortScale,
    Response,
    Scales,
    campaign_sizes,
)
from discrepancy.models.memory import Memory
from discrepancy.models.model_file import DescribedModel
from discrepancy.models.questions import (
    LoadChange,
    check_carried,
    check_outputs,
    check_parameters,
    check_plain,
    laws_at,
    prior_mean,
)
from fe.runtime.motion import NO_LAWS
from fe.runtime.patch import (
    INTERNAL_FORCES,
    SENSORS,
    LoadGain,
    LoadPlace,
    ModelPatch,
    Primitive,
    StiffnessDrift,
)
from fmu_asset.errors import FmuError

FINER = 2
"""Steps under a recorded force are so many times smaller where laws act on the motion, too."""
KEPT_SHOWN = 16
"""Responses without laws that are kept while laws are tried."""


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

    def __init__(self, description: FmuModelDescription, folder: Path | str = ".") -> None:
        self.description: FmuModelDescription = description
        self.runs = FmuRuns(description, Path(folder))
        super().__init__(description, self.runs.quantities)
        self.length = description.scales.length
        self._trials = FmuTrials(self.runs)
        self._check_ranges()
        means = Conditions(np.array([item.mean for item in self.parameters]))
        nominal = self._trials.state(Asked(_any_trial(TrialKind.RINGDOWN, 1.0), means))
        self._shown = Memory(KEPT_SHOWN)
        self.motion = FmuMotion(self.runs)
        self.fmu_ports = FmuPorts(self.motion, nominal)
        self._laws = FmuLaws(self.fmu_ports)

    @classmethod
    def load(cls, path: Path | str) -> "FmuModel":
        """Return the model of a TOML file; raises `ModelError`."""
        return cls(load_fmu_model(path), Path(path).parent)

    def close(self) -> None:
        """End the FMU; it is opened again when it is needed."""
        self.runs.close()

    def _check_ranges(self) -> None:
        """Refuse ranges of parameters that are wider than those of the FMU."""
        asset = self.runs.asset
        for item in self.description.parameter:
            key = self.runs.parameter(item.variable or item.name)
            for end in (item.low, item.high):  # beyond its own range it refuses, and a posterior is cut there
                try:
                    asset.check_parameters({key: end})
                except FmuError as cause:
                    raise ModelError(
                        f"The FMU model {self.name!r}: [[parameter]] {item.name} has the range {item.low:g} "
                        f"to {item.high:g}, which the FMU {asset.description.path} cannot have: {cause}"
                    ) from cause

    # ------------------------------------------------------------ what it is

    shows_ports: ClassVar[bool] = True

    def supports(self, primitive: type[Primitive]) -> bool:
        """Whether the model can carry a primitive."""
        description, forces = self.description, bool(self.description.inputs.forces)
        if primitive in SENSORS or primitive.kind in description.effects:
            return True
        if primitive is LoadGain:
            return forces
        if primitive is LoadPlace:
            return forces and description.inputs.bending_moment is not None
        return primitive in INTERNAL_FORCES and primitive is not StiffnessDrift and bool(description.port)

    def scales(self, campaign: Campaign) -> Scales:
        """Return the natural scales under a campaign: those of the file, else what the FMU shows."""
        given, conditions = self.description.scales, Conditions(prior_mean(campaign, self.declared))
        largest = np.zeros(len(self.ports()))
        for trial in campaign.trials:
            if trial.is_dynamic:
                moved = self.motion.free(self._trials.run(Asked(trial, conditions), self.fmu_ports, 1))
            else:
                moved = self._at_rest(Asked(trial, replace(conditions, health=trial.health)))
            largest = np.maximum(largest, np.max(np.abs(moved[:, self.fmu_ports.x]), axis=0))
        stiffness, frequency = self._stiffness(campaign, conditions)
        forces = zip(self.fmu_ports.forces, stiffness, strict=True)
        pushed = [pair for force, pair in forces if force in self._trials.forces.values()]
        modal, tip = (pushed or stiffness or [(1.0, 1.0)])[0]
        frequency = given.angular_frequency or frequency or 1.0
        return Scales(
            length=given.length or 1.0,
            tip_stiffness=given.tip_stiffness or tip,
            modal_mass=given.modal_mass or modal / frequency**2,
            angular_frequency=frequency,
            **campaign_sizes(campaign),
            ports={
                port: PortScale(float(most) or 1.0, own[0], frequency, own[1])
                for port, most, own in zip(self.ports(), largest, stiffness, strict=True)
            },
        )

    def _stiffness(
        self, campaign: Campaign, conditions: Conditions
    ) -> tuple[list[tuple[float, float]], float | None]:
        """Return modal and static stiffness at each port, and the frequency if the FMU was asked for it."""
        given, ports = self.description.scales.angular_frequency, range(len(self.ports()))
        for trial in campaign.trials:
            if trial.is_dynamic:
                state = self._trials.state(Asked(trial, conditions))
                step = self.fmu_ports.step(trial, 1)
                found = [self.fmu_ports.stiffness(number, state, step) for number in ports]
                return found, given or self.fmu_ports.measured_frequency(trial, state)
        still = campaign.trials[0] if campaign.trials else _any_trial(TrialKind.STATIC, 1.0)
        state = self._trials.state(Asked(still, replace(conditions, health=still.health)))
        flexible = self.fmu_ports.flexibility(state)
        frequency, interval = given, 0.01
        for _ in range(0 if campaign.trials or given else 3):  # until the interval suits the frequency
            trial = _any_trial(TrialKind.RINGDOWN, interval)
            state = self._trials.state(Asked(trial, conditions))
            frequency = self.fmu_ports.measured_frequency(trial, state)
            interval = 0.3 / frequency
        return [(1.0 / float(flexible[port, port]),) * 2 for port in ports], frequency

    # ------------------------------------------------------------ response

    def _respond(self, trial: Trial, outputs: Outputs, patch: ModelPatch, conditions: Conditions) -> Response:
        """Return the response of a trial; `transverse` and `shear` are never known.

        The force of a trial is (1 + gain) times the recorded one, plus the tare where it is not zero.
        """
        check_plain(trial, f"the FMU model {self.name!r}")
        check_parameters(f"The FMU model {self.name!r}", self.parameters, conditions.parameters)
        columns = self._columns(outputs)
        asked = Asked(trial, conditions, self._parts(patch))
        if not trial.is_dynamic:
            if any(quantity.is_rate for _, quantity in outputs):
                raise ModelError(
                    f"The trial {trial.name!r} is at rest, but a channel measures velocity or acceleration."
                )
            return Response(self._at_rest(asked)[:, columns])
        return self._moving(asked, columns, self._orders(outputs))

    def _moving(self, asked: Asked, columns: Sequence[int], orders: Sequence[int]) -> Response:
        """Return columns of the FMU's outputs at the samples of a dynamic trial, derived so many times."""
        trial, conditions, patch = asked
        excite = partial(self._trials.run, asked, self.fmu_ports)
        laws, (rate, zero) = patch.laws, conditions.clock
        finer = FINER if len(laws) and trial.kind is TrialKind.FORCED else 1
        run = excite(conditions.refinement * finer)

        def shown(values: FloatArray, step: float) -> Response:
            return sampled(values, step, (1.0 + rate) * trial.time + zero, orders)

        free = self.motion.free(run)
        added = self._laws.added(laws, run, free, trial, columns) if len(laws) else None
        if len(laws) and added is None:
            return shown(*self._laws.stepped(laws, excite, trial, conditions.refinement, columns))
        key = (*columns, *orders, rate, zero, trial.time.tobytes(), run.key)
        found = self._shown.get(key, lambda: shown(free[:, columns], run.step))
        if added is None:
            return found
        further = shown(*added)
        assert found.rates is not None  # of a motion there are
        assert further.rates is not None
        return Response(found.values + further.values, found.rates + further.rates)

    # ------------------------------------------------------------ ports

    def _ported(self, trial: Trial, outputs: Outputs, parameters: FloatArray) -> PortedSystem:
        """Return the system by which outputs see missing forces, in the state of that of the prior means.

        Raises
        ------
        ModelError
            If the FMU is not linear, or its answers to forces at the ports do not tell its system.
        """
        means = np.array([item.mean for item in self.declared])
        parts, step = self._parts(self.patch), self.fmu_ports.step(trial)
        states = (
            self._trials.state(Asked(trial, Conditions(values, health=trial.health[:1]), parts))
            for values in (means, parameters)
        )
        base, found = (self.fmu_ports.system(state, step, len(trial.time)) for state in states)
        if base is None or found is None or len(base.push) != len(found.push):
            raise ModelError(
                f"The FMU model {self.name!r} does not tell by its answers to single forces how its ports "
                "move; it is not linear, or they are too few or too rough."
            )
        found = found.in_state_of(base)
        position, speed = np.split(found.of_ports(self.fmu_ports.x, self.fmu_ports.v).outputs, 2)
        rows, at_once = found.rows(list(zip(self._columns(outputs), self._orders(outputs), strict=True)))
        return PortedSystem(found.generator, self.ports(), found.push.T, position, speed, rows, at_once.T)

    def port_motion(self, trial: Trial, conditions: Conditions) -> tuple[FloatArray, FloatArray]:
        """Return positions and speeds (N, P) of the ports in a dynamic trial, without laws."""
        asked = Asked(trial, conditions, self._parts(self.patch)._replace(laws=NO_LAWS))
        found = self._moving(asked, self.fmu_ports.x, [0] * len(self.ports()))
        assert found.rates is not None  # of a motion there are
        return found.values, found.rates

    # ------------------------------------------------------------ rest

    def _at_rest(self, asked: Asked) -> FloatArray:
        """Return all outputs (N, C) of a static trial or a flight."""
        trial, _, patch = asked
        loads = self._trials.loads_at_rest(asked)
        states = [self._trials.state(asked, row) for row in range(len(loads))]
        if not len(patch.laws):
            return np.stack(
                [self._rest(trial, row, *held) for row, held in enumerate(zip(states, loads, strict=True))]
            )
        return self._laws.at_rest(trial.name, states, loads, patch.laws)

    def _rest(self, trial: Trial, row: int, state: State, loads: dict[str, float]) -> FloatArray:
        """Return all outputs (C,) of a row; what the FMU refuses is said with its place."""
        try:
            return self.motion.rest(state, loads)
        except ModelError as cause:
            raise ModelError(f"The trial {trial.name!r}, row {row + 1} of its table: {cause}") from cause

    # ------------------------------------------------------------ parts

    def _parts(self, patch: ModelPatch) -> FmuPatch:
        """Return a patch by what is done with it; raises `ModelError` if the model cannot carry it."""
        effects, what = self.description.effects, f"The FMU model {self.name!r}"
        check_carried(patch, self, what)
        rest = ModelPatch(tuple(item for item in patch if item.kind not in effects))
        load = LoadChange.of(rest)
        if load.along_chord and self.description.inputs.torque is None:
            raise ModelError(f"{what} names no torque in [inputs], so a load cannot move along the chord.")
        settings: dict[str, float] = {}
        for item in patch:
            if item.kind not in effects:
                continue
            effect = f"effect.{effects[item.kind]}"
            if f"{effect}.active" in settings:
                raise ModelError(
                    f"The patch has two primitives {item.kind!r}, but the FMU model {self.name!r} "
                    f"carries one ({effect})."
                )
            values = {key: value for key, value in item.to_mapping().items() if key != "kind"}
            settings |= {f"{effect}.{key}": float(value) for key, value in {"active": 1.0, **values}.items()}
        laws = laws_at(rest.of(*INTERNAL_FORCES), self.ports(), in_windows=False)
        return FmuPatch(laws, tuple(sorted(settings.items())), load)

    def _columns(self, outputs: Outputs) -> list[int]:
        check_outputs(f"The FMU model {self.name!r}", self, outputs, self.quantities)
        return [self.runs.columns[output] for output, _ in outputs]

    def _orders(self, outputs: Outputs) -> list[int]:
        """Return how often each output is derived."""
        return [quantity.derivatives_of(self.quantities[output]) for output, quantity in outputs]


def _any_trial(kind: TrialKind, interval: float) -> Trial:
    """Return a trial that asks for nothing, for scales without a campaign."""
    return Trial.plain("", kind, (), interval * np.arange(1.0 if kind is TrialKind.STATIC else 400.0))
