"""A lumped model at values of its parameters: its systems, what acts in a trial, what its outputs show."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from scipy.linalg import eigh

from discrepancy.campaign.records import FloatArray, Hold, Quantity, RecordedInput, Start, Trial, TrialKind
from discrepancy.errors import ModelError
from discrepancy.models.acting import (
    Acting,
    Course,
    Drive,
    FormulaCourse,
    Load,
    Shown,
    order_of,
)
from discrepancy.models.interface import Conditions, Place
from discrepancy.models.lumped_controllers import loops
from discrepancy.models.lumped_file import LumpedDescription, matrix_of
from discrepancy.models.lumped_sections import InputSection
from discrepancy.models.memory import Memory
from discrepancy.models.questions import LoadChange, place_among, release_of
from discrepancy.models.second_order import Motion, SecondOrderSystem
from fe.runtime.motion import NO_LAWS, Laws, laws_of
from fe.runtime.patch import PointMass, PortLoad, Primitive, RootCompliance, course_of

MOST_MODES = 8
"""Modes that move of a structure on springs; the others follow without inertia."""
UNCHANGED = LoadChange()


class LumpedRig:
    """A lumped model's description with the factors of its parameters, for trials of all kinds but flights.

    Parameters
    ----------
    description : LumpedDescription
        Content of the file.
    factors : mapping of str to float
        Of terms, by name.
    structure : sequence of Primitive
        What a patch changes of the structure.
    softening : float
        Share of the stiffness that the temperature takes.
    """

    def __init__(
        self,
        description: LumpedDescription,
        factors: Mapping[str, float],
        structure: Sequence[Primitive] = (),
        softening: float = 0.0,
    ) -> None:
        self.description, self.factors = description, factors
        self._inputs = {item.name: item for item in description.input}
        self._loops = loops(description.controller, description.size, description.states, factors)
        # displacements, states and integrals of controllers
        self.width = (
            description.size + description.states + sum(loop.state is not None for loop in self._loops)
        )
        softened = {**factors, "stiffness": factors.get("stiffness", 1.0) * (1.0 - softening)}
        self._parts = {
            name: description.whole(name, softened)
            for name in ("mass", "stiffness", "capacity", "conductance")
        }
        for change in structure:
            self._change(change)
        self._eigen: tuple[FloatArray, FloatArray, int] | None = None
        self._parts["damping"] = self._damping(self._parts["mass"], self._parts["stiffness"])
        self._systems = Memory()
        self._constant = sum(
            (self._vector(item.vector, item.through, item.name) for item in description.load),
            np.zeros(self.width),
        )

    def _change(self, change: Primitive) -> None:
        """Put a point mass or a compliance of the root into the matrices."""
        mass, stiffness = self._parts["mass"], self._parts["stiffness"]
        if isinstance(change, PointMass):
            places = sorted(self.description.place, key=lambda place: place.station)
            stations = [place.station for place in places]
            columns = zip(*(place.vector for place in places), strict=True)
            row = np.array([np.interp(change.station, stations, column) for column in columns])
            mass += change.mass * np.outer(row, row)
        elif isinstance(change, RootCompliance) and self.description.root is not None:
            # in series: K^-1 + c l l^T, by Sherman and Morrison
            pull = stiffness @ np.array(self.description.root.lever)
            stiff = float(pull @ np.array(self.description.root.lever))
            stiffness -= np.outer(pull, pull) * change.compliance / (1.0 + change.compliance * stiff)

    @cached_property
    def own_laws(self) -> Laws:
        """Laws of ports that the model has as it is."""
        own = self.description.own_laws(self.factors)
        return laws_of(own, {item.name for item in self.description.port}) if len(own) else NO_LAWS

    def padded(self, row: Sequence[float] | FloatArray) -> FloatArray:
        """Return a row of the file with the integrals of controllers after it."""
        found = np.zeros(self.width)
        found[: len(row)] = row
        return found

    def _damping(self, mass: FloatArray, stiffness: FloatArray) -> FloatArray:
        given, factor = self.description.damping, self.factors.get("damping", 1.0)
        if given is None or not len(mass):
            matrix = np.zeros_like(mass)
        elif given.matrix is not None:
            matrix = matrix_of(given.matrix)
        elif given.ratios is not None:
            square, shapes = eigh(stiffness, mass)
            weighted, w = mass @ shapes, np.sqrt(np.maximum(square, 0.0))
            self._eigen = w, shapes, len(w)
            twice = 2.0 * np.array(given.ratios) * w
            matrix = (weighted * twice) @ weighted.T
        else:
            matrix = (given.alpha or 0.0) * mass + (given.beta or 0.0) * stiffness
        for part in self.description.damping_part:
            matrix = matrix + self.factors.get(part.name, 1.0) * matrix_of(part.matrix)
        return np.asarray(factor * matrix)

    def _vector(self, vector: Sequence[float] | FloatArray, through: str | None, name: str) -> FloatArray:
        """Return the vector (n + m,) of a load, through a matrix where it says so, times its own factor."""
        row, n, description = self.padded(vector), self.description.size, self.description
        if through is not None:
            part = description.terms[through]
            matrix = (
                self._parts[through] if part is None else self.factors.get(through, 1.0) * matrix_of(part)
            )
            of_states = (*description.capacity_part, *description.conductance_part)
            first = n if through in ("capacity", "conductance", *(item.name for item in of_states)) else 0
            at, whole = slice(first, first + len(matrix)), np.zeros(len(row))
            whole[at] = matrix @ row[at]
            row = whole
        return np.asarray(self.factors.get(name, 1.0) * row)

    def system(self, drives: tuple[str, ...] = (), *, closed: bool = True) -> SecondOrderSystem:
        """Return the system with the motions of some inputs prescribed, with its controllers or without."""
        return self._systems.get((drives, closed), lambda: self._made(drives, closed=closed))

    def _made(self, drives: tuple[str, ...], *, closed: bool) -> SecondOrderSystem:
        description, n, m = self.description, self.description.size, self.description.states
        own = slice(n, n + m)
        mass, damping, stiffness = np.zeros((3, self.width, self.width))
        mass[n:, n:] = np.eye(self.width - n)
        mass[:n, :n], mass[own, own] = self._parts["mass"], self._parts["capacity"]
        damping[:n, :n], damping[own, own] = self._parts["damping"], self._parts["conductance"]
        stiffness[:n, :n] = self._parts["stiffness"]
        coupling = description.coupling
        for content, into, rows, columns in (
            (coupling.force_of_states, damping, slice(0, n), own),
            (coupling.flow_of_speeds, damping, own, slice(0, n)),
            (coupling.flow_of_displacements, stiffness, own, slice(0, n)),
        ):
            if content is not None:
                into[rows, columns] = -np.atleast_2d(np.array(content))
        for loop in self._loops if closed else ():
            loop.close(damping, stiffness)
        beta = description.damping.beta if description.damping is not None else None
        system = SecondOrderSystem(
            mass, damping, stiffness,
            {item.name: self.padded(item.vector) for item in description.port},
            mode_count=MOST_MODES if description.is_plain else None,
            relaxation=self.factors.get("damping", 1.0) * (beta or 0.0),
            states=self.width - n,
            drives=np.array([self.padded(self._inputs[name].vector) for name in drives]),
            actions={item.name: self.padded(item.acts) for item in description.port if item.acts is not None},
        )  # fmt: skip
        if self._eigen is not None and description.is_plain and n <= MOST_MODES and self._eigen[0][0] > 0.0:
            vars(system)["_modes"] = self._eigen  # known already
        return system

    # ------------------------------------------------------------ trials

    def acting(self, trial: Trial, conditions: Conditions, change: LoadChange = UNCHANGED) -> Acting:
        """Return what acts in a dynamic trial.

        Every motion that an input can prescribe and that the trial does not record is held at zero, if an
        output is its reaction; else it is free.

        Raises
        ------
        ModelError
            If the trial records an input that the model does not have or that is of another quantity.
        """
        if trial.kind is TrialKind.RINGDOWN:
            row, initial = self.moved_row(self.input_at(trial.load_place)), conditions.initial
            release = (row, release_of(trial))
            return Acting(
                trial.time, self._constant, initial=initial, clock=conditions.clock, release=release
            )
        recorded = self.recorded(trial)
        loads, drives, references = list[Load](), dict[str, Drive](), dict[str, Sequence[Load]]()
        offsets = (*conditions.offset, *(0.0,) * len(recorded))
        for item, offset in zip(recorded, offsets, strict=False):
            following = [loop for loop in self._loops if loop.section.reference == item.name]
            for loop in following:
                references[loop.section.name] = loop.loads(trial, item, offset)
                loads += references[loop.section.name]
            if following:
                continue
            section = self._section(trial, item)
            values = item.values + offset if offset else item.values
            if section.quantity.moving:
                if item.hold not in (None, Hold.SMOOTH):
                    raise ModelError(
                        f"The input {item.name!r} of the trial {trial.name!r} is a motion that "
                        f"{self.description.name!r} prescribes, which no drive makes in steps or corners: "
                        "leave `reference` and `hold` out."
                    )
                values = self.factors.get(item.name, 1.0) * values
                drives[item.name] = Drive.of(trial.time, values, order_of(item.quantity))
                continue
            if item.quantity in (Quantity.FORCE, Quantity.TORQUE):
                values = change.changed(values, item.values)
            course = Course.of(trial.time, values, item.hold)
            loads.append((self.moved_row(section, change), course))
        reactions = {item.reaction for item in self.description.output}
        named = {item.name for item in recorded}
        for name, section in self._inputs.items():
            if section.quantity.moving and name in reactions and name not in named:
                drives[name] = Drive.of(trial.time, np.zeros(len(trial.time)))
        return Acting(
            trial.time, self._constant, loads, drives, trial.begins,
            conditions.initial.ravel(), conditions.clock, references,
        )  # fmt: skip

    def recorded(self, trial: Trial) -> tuple[RecordedInput, ...]:
        """Return the recorded inputs of a trial; of one under a force this at its place."""
        if trial.kind is TrialKind.DRIVEN:
            return trial.inputs
        item = self.input_at(trial.load_place)
        return (RecordedInput(item.name, item.quantity, trial.force, trial.hold),)

    def input_at(self, place: Place) -> InputSection:
        """Return the input of a load place; raises `ModelError` if there is none."""
        forces = [name for name, item in self._inputs.items() if not item.quantity.moving]
        known = [*self._inputs] if place in self._inputs else forces
        return self._inputs[place_among(known, place, f"the lumped model {self.description.name!r}")]

    def moved_row(self, item: InputSection, change: LoadChange = UNCHANGED) -> FloatArray:
        """Return the row (n + m,) along which an input acts, where its place has been moved to."""
        row = np.array(item.vector)
        if change.along_span or change.along_chord:
            if item.station_derivative is None:
                raise ModelError(
                    f"The input {item.name!r} of {self.description.name!r} declares no station_derivative, "
                    "so its place cannot move."
                )
            row = row + change.along_span * np.array(item.station_derivative)
            if item.chord_derivative is not None:
                row = row + change.along_chord * np.array(item.chord_derivative)
        return self._vector(row, item.through, item.name)

    def _section(self, trial: Trial, item: RecordedInput) -> InputSection:
        section = self._inputs.get(item.name)
        if section is None:
            raise ModelError(
                f"The trial {trial.name!r} records the input {item.name!r}, which the lumped model "
                f"{self.description.name!r} does not have; it has {', '.join(self._inputs) or 'none'}."
            )
        if item.quantity is not section.quantity and item.quantity not in section.quantity.moving:
            raise ModelError(
                f"The input {item.name!r} of the lumped model {self.description.name!r} is "
                f"{section.quantity.value}, but the trial {trial.name!r} records {item.quantity.value}."
            )
        return section

    def moved(
        self,
        trial: Trial,
        conditions: Conditions,
        laws: Laws,
        change: LoadChange = UNCHANGED,
        at_ports: Sequence[PortLoad] = (),
        *,
        still: bool = False,
    ) -> Motion:
        """Return the motion of a dynamic trial; `still`: begun at rest.

        Raises
        ------
        ModelError
            If it cannot begin so, or what acts is not the model's.
        """
        if trial.kind is TrialKind.RINGDOWN:
            self._check_released(trial, at_ports)
        acting = self.acting(trial, conditions, change)
        system = self.system(tuple(acting.drives))
        if at_ports:
            pushed = [self._at_port(item, system) for item in at_ports]
            acting = replace(acting, loads=[*acting.loads, *pushed])
        if still:
            acting = replace(acting, begins=Start.STILL)
        try:
            return system.motion(acting, laws, conditions.refinement)
        except ModelError as cause:
            name = self.description.name
            raise ModelError(f"The trial {trial.name!r} of {name!r}: {cause}") from cause

    def _check_released(self, trial: Trial, at_ports: Sequence[PortLoad]) -> None:
        """Refuse a ring-down that the model cannot begin."""
        why = ""
        if not self.description.is_plain:
            name = self.description.name
            why = f"which the lumped model {name!r} cannot begin: it is free, driven or has states"
        elif at_ports:
            why = "which no force with a course in time can act on"
        if why:
            raise ModelError(
                f'The trial {trial.name!r} is a ring-down, {why}; say kind = "driven" and begins = "unknown".'
            )

    def _at_port(self, load: PortLoad, system: SecondOrderSystem) -> Load:
        """Return the row and the course of a load at a port."""
        row = system.acting_rows.get(load.port)
        if row is None:
            raise ModelError(
                f"A force acts at the port {load.port!r}, which {self.description.name!r} does not have; it "
                f"has {', '.join(system.ports) or 'none'}."
            )
        spans = tuple(window.span for window in load.windows)
        return row, FormulaCourse(course_of(load.force, load.kind), spans)

    def static_loads(self, trial: Trial, change: LoadChange = UNCHANGED) -> FloatArray:
        """Return the loads (L, n + m) of a static trial."""
        row = self.moved_row(self.input_at(trial.load_place), change)
        return np.outer(change.changed(trial.force, trial.force), row) + self._constant

    def held(self, trial: Trial) -> FloatArray:
        """Return the displacements (L, n + m) in a static trial, or from which a ring-down is released."""
        if trial.release is None:
            return self.system().static(self.static_loads(trial)).values
        row = self.moved_row(self.input_at(trial.load_place))
        shape = self.system().flexibility(row)
        return np.asarray(trial.release.displacement / float(row @ shape) * shape)[None]

    def shown(self, outputs: Sequence[tuple[str, Quantity]], acting: Acting | None = None) -> list[Shown]:
        """Return what each output shows under what acts; None: at rest."""
        known = {item.name: item for item in self.description.output}
        drives, references = ({}, {}) if acting is None else (acting.drives, acting.references)
        found = []
        for name, quantity in outputs:
            item = known[name]
            further = 0 if quantity is item.quantity else quantity.derivatives_of(item.quantity)
            if item.reaction is not None:
                if item.reaction not in drives:
                    raise ModelError(
                        f"The output {name!r} of {self.description.name!r} is the reaction of "
                        f"{item.reaction!r}, whose motion this trial does not prescribe."
                    )
                found.append(Shown(np.zeros(self.width), reaction=list(drives).index(item.reaction)))
            elif item.controller is not None:
                (loop,) = (loop for loop in self._loops if loop.section.name == item.controller)
                found.append(loop.effort(references.get(item.controller, ())))
            else:
                row, order = self.padded(item.vector or ()), order_of(item.quantity) + further
                found.append(Shown(row, order, further, constant=item.constant * (not further)))
        return found
