"""A lumped linear structure as a model: masses, springs, dampers with named inputs, outputs and ports."""

from pathlib import Path
from typing import ClassVar, Self

import numpy as np

from discrepancy.campaign.records import FloatArray, Hold, Quantity, RecordedInput, Trial, TrialKind
from discrepancy.campaign.units import UNITS
from discrepancy.errors import ModelError
from discrepancy.models.acting import (
    Acting,
    Course,
    FormulaCourse,
    Load,
    LoadChange,
    Shown,
    order_of,
    place_among,
)
from discrepancy.models.interface import NO_PATCH, Outputs, Place
from discrepancy.models.lumped_file import LumpedDescription, load_lumped
from discrepancy.models.lumped_rig import Loop, LumpedRig
from discrepancy.models.lumped_sections import InputSection
from discrepancy.models.memory import Memory
from discrepancy.models.model_file import DescribedModel
from discrepancy.models.second_order import SecondOrderSystem
from discrepancy.models.system_model import Case, State, SystemModel
from fe.runtime.laws import LAWS
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
    course_of,
)
from fe.runtime.state import Losses

KEPT_RIGS = 128
"""Values of the parameters and structures that are remembered."""
LEAST_STIFFNESS = 0.05
"""A temperature that leaves less than this share of the stiffness is refused."""


class LumpedModel(DescribedModel, SystemModel):
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
        super().__init__(description, {item.name: item.quantity for item in description.output})
        self.load_places = tuple(item.name for item in description.input)
        self.kinds = frozenset(TrialKind) - {TrialKind.FLIGHT}
        if not description.is_plain:
            self.kinds -= {TrialKind.RINGDOWN}
        self.displacements, self.length = description.size, description.characteristic_length
        self.port_rows = {item.name: description.padded(item.vector) for item in description.port}
        self._stations = sorted(place.station for place in description.place)
        self._inputs = {item.name: item for item in description.input}
        self._outputs = {item.name: item for item in description.output}
        self._rigs = Memory(KEPT_RIGS)

    @classmethod
    def load(cls, path: Path | str) -> "LumpedModel":
        """Return the model of a TOML file, or a shipped one by name; raises `ModelError`."""
        return cls(load_lumped(path))

    # ------------------------------------------------------------ what it is

    def supports(self, primitive: type[Primitive]) -> bool:
        """Whether the model can carry a primitive."""
        description, ports = self.description, list(self.port_rows.values())
        if primitive in LAWS and not primitive.of_speed:  # the position of a state's port means nothing
            return bool(ports) and all(np.any(row[: description.size]) for row in ports)
        carried: dict[type[Primitive], bool] = {
            StiffnessDrift: description.size > 0,
            ModulusTemperature: True,
            PointMass: bool(self._stations),
            RootCompliance: description.root is not None,
            LoadGain: True,
            LoadPlace: any(item.station_derivative is not None for item in description.input),
            PortLoad: bool(ports),
        }
        return carried.get(primitive, primitive in SENSORS or (primitive in INTERNAL_FORCES and bool(ports)))

    follows_windows: ClassVar[bool] = True

    def stations(self) -> tuple[float, float] | None:
        """Return the least and largest station [m] of the places, None without places."""
        return (self._stations[0], self._stations[-1]) if self._stations else None

    # ------------------------------------------------------------ in a trial

    def own_laws(self, parameters: FloatArray) -> ModelPatch:
        """Return the laws of ports that it has as it is, each times its factor."""
        factors = self._factors(parameters)
        return ModelPatch(tuple(law.scaled(factors.get(law.name, 1.0)) for law in self.description.law))

    def system(self, state: State) -> SecondOrderSystem:
        """Return the rig, with prescribed motions and controllers as the state says."""
        return self.rig(state).system(state.drives, closed=state.closed)

    def force_row(self, place: Place, state: State, change: ModelPatch = NO_PATCH) -> FloatArray:
        """Return the load (N,) of 1 N, or of what else an input is, at its place."""
        return self._moved_row(self.rig(state), self._input_at(place), LoadChange.of(change))

    def constant(self, case: Case) -> FloatArray:
        """Return the load (N,) that always acts."""
        return self.rig(case.state).constant

    def pushes(self, case: Case) -> tuple[list[Load], dict[str, Course]]:
        """Return loads and prescribed motions in a trial.

        Every motion that an input can prescribe and that the trial does not record is held at zero, if an
        output is its reaction; else it is free.

        Raises
        ------
        ModelError
            If the trial records an input that the model does not have or that is of another quantity.
        """
        trial, _, patch, state = case
        rig, change = self.rig(state), LoadChange.of(patch)
        loads = [load for loop in rig.loops.values() for load in self._reference(case, loop)]
        followed = {loop.section.reference for loop in rig.loops.values()}
        reactions = {item.reaction for item in self.description.output}
        still = Course.of(trial.time, np.zeros(len(trial.time)), Hold.SMOOTH, 0)
        drives = {name: still for name, item in self._inputs.items() if name in reactions}
        for item, offset in self._recorded(case):
            if item.name in followed:
                continue
            section = self._section(trial, item)
            values = item.values + offset if offset else item.values
            if section.quantity.moving:
                if item.hold not in (None, Hold.SMOOTH):
                    raise ModelError(
                        f"The input {item.name!r} of the trial {trial.name!r} is a motion that "
                        f"{self.name!r} prescribes, which no drive makes in steps or corners: leave "
                        "`reference` and `hold` out."
                    )
                values = rig.factors.get(item.name, 1.0) * values
                drives[item.name] = Course.of(trial.time, values, Hold.SMOOTH, order_of(item.quantity))
                continue
            if item.quantity in (Quantity.FORCE, Quantity.TORQUE):
                values = change.changed(values, item.values)
            loads.append((self._moved_row(rig, section, change), Course.of(trial.time, values, item.hold)))
        loads += [self._at_port(rig, item) for item in patch if isinstance(item, PortLoad)]
        return loads, drives

    def _recorded(self, case: Case) -> list[tuple[RecordedInput, float]]:
        """Return the recorded inputs of a trial, or its force at its place, and what each lacks."""
        trial, recorded = case.trial, case.trial.inputs
        if trial.kind is not TrialKind.DRIVEN:
            item = self._input_at(trial.load_place)
            recorded = (RecordedInput(item.name, item.quantity, trial.force, trial.hold),)
        return list(zip(recorded, (*case.conditions.offset, *(0.0,) * len(recorded)), strict=False))

    def _reference(self, case: Case, loop: Loop) -> list[Load]:
        """Return what the recorded reference of a controller does."""
        return [
            load
            for item, offset in self._recorded(case)
            if item.name == loop.section.reference
            for load in loop.loads(case.trial, item, offset)
        ]

    def _input_at(self, place: Place) -> InputSection:
        """Return the input of a load place; raises `ModelError` if there is none."""
        forces = [name for name, item in self._inputs.items() if not item.quantity.moving]
        known = [*self._inputs] if place in self._inputs else forces
        return self._inputs[place_among(known, place, self.what)]

    def _moved_row(self, rig: LumpedRig, item: InputSection, change: LoadChange) -> FloatArray:
        """Return the row (N,) along which an input acts, where its place has been moved to."""
        row = np.array(item.vector)
        if change.along_span or change.along_chord:
            if item.station_derivative is None:
                raise ModelError(
                    f"The input {item.name!r} of {self.name!r} declares no station_derivative, so its place "
                    "cannot move."
                )
            row = row + change.along_span * np.array(item.station_derivative)
            if item.chord_derivative is not None:
                row = row + change.along_chord * np.array(item.chord_derivative)
        return rig.along(row, item.through, item.name)

    def _section(self, trial: Trial, item: RecordedInput) -> InputSection:
        section = self._inputs.get(item.name)
        if section is None:
            raise ModelError(
                f"The trial {trial.name!r} records the input {item.name!r}, which {self.what} does "
                f"not have; it has {', '.join(self._inputs) or 'none'}."
            )
        if item.quantity is not section.quantity and item.quantity not in section.quantity.moving:
            raise ModelError(
                f"The input {item.name!r} of {self.what} is {section.quantity.value}, but "
                f"the trial {trial.name!r} records {item.quantity.value}."
            )
        return section

    def _at_port(self, rig: LumpedRig, load: PortLoad) -> Load:
        """Return the row and the course of a load at a port."""
        rows = rig.system().acting_rows
        if load.port not in rows:
            raise ModelError(
                f"A force acts at the port {load.port!r}, which {self.name!r} does not have; it has "
                f"{', '.join(rows) or 'none'}."
            )
        spans = tuple(window.span for window in load.windows)
        return rows[load.port], FormulaCourse(course_of(load.force, load.kind), spans)

    def shown(self, case: Case, outputs: Outputs, acting: Acting | None, component: int = 0) -> list[Shown]:
        """Return what each output shows under what acts; None: at rest."""
        drives = {} if acting is None else acting.drives
        found, description = [], self.description
        for name, quantity in outputs:
            item = self._outputs[name]
            further = 0 if quantity is item.quantity else quantity.derivatives_of(item.quantity)
            if item.reaction is not None:
                if item.reaction not in drives:
                    raise ModelError(
                        f"The output {name!r} of {self.name!r} is the reaction of {item.reaction!r}, whose "
                        "motion this trial does not prescribe."
                    )
                found.append(
                    Shown.of(description.padded(()))._replace(reaction=list(drives).index(item.reaction))
                )
            elif item.controller is not None:
                loop = self.rig(case.state).loops[item.controller]
                found.append(loop.effort([] if acting is None else self._reference(case, loop)))
            else:
                row, order = description.padded(item.vector or ()), order_of(item.quantity) + further
                seen = Shown.of(row, order, further, description.width - description.size)
                found.append(seen._replace(constant=item.constant * (not further)))
        return found

    def losses(self, trial: Trial, health: FloatArray) -> list[Losses]:
        """Return none: health has no meaning here."""
        return [()]

    @property
    def oscillates(self) -> bool:
        """Whether it has a mode that vibrates."""
        return bool(np.any(self.system(State(self.prior_mean())).angular_frequency > 0.0))

    # ------------------------------------------------------------ ports

    @property
    def has_law(self) -> bool:
        """Whether it has a law of a port of its own, in its file or found."""
        return bool(self.description.law) or super().has_law

    def apart(self) -> tuple[Self, ModelPatch]:
        """Return the linear model, and the laws that it has beside that, at the prior means."""
        linear, laws = super().apart()
        description = self.description.model_copy(update={"law": []})
        linear = linear._changed(description=description, _rigs=Memory(KEPT_RIGS))
        return linear, self.own_laws(self.prior_mean()) + laws

    def unit_of_state(self, port: str) -> str:
        """Return the unit of what a law at a port of states acts on; empty for a port that moves or turns."""
        first = self.description.size
        if not np.any(self.port_rows.get(port, np.zeros(0))[first:]):
            return ""
        shown = {
            item.quantity for item in self.description.output if item.vector and any(item.vector[first:])
        }
        return UNITS[shown.pop()].si if len(shown) == 1 else "of the state's unit"

    def turns(self, port: str) -> bool | None:
        """Return whether a port turns; None where the model does not say it.

        It moves or turns as the unknowns do of which it is a sum or difference, and these as what is measured
        or prescribed of them.
        """
        vector = self.port_rows.get(port)
        if vector is None or not np.all(np.isin(vector, (-1.0, 0.0, 1.0))):
            return None
        told: dict[int, set[bool]] = {}
        known = [(item.vector, item.quantity.moving) for item in self.description.output]
        known += [(item.vector, item.quantity.moving) for item in self.description.input]
        for row, moving in known:
            if row is not None and moving and np.count_nonzero(row) == 1 and max(row) == 1.0:
                told.setdefault(int(np.argmax(row)), set()).add(Quantity.ANGLE in moving)
        kinds = set().union(*(told.get(int(at), {True, False}) for at in np.flatnonzero(vector)))
        return kinds.pop() if len(kinds) == 1 else None

    # ------------------------------------------------------------ parts

    def rig(self, state: State) -> LumpedRig:
        """Return the model at values of the parameters and a temperature above the reference [K]."""
        parameters, _, structure, temperature, *_ = state
        softening = temperature * sum(
            (item.coefficient for item in structure if isinstance(item, ModulusTemperature)), 0.0
        )
        if 1.0 - softening < LEAST_STIFFNESS:
            raise ModelError(
                f"The temperature leaves {1.0 - softening:.2g} of the stiffness, which no structure has."
            )
        return self._rigs.get(
            (parameters.tobytes(), structure.primitives, softening),
            lambda: LumpedRig(self.description, self._factors(parameters), structure.primitives, softening),
        )

    def _factors(self, parameters: FloatArray) -> dict[str, float]:
        """Return the factors of the terms at values of the parameters."""
        factors: dict[str, float] = {}
        for item, value in zip(self.description.parameter, parameters, strict=True):
            for term in item.terms:
                factors[term] = factors.get(term, 1.0) * float(value)
        return factors
