"""A lumped linear structure as a model: masses, springs, dampers with named inputs, outputs and ports."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from discrepancy.campaign.records import Campaign, Quantity, Start, Trial, TrialKind
from discrepancy.errors import ModelError
from discrepancy.models.input_course import Course, acting_force
from discrepancy.models.interface import (
    Conditions,
    ModelParameter,
    PortScale,
    Response,
    Scales,
    check_lumped,
)
from discrepancy.models.lumped_file import LumpedDescription, load_lumped, matrix_of
from discrepancy.models.lumped_rig import LumpedRig
from discrepancy.models.lumped_scales import rig_scales, state_sizes
from discrepancy.models.lumped_sections import Damping
from discrepancy.models.memory import Memory
from discrepancy.models.patch_parts import laws_at, sorted_lumped
from discrepancy.models.ported_lumped import PortedLumped
from discrepancy.models.second_order import SecondOrderSystem
from fe.runtime.laws import LAWS
from fe.runtime.motion import NO_LAWS, laws_of
from fe.runtime.patch import (
    INTERNAL_FORCES,
    SENSORS,
    LoadGain,
    LoadPlace,
    ModelPatch,
    ModulusTemperature,
    PointMass,
    PortLoad,
    Primitive,
    RootCompliance,
    StiffnessDrift,
)
from reporting.words import counted

FloatArray = NDArray[np.float64]

DEFAULT_PLACE = "tip_load"
"""What a campaign says when it does not say where the force acts; a model with one input takes that one."""
KEPT_SYSTEMS = 128
"""Structures whose modes are remembered."""
LEAST_STIFFNESS = 0.05
"""A temperature that leaves less than this share of the stiffness is refused."""


class LumpedModel(PortedLumped):
    """A lumped model (`discrepancy.models.interface.Model`).

    Parameters
    ----------
    description : LumpedDescription
        Content of its file.

    Notes
    -----
    Damping that is given as modal ratios stays at these ratios when the structure changes. Health (z1, z2)
    has no meaning here and is passed over.
    """

    def __init__(self, description: LumpedDescription) -> None:
        self.description = description
        self._inputs = {item.name: item for item in description.input}
        self._outputs = {item.name: np.array(item.vector or ()) for item in description.output}
        self._quantities = {item.name: item.quantity for item in description.output}
        self._ports = {item.name: np.array(item.vector) for item in description.port}
        places = sorted(description.place, key=lambda place: place.station)
        self._stations = np.array([place.station for place in places])
        self._place_rows = np.array([place.vector for place in places])
        self._parameters = tuple(
            ModelParameter(item.name, item.mean, item.deviation, item.unit, item.low, item.high)
            for item in description.parameter
        )
        self._systems = Memory(KEPT_SYSTEMS)

    @classmethod
    def load(cls, path: Path | str) -> "LumpedModel":
        """Return the model of a TOML file, or a shipped one by name; raises `ModelError`."""
        return cls(load_lumped(path))

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
        return self._quantities.get(output)

    def supports(self, primitive: type[Primitive]) -> bool:
        """Whether the model can carry a primitive."""
        plain = self.description.is_plain
        if primitive is StiffnessDrift and not plain:
            return self.description.size > 0
        if primitive in LAWS and not plain and not primitive.of_speed:
            n = self.description.size  # the position of a state's port means nothing
            return bool(self._ports) and all(np.any(row[:n]) for row in self._ports.values())
        if primitive is PortLoad:
            return bool(self._ports)
        if primitive in SENSORS or primitive in (ModulusTemperature, LoadGain, StiffnessDrift):
            return True
        if primitive is PointMass:
            return len(self._stations) > 0
        if primitive is RootCompliance:
            return self.description.root is not None
        if primitive is LoadPlace:
            return any(item.station_derivative is not None for item in self.description.input)
        return primitive in INTERNAL_FORCES and bool(self._ports)

    follows_windows: ClassVar[bool] = True

    def ports(self) -> tuple[str, ...]:
        """Names of the ports."""
        return tuple(self._ports)

    def stations(self) -> tuple[float, float] | None:
        """Return the least and largest station [m] of the places, None without places."""
        if not len(self._stations):
            return None
        return float(self._stations[0]), float(self._stations[-1])

    def scales(self, campaign: Campaign) -> Scales:
        """Return the natural scales under a campaign."""
        if any(self._as_rig(trial) for trial in campaign.trials):
            return rig_scales(
                self._rig(self._prior_mean(campaign), (), 0.0),
                self._prior_mean(campaign),
                campaign,
                self.stations(),
            )
        conditions = Conditions(self._prior_mean(campaign))
        system = self._system(conditions.parameters, (), 0.0)
        loaded = [trial.load_place for trial in campaign.trials if trial.kind is not TrialKind.FLIGHT]
        row = self._input_row(loaded[0]) if loaded else np.array(self.description.input[0].vector)
        first = system.angular_frequency[0]
        participation = float(row @ system.shapes[:, 0]) ** 2
        flexible = float(row @ system.flexibility(row))
        largest, usual = dict.fromkeys(self._ports, 0.0), dict.fromkeys(self._ports, 0.0)
        fitted = {trial.name for trial in campaign.fitted if trial.is_dynamic}
        port_rows = np.array(list(self._ports.values())).reshape(len(self._ports), self.description.size)
        for trial in campaign.trials if self._ports else ():
            if trial.kind is TrialKind.FLIGHT:
                continue
            motion = self._still_or_moving(trial, system, conditions)
            for name, size in zip(self._ports, np.max(np.abs(motion @ port_rows.T), axis=0), strict=True):
                largest[name] = max(largest[name], float(size))
                if trial.name in fitted:
                    usual[name] = max(usual[name], float(size))
        dynamic = [trial for trial in campaign.trials if trial.is_dynamic]
        moments = [
            trial.start + (trial.time if trial.is_dynamic else trial.time - trial.start)
            for trial in campaign.trials
        ]
        span = float(max(map(np.max, moments)) - min(map(np.min, moments))) if moments else 0.0
        ends = self.stations()
        return Scales(
            length=self.description.characteristic_length or (max(map(abs, ends)) if ends else 0.0) or 1.0,
            tip_stiffness=1.0 / flexible,
            modal_mass=1.0 / participation
            if participation
            else float(np.trace(self.description.whole("mass"))),
            angular_frequency=float(first),
            force=max((float(np.max(np.abs(trial.force))) for trial in campaign.trials), default=0.0),
            load_factor=max((float(np.max(np.abs(t.load_factor))) for t in campaign.trials), default=0.0),
            duration=max((float(trial.time[-1] - trial.time[0]) for trial in dynamic), default=1.0),
            campaign_time=span if span > 0.0 else 1.0,
            ports={
                name: self._port_scale(system, vector, usual[name] or largest[name], largest[name])
                for name, vector in self._ports.items()
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
        check_lumped(trial, f"the lumped model {self.name!r}")
        self._check_outputs(outputs)
        own = patch.in_trial(trial.name)
        structure, forces, (gain, tare, along_span, along_chord), loads = sorted_lumped(own, self)
        forces = self.description.own_laws(self._factors(conditions.parameters)) + forces
        laws = laws_at(forces, self._ports)
        acting = acting_force(trial, gain, tare)
        switched = bool(laws.spans) and trial.kind is not TrialKind.RINGDOWN
        if self._as_rig(trial) or loads or switched:
            lumped = self._rig(conditions.parameters, structure, float(trial.temperature[0]))
            place = self._moved_place(lumped, trial, along_span, along_chord)
            return lumped.response(trial, outputs, laws, conditions, (gain, tare, place, loads), refinement)
        rows = np.array([self._outputs[output] for output, _ in outputs]).reshape(-1, self.description.size)
        row = self._input_row(trial.load_place)
        if trial.kind is TrialKind.STATIC:
            if any(quantity.is_rate for _, quantity in outputs):
                raise ModelError(
                    f"The trial {trial.name!r} is static, but a channel measures velocity or acceleration."
                )
            row = self._moved_row(trial.load_place, row, along_span, along_chord)
            if len(laws) and len(np.unique(trial.temperature)) > 1 and self._coefficient(structure):
                return Response(
                    self._static_by_level(trial, acting, row, rows, structure, conditions, forces)
                )
            values = np.empty((len(acting), len(rows)))
            for temperature in np.unique(trial.temperature) if self._coefficient(structure) else (0.0,):
                at = trial.temperature == temperature if self._coefficient(structure) else slice(None)
                system = self._system(conditions.parameters, structure, float(temperature))
                values[at] = system.static(np.outer(acting[at], row), laws) @ rows.T
            return Response(values)
        system = self._system(conditions.parameters, structure, float(trial.temperature[0]))
        if trial.kind is TrialKind.RINGDOWN:
            if trial.release is None:
                raise ModelError(f"The ring-down {trial.name!r} does not say how it was released.")
            motion = system.ringdown(
                row, trial.release, conditions.initial, trial.time, laws,
                clock=conditions.clock, refinement=refinement,
            )  # fmt: skip
        else:
            row = self._moved_row(trial.load_place, row, along_span, along_chord)
            motion = system.forced(
                row, Course.of_force(trial, gain, tare), trial.time, laws, clock=conditions.clock,
                refinement=refinement,
            )  # fmt: skip
        return motion.response(rows, [quantity for _, quantity in outputs])

    @property
    def oscillates(self) -> bool:
        """Whether it has a mode that vibrates."""
        rig = self._rig(self._mean, (), 0.0).rig()
        return self.description.is_plain or bool(np.any(rig.angular_frequency > 0.0))

    def initial_sizes(self, campaign: Campaign, trial: Trial) -> FloatArray:
        """Return natural sizes (L,) of the state at the begin of a driven or forced trial."""
        return state_sizes(
            self._rig(self._prior_mean(campaign), (), 0.0),
            campaign,
            trial,
            Conditions(self._prior_mean(campaign)),
        )

    # ------------------------------------------------------------ rigs

    def _moved_place(
        self, lumped: LumpedRig, trial: Trial, along_span: float, along_chord: float
    ) -> FloatArray | None:
        """Return the row of the first input where its place has moved, None where it has not."""
        if not (along_span or along_chord):
            return None
        name = lumped.recorded(trial)[0].name
        return self._moved_row(name, self._input_row(name), along_span, along_chord)

    def _as_rig(self, trial: Trial) -> bool:
        """Whether a trial asks for more than a structure on springs under one force."""
        return (
            not self.description.is_plain
            or trial.kind is TrialKind.DRIVEN
            or trial.begins is not Start.SETTLED
        )

    def _prior_mean(self, campaign: Campaign) -> FloatArray:
        given = campaign.parameters
        return np.array([given.get(item.name, (item.mean, 0.0))[0] for item in self._parameters])

    # ------------------------------------------------------------ parts

    def _check_outputs(self, outputs: Sequence[tuple[str, Quantity]]) -> None:
        for output, quantity in outputs:
            own = self._quantities.get(output)
            if own is None:
                raise ModelError(
                    f"The lumped model {self.name!r} has no output {output!r}; it has "
                    f"{', '.join(self._outputs)}."
                )
            if not quantity.shows(own):
                raise ModelError(
                    f"The output {output!r} of {self.name!r} is a {own.value}, but a channel measures "
                    f"{quantity.value}."
                )

    def _input_row(self, place: str | tuple[float, float]) -> FloatArray:
        if place == DEFAULT_PLACE and place not in self._inputs and len(self._inputs) == 1:
            place = next(iter(self._inputs))
        if not isinstance(place, str) or place not in self._inputs:
            raise ModelError(
                f"The load place {place!r} is not an input of the lumped model {self.name!r}; it has "
                f"{', '.join(self._inputs)}."
            )
        return np.array(self._inputs[place].vector)

    def _moved_row(
        self, place: str | tuple[float, float], row: FloatArray, along_span: float, along_chord: float
    ) -> FloatArray:
        if along_span == 0.0 and along_chord == 0.0:
            return row
        item = self._inputs.get(str(place), self.description.input[0])
        if item.station_derivative is None:
            raise ModelError(
                f"The input {item.name!r} of {self.name!r} declares no station_derivative, so its "
                f"place cannot move."
            )
        row = row + along_span * np.array(item.station_derivative)
        return row if item.chord_derivative is None else row + along_chord * np.array(item.chord_derivative)

    @staticmethod
    def _coefficient(structure: Sequence[Primitive]) -> float:
        return sum(item.coefficient for item in structure if isinstance(item, ModulusTemperature))

    def _system(
        self, parameters: FloatArray, structure: tuple[Primitive, ...], temperature: float
    ) -> SecondOrderSystem:
        """Return the structure at values of the parameters and a temperature above the reference [K]."""
        softening = self._coefficient(structure) * temperature
        key = (parameters.tobytes(), structure, softening)
        return self._systems.get(key, lambda: self._made(parameters, structure, softening))

    def _rig(self, parameters: FloatArray, structure: tuple[Primitive, ...], temperature: float) -> LumpedRig:
        """Return the same as a rig."""
        softening = self._coefficient(structure) * temperature

        def make() -> LumpedRig:
            mass, stiffness, factors = self._matrices(parameters, structure, softening)
            return LumpedRig(self.description, mass, stiffness, factors)

        return self._systems.get(("rig", parameters.tobytes(), structure, softening), make)

    def _factors(self, parameters: FloatArray) -> dict[str, float]:
        """Return the factors of the terms at values of the parameters."""
        if parameters.shape != (len(self._parameters),):
            raise ModelError(
                f"The lumped model {self.name!r} has {counted(len(self._parameters), 'parameter')}, but "
                f"{parameters.size} came."
            )
        factors: dict[str, float] = {}
        for item, value in zip(self.description.parameter, parameters, strict=True):
            for term in item.scaled:
                factors[term] = factors.get(term, 1.0) * float(value)
        return factors

    def _matrices(
        self, parameters: FloatArray, structure: tuple[Primitive, ...], softening: float
    ) -> tuple[FloatArray, FloatArray, dict[str, float]]:
        """Return mass and stiffness (n, n), patched, and the factors of the terms."""
        description, factors = self.description, self._factors(parameters)
        if 1.0 - softening < LEAST_STIFFNESS:
            raise ModelError(
                f"The temperature leaves {1.0 - softening:.2g} of the stiffness, which no structure has."
            )
        softened = factors | {"stiffness": factors.get("stiffness", 1.0) * (1.0 - softening)}
        mass, stiffness = description.whole("mass", factors), description.whole("stiffness", softened)
        for change in structure:
            if isinstance(change, PointMass):
                row = self._place_row(change.station)
                mass += change.mass * np.outer(row, row)
            elif isinstance(change, RootCompliance) and description.root is not None:
                # in series: K^-1 + c l l^T, by Sherman and Morrison
                pull = stiffness @ np.array(description.root.lever)
                stiff = float(pull @ np.array(description.root.lever))
                stiffness -= np.outer(pull, pull) * change.compliance / (1.0 + change.compliance * stiff)
        return mass, stiffness, factors

    def _made(
        self, parameters: FloatArray, structure: tuple[Primitive, ...], softening: float
    ) -> SecondOrderSystem:
        mass, stiffness, factors = self._matrices(parameters, structure, softening)
        system = SecondOrderSystem(mass, np.zeros_like(mass), stiffness, self._ports)
        damping = self.description.damping or Damping(alpha=0.0)
        if damping.matrix is not None:
            matrix = matrix_of(damping.matrix)
        elif damping.ratios is not None:
            whole = replace(system, mode_count=len(mass))
            weighted = mass @ whole.shapes
            matrix = (weighted * (2.0 * np.array(damping.ratios) * whole.angular_frequency)) @ weighted.T
        else:
            matrix = (damping.alpha or 0.0) * mass + (damping.beta or 0.0) * stiffness
        scale = factors.get("damping", 1.0)
        return replace(system, damping=scale * matrix, relaxation=scale * (damping.beta or 0.0))

    def _place_row(self, station: float) -> FloatArray:
        """Return the row at a station, linear between the places."""
        rows = self._place_rows
        return np.array([np.interp(station, self._stations, rows[:, k]) for k in range(rows.shape[1])])

    def _static_by_level(
        self,
        trial: Trial,
        acting: FloatArray,
        row: FloatArray,
        rows: FloatArray,
        structure: tuple[Primitive, ...],
        conditions: Conditions,
        forces: ModelPatch,
    ) -> FloatArray:
        """Return static values (N, C) where stiffness changes along the load path of laws with a memory."""
        laws = laws_of(forces, self._ports)
        values = np.empty((len(acting), len(rows)))
        memory: FloatArray | None = None
        before = np.zeros(self.description.size)
        for level, (force, temperature) in enumerate(zip(acting, trial.temperature, strict=True)):
            system = self._system(conditions.parameters, structure, float(temperature))
            u, memory = system.static_step(force * row, laws, memory, before)
            before = force * row
            values[level] = rows @ u
        return values

    def _still_or_moving(self, trial: Trial, system: SecondOrderSystem, conditions: Conditions) -> FloatArray:
        """Return displacements (N, n) of a trial by the unpatched model."""
        row = self._input_row(trial.load_place)
        if trial.kind is TrialKind.STATIC:
            return system.static(np.outer(trial.force, row), NO_LAWS)
        if trial.kind is TrialKind.FORCED:
            return system.forced(row, Course.of_force(trial), trial.time, NO_LAWS).q @ system.shapes.T
        size = trial.release.displacement if trial.release is not None else 0.0
        shape = system.flexibility(row)
        return (size / float(row @ shape) * shape)[None]

    @staticmethod
    def _port_scale(system: SecondOrderSystem, vector: FloatArray, usual: float, largest: float) -> PortScale:
        first = float(system.angular_frequency[0])
        moved = float(vector @ system.shapes[:, 0])
        still = 1.0 / float(vector @ system.flexibility(vector))
        # A port that the first mode does not move has its static stiffness.
        stiffness = first**2 / moved**2 if moved**2 / first**2 * still > 1e-6 else still
        return PortScale(usual or 1.0, stiffness, first, still, largest or 1.0)
