"""A lumped linear structure as a model: masses, springs, dampers with named inputs, outputs and ports."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property, lru_cache
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np
from scipy.linalg import eigh

from discrepancy.campaign.records import FloatArray, Hold, Quantity, RecordedInput, Trial, TrialKind
from discrepancy.campaign.units import UNITS
from discrepancy.errors import ModelError, said
from discrepancy.system import lumped_file
from discrepancy.system.excitation import Acting, Course, FormulaCourse, Load, LoadChange, Shown, place_among
from discrepancy.system.interface import NO_PATCH
from discrepancy.system.linear_system import LinearSystem
from discrepancy.system.model_file import DescribedModel
from discrepancy.system.response import EITHER, MOVES, TURNS, Outputs, Place
from discrepancy.system.system_model import Case, State, SystemModel
from fe.runtime import patch as changes
from fe.runtime.laws import LAWS
from fe.runtime.patch import SENSORS, ModelPatch, PortLoad, Primitive, course_of
from fe.runtime.state import Losses

LEAST_STIFFNESS = 0.05
"""A temperature that leaves less than this share of the stiffness is refused."""
MOST_MODES = 8
"""Modes that move of a structure on springs; the others follow without inertia."""

Recorded = Mapping[str, tuple[RecordedInput, float]]
"""Recorded inputs by name, and a constant that each lacks."""


class Loop(NamedTuple):
    """A controller in a rig of N unknowns.

    Its `section` of the file, `gains` (proportional, derivative and integral, times their factors), what it
    `sees` (4, N) as `Shown.rows`, the load (N,) along which it `acts`, and the row (N,) of the `integral` of
    its error, zero without that gain.
    """

    section: lumped_file.ControllerSection
    gains: Sequence[float]
    sees: FloatArray
    acts: FloatArray
    integral: FloatArray

    @property
    def gives(self) -> FloatArray:
        """What it gives without a reference (4, N)."""
        proportional, derivative, integral = self.gains
        found = -proportional * self.sees - derivative * np.roll(self.sees, 1, axis=0)
        found[1] += integral * self.integral
        return found

    def loads(self, trial: Trial, recorded: Recorded) -> list[Load]:
        """Return what a recorded reference does, as loads; raises `ModelError` if it cannot be followed."""
        section, (proportional, derivative, _) = self.section, self.gains
        if section.reference is None or section.reference not in recorded:
            return []
        item, offset = recorded[section.reference]
        if item.quantity is not section.quantity:
            raise ModelError(said("models.controller_quantity", section=section, trial=trial, item=item))
        course = Course(trial.time, item.values + offset, item.hold)
        found = [Load(proportional * self.acts + self.integral, course)]
        if derivative != 0.0 and section.derivative_of == "error":
            if course.hold is Hold.ZERO_ORDER:
                raise ModelError(said("models.reference_steps", section=section, trial=trial))
            found.append(Load(derivative * self.acts, course, 1))
        return found


class Rig(NamedTuple):
    """A lumped model at values of its parameters, under a patch of its structure.

    `factors` of terms by name, `terms` (N, N) by kind and those of parts by name, and `loops`, the
    controllers by name.
    """

    factors: Mapping[str, float]
    terms: Mapping[str, FloatArray]
    loops: Mapping[str, Loop]

    def along(self, item: lumped_file.LoadSection, row: Sequence[float] | FloatArray) -> FloatArray:
        """Return a load (N,) along a row, through a matrix where it says so, times its own factor."""
        acting = np.zeros(len(self.terms["mass"]))
        acting[: len(row)] = row
        through = acting if item.through is None else self.terms[item.through] @ acting
        return np.asarray(self.factors.get(item.name, 1.0) * through)


class LumpedModel(DescribedModel, SystemModel):
    """A lumped model (`discrepancy.system.interface.Model`).

    Damping that is given as modal ratios stays at these ratios when the structure changes. Health (z1, z2)
    has no meaning here and is passed over.
    """

    follows_windows: ClassVar[bool] = True

    kept = 256

    def __init__(self, description: lumped_file.LumpedDescription) -> None:
        self.description, padded = description, description.padded
        super().__init__(description, {item.name: item.quantity for item in description.output})
        self.load_places = tuple(item.name for item in description.input)
        self.kinds = frozenset(TrialKind) - {TrialKind.FLIGHT}
        if not description.is_plain:
            self.kinds -= {TrialKind.RINGDOWN}
        if description.free:  # nothing holds it at rest
            self.kinds -= {TrialKind.STATIC}
        self.length = description.characteristic_length
        self.port_rows = {item.name: padded(item.vector) for item in description.port}
        self.acts = {item.name: padded(item.acts or item.vector) for item in description.port}
        self._places = sorted(description.place, key=lambda place: place.station)
        if self._places:
            self.stations = self._places[0].station, self._places[-1].station
        self._inputs = {item.name: item for item in description.input}
        self._outputs = {item.name: item for item in description.output}

    @classmethod
    def load(cls, path: Path | str) -> "LumpedModel":
        """Return the model of a TOML file, or a shipped one by name; raises `ModelError`."""
        return cls(lumped_file.LumpedDescription.read(path))

    # ------------------------------------------------------------ what it is

    def supports(self, primitive: type[Primitive]) -> bool:
        """Whether the model can carry a primitive."""
        description, ports = self.description, list(self.port_rows.values())
        if primitive in LAWS:  # the position of a state's port means nothing
            moved = primitive.of_speed or all(np.any(row[: description.size]) for row in ports)
            return bool(ports) and moved
        carried: dict[type[Primitive], bool] = {
            changes.StiffnessDrift: description.size > 0,
            changes.ModulusTemperature: True,
            changes.PointMass: bool(self._places),
            changes.RootCompliance: description.root is not None,
            changes.LoadGain: True,
            changes.LoadPlace: any(item.station_derivative is not None for item in description.input),
            PortLoad: bool(ports),
        }
        return carried.get(primitive, primitive in SENSORS)

    def losses(self, trial: Trial, health: FloatArray) -> list[Losses]:
        """Return none: health has no meaning here."""
        return [()]

    @property
    def oscillates(self) -> bool:
        """Whether it has a mode that vibrates."""
        return bool(np.any(self.system(State(tuple(self.prior_mean().tolist()))).angular_frequency > 0.0))

    # ------------------------------------------------------------ in a trial

    def force_row(self, place: Place, state: State, change: ModelPatch = NO_PATCH) -> FloatArray:
        """Return the load (N,) of 1 N, or of what else an input is, at its place."""
        return self._moved_row(self.rig(state), self._input_at(place), LoadChange.of(change))

    def pushes(self, case: Case) -> tuple[list[Load], dict[str, Course]]:
        """Return loads and prescribed motions in a trial.

        Every motion that an input can prescribe and that the trial does not record is held at zero, if an
        output is its reaction; else it is free.
        """
        trial, _, patch, state = case
        rig, time, description = self.rig(state), trial.time, self.description
        still = Course(time, np.zeros(len(time)), Hold.SMOOTH, 0)
        drives = {item.reaction: still for item in description.output if item.reaction is not None}
        always = Course(time, np.ones(len(time)))
        loads = [Load(rig.along(item, item.vector), always) for item in description.load]
        recorded = self._recorded(case)
        for loop in rig.loops.values():
            loads += loop.loads(trial, recorded)
        followed = {loop.section.reference for loop in rig.loops.values()}
        for item, offset in (own for name, own in recorded.items() if name not in followed):
            section = self._recorded_at(trial, item)
            values = item.values + offset
            if section.quantity.moving:
                values = rig.factors.get(item.name, 1.0) * values
                drives[item.name] = Course(time, values, Hold.SMOOTH, item.quantity.order)
                continue
            change = LoadChange.of(patch)
            if item.quantity in (Quantity.FORCE, Quantity.TORQUE):
                values = change.changed(values, item.values)
            loads.append(Load(self._moved_row(rig, section, change), Course(time, values, item.hold)))
        for load in (item for item in patch if isinstance(item, PortLoad)):
            if load.port not in self.acts:
                raise ModelError(said("models.no_port", load=load, model=self))
            spans = tuple(window.span for window in load.windows)
            loads.append(Load(self.acts[load.port], FormulaCourse(course_of(load.force, load.kind), spans)))
        return loads, drives

    def _recorded(self, case: Case) -> Recorded:
        """Return the recorded inputs of a trial, or its force at its place, and what each lacks."""
        trial, recorded = case.trial, case.trial.inputs
        if trial.kind is not TrialKind.DRIVEN:
            item = self._input_at(trial.load_place)
            recorded = (RecordedInput(item.name, item.quantity, trial.force, trial.hold),)
        lacks = (*case.conditions.offset, *(0.0,) * len(recorded))
        return {item.name: (item, lack) for item, lack in zip(recorded, lacks, strict=False)}

    def _recorded_at(self, trial: Trial, item: RecordedInput) -> lumped_file.InputSection:
        """Return the input that a trial records; raises `ModelError` if it is not the model's."""
        section = self._inputs.get(item.name)
        if section is None:
            known = self._inputs
            raise ModelError(said("models.unknown_input", trial=trial, item=item, model=self, known=known))
        moving = section.quantity.moving
        if item.quantity is not section.quantity and item.quantity not in moving:
            raise ModelError(said("models.input_quantity", item=item, model=self, own=section, trial=trial))
        if moving and item.hold not in (None, Hold.SMOOTH):
            raise ModelError(said("models.prescribed", item=item, trial=trial, model=self))
        return section

    def _input_at(self, place: Place) -> lumped_file.InputSection:
        """Return the input of a load place; raises `ModelError` if there is none."""
        known = [name for name, item in self._inputs.items() if name == place or not item.quantity.moving]
        return self._inputs[place_among(known, place, self.what)]

    def _moved_row(self, rig: Rig, item: lumped_file.InputSection, change: LoadChange) -> FloatArray:
        """Return the row (N,) along which an input acts, where its place has been moved to."""
        row = np.array(item.vector)
        if change.along_span or change.along_chord:
            if item.station_derivative is None:
                raise ModelError(said("models.no_station", item=item, model=self))
            row = row + change.along_span * np.array(item.station_derivative)
        return rig.along(item, row)

    def shown(self, case: Case, outputs: Outputs, acting: Acting | None) -> list[Shown]:
        """Return what each output shows under what acts; None: at rest."""
        drives, loads = ([], []) if acting is None else (list(acting.drives), acting.loads)
        found, description = list[Shown](), self.description
        for name, quantity in outputs:
            item = self._outputs[name]
            further = 0 if quantity is item.quantity else quantity.derivatives_of(item.quantity)
            if item.vector is not None:
                row, order = description.padded(item.vector), item.quantity.order + further
                seen = Shown.of(row, order, further, description.width - description.size)
                found.append(seen._replace(constant=item.constant * (not further)))
            elif item.controller is not None:
                loop = self.rig(case.state).loops[item.controller]
                along = loop.acts / float(loop.acts @ loop.acts)
                given = [] if acting is None else loop.loads(case.trial, self._recorded(case))
                found.append(Shown(loop.gives, courses=[(float(load.row @ along), load) for load in given]))
            elif item.reaction in drives:
                system = self.system(case.state._replace(drives=tuple(drives)))
                along = system.lift[:, drives.index(item.reaction)]
                rows = [along @ matrix for matrix in (system.stiffness, system.damping, system.mass)]
                courses = [(-float(load.row @ along), load) for load in loads]
                found.append(Shown(np.array([*rows, 0.0 * along]), courses=courses, felt=along))
            else:
                raise ModelError(said("models.no_reaction", name=name, model=self, item=item))
        return found

    # ------------------------------------------------------------ ports

    def own_laws(self, parameters: FloatArray) -> ModelPatch:
        """Return the laws of ports that it has as it is, each times its factor."""
        factors, laws = self._factors(parameters.tolist()), () if self.linear else self.description.law
        return ModelPatch(tuple(law.scaled(factors.get(law.name, 1.0)) for law in laws))

    def port_units(self, port: str) -> tuple[str, str]:
        """Return the units of a force at a port and of what it acts on.

        It moves or turns as the unknowns do of which it is a sum or difference, and these as what is measured
        or prescribed of them.
        """
        row, n, description = self.port_rows.get(port), self.description.size, self.description
        if row is not None and not np.any(row[:n]):
            states = {item.quantity for item in description.output if item.vector and any(item.vector[n:])}
            unit = UNITS[states.pop()].si if len(states) == 1 else "of the state's unit"
            return f"{unit}/s times capacity", unit
        if row is None or not np.all(np.isin(row, (-1.0, 0.0, 1.0))):
            return EITHER
        told: dict[int, set[tuple[str, str]]] = {}
        read = [(item.vector or (), item.quantity.moving) for item in description.output]
        for vector, moving in (*read, *((item.vector, item.quantity.moving) for item in description.input)):
            if moving and np.count_nonzero(vector) == 1 and max(vector) == 1.0:
                told.setdefault(vector.index(1.0), set()).add(TURNS if Quantity.ANGLE in moving else MOVES)
        units = set().union(*(told.get(at, {MOVES, TURNS}) for at in np.flatnonzero(row).tolist()))
        return units.pop() if len(units) == 1 else EITHER

    # ------------------------------------------------------------ matrices

    def _factors(self, parameters: Iterable[float]) -> dict[str, float]:
        """Return the factors of the terms at values of the parameters."""
        factors: dict[str, float] = {}
        for item, value in zip(self.description.parameter, parameters, strict=True):
            for term in item.terms:
                factors[term] = factors.get(term, 1.0) * value
        return factors

    @cached_property
    def rig(self) -> Callable[[State], Rig]:
        """What gives the model at values of the parameters, a structure and a temperature, kept."""
        return lru_cache(self.kept)(self._rig)

    def _rig(self, state: State) -> Rig:
        description, n = self.description, self.description.size
        factors, padded = self._factors(state.parameters), description.padded
        left = 1.0 - state.warmer * sum(
            item.coefficient for item in state.structure if isinstance(item, changes.ModulusTemperature)
        )
        if left < LEAST_STIFFNESS:
            raise ModelError(f"The temperature leaves {left:.2g} of the stiffness, which none has.")
        terms = description.terms({**factors, "stiffness": factors.get("stiffness", 1.0) * left})
        mass, stiffness, damping = (terms[kind][:n, :n] for kind in ("mass", "stiffness", "damping"))
        for change in state.structure if n else ():
            if isinstance(change, changes.PointMass):
                stations, vectors = zip(
                    *((place.station, place.vector) for place in self._places), strict=True
                )
                row = np.array(
                    [np.interp(change.station, stations, column) for column in np.transpose(vectors)]
                )
                mass += change.mass * np.outer(row[:n], row[:n])
            elif isinstance(change, changes.RootCompliance) and description.root is not None:
                # in series: K^-1 + c l l^T, by Sherman and Morrison
                lever = np.array(description.root.lever)
                pull = stiffness @ lever
                share = change.compliance / (1.0 + change.compliance * float(pull @ lever))
                stiffness -= np.outer(pull, pull) * share
        if n and (given := description.damping) is not None:
            own = (given.alpha or 0.0) * mass + (given.beta or 0.0) * stiffness
            if given.ratios is not None:
                square, shapes = eigh(stiffness, mass)
                weighted, w = mass @ shapes, np.sqrt(np.maximum(square, 0.0))
                own = (weighted * (2.0 * np.array(given.ratios) * w)) @ weighted.T
            damping += factors.get("damping", 1.0) * own
        loops, integrals = dict[str, Loop](), iter(np.eye(description.width)[n + description.states :])
        for item in description.controller:
            named = (
                factors.get(f"{item.name}.{gain}", 1.0) * getattr(item, gain) for gain in lumped_file.GAINS
            )
            gains = [factors.get(item.name, 1.0) * gain for gain in named]
            sees = Shown.of(padded(item.vector), item.quantity.order, states=description.width - n).rows
            integral = next(integrals) if item.integral else np.zeros(description.width)
            loops[item.name] = Loop(item, gains, sees, padded(item.acts), integral)
        return Rig(factors, terms, loops)

    def made(self, state: State) -> LinearSystem:
        """Return what moves, with prescribed motions and controllers as the state says."""
        rig, description = self.rig(state), self.description
        matrices, padded = np.zeros((3, description.width, description.width)), description.padded
        for kind, (order, *_) in lumped_file.BLOCKS.items():
            matrices[order] += rig.terms[kind]
        rest = np.arange(description.size + description.states, description.width)
        matrices[2, rest, rest] = 1.0
        for loop in rig.loops.values() if state.closed else ():
            matrices += (
                loop.integral[:, None] * loop.sees[:3, None] - loop.acts[:, None] * loop.gives[:3, None]
            )
        stiffness, damping, mass = matrices
        beta = description.damping.beta if description.damping is not None else None
        drives = [padded(self._inputs[name].vector) for name in state.drives]
        return LinearSystem(
            mass, damping, stiffness, self.port_rows,
            mode_count=MOST_MODES if description.is_plain else None,
            relaxation=rig.factors.get("damping", 1.0) * (beta or 0.0),
            states=description.width - description.size, drives=np.array(drives), actions=self.acts,
        )  # fmt: skip
