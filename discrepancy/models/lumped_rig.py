"""A lumped model as a rig: its matrices, what acts in a trial, and what its outputs show."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from discrepancy.campaign.records import Hold, Quantity, RecordedInput, Start, Trial, TrialKind
from discrepancy.errors import ModelError
from discrepancy.models.input_course import Course, Drive, FormulaCourse, acting_force
from discrepancy.models.interface import Conditions, Response
from discrepancy.models.lumped_controllers import loops
from discrepancy.models.lumped_file import LumpedDescription, matrix_of
from discrepancy.models.lumped_sections import InputSection
from discrepancy.models.rig import Rig, RigMotion, order_of
from discrepancy.models.rig_records import Acting, Shown
from fe.runtime.motion import NO_LAWS, Laws, laws_of
from fe.runtime.patch import PortLoad, course_of

FloatArray = NDArray[np.float64]
ActingLoad = tuple[float, float, FloatArray | None, Sequence[PortLoad]]
"""Gain, tare and moved row of a trial's force, and loads at ports."""


class LumpedRig:
    """A lumped model's description with the factors of its parameters, for trials of all kinds but flights.

    Parameters
    ----------
    description : LumpedDescription
        Content of the file.
    mass, stiffness : (n, n) ndarray
        Of the displacements, patched.
    factors : mapping of str to float
        Of terms, by name.
    """

    def __init__(
        self,
        description: LumpedDescription,
        mass: FloatArray,
        stiffness: FloatArray,
        factors: Mapping[str, float],
    ) -> None:
        self.description, self.factors = description, factors
        self._inputs = {item.name: item for item in description.input}
        self._loops = loops(description.controller, description.size, description.states, factors)
        self._integrals = sum(loop.state is not None for loop in self._loops)
        self._parts = {
            "mass": mass,
            "stiffness": stiffness,
            "damping": self._damping(mass, stiffness),
            "capacity": description.whole("capacity", factors),
            "conductance": description.whole("conductance", factors),
        }
        self._rigs: dict[tuple[str, ...], Rig] = {}
        self._constant = sum(
            (self._vector(item.vector, item.through, item.name) for item in description.load),
            np.zeros(self.width),
        )
        own = description.own_laws(factors)
        self._laws = laws_of(own, {item.name for item in description.port}) if len(own) else NO_LAWS

    @property
    def width(self) -> int:
        """Displacements, states and integrals of controllers."""
        return self.description.size + self.description.states + self._integrals

    def _padded(self, row: Sequence[float] | FloatArray) -> FloatArray:
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
            weighted = mass @ shapes
            twice = 2.0 * np.array(given.ratios) * np.sqrt(np.maximum(square, 0.0))
            matrix = (weighted * twice) @ weighted.T
        else:
            matrix = (given.alpha or 0.0) * mass + (given.beta or 0.0) * stiffness
        for part in self.description.damping_part:
            matrix = matrix + self.factors.get(part.name, 1.0) * matrix_of(part.matrix)
        return np.asarray(factor * matrix)

    def _vector(self, vector: Sequence[float] | FloatArray, through: str | None, name: str) -> FloatArray:
        """Return the vector (n + m,) of a load, through a matrix where it says so, times its own factor."""
        row = self._padded(vector)
        if through is not None:
            n, whole = self.description.size, np.zeros(len(row))
            part = self.description.terms[through]
            of_states = through in ("capacity", "conductance") or any(
                through == item.name
                for item in (*self.description.capacity_part, *self.description.conductance_part)
            )
            matrix = (
                self._parts[through] if part is None else self.factors.get(through, 1.0) * matrix_of(part)
            )
            at = slice(n, n + self.description.states) if of_states else slice(0, n)
            whole[at] = matrix @ row[at]
            row = whole
        return np.asarray(self.factors.get(name, 1.0) * row)

    def rig(self, drives: tuple[str, ...] = ()) -> Rig:
        """Return the rig with the motions of some inputs prescribed."""
        found = self._rigs.get(drives)
        if found is None:
            found = self._rigs[drives] = self._made(drives)
        return found

    def open(self) -> Rig:
        """Return the rig without its controllers."""
        return self._made((), closed=False)

    def _made(self, drives: tuple[str, ...], *, closed: bool = True) -> Rig:
        n, m = self.description.size, self.description.states
        own = slice(n, n + m)
        mass, damping, stiffness = np.zeros((3, self.width, self.width))
        mass[n:, n:] = np.eye(self.width - n)
        mass[:n, :n], mass[own, own] = self._parts["mass"], self._parts["capacity"]
        damping[:n, :n], damping[own, own] = self._parts["damping"], self._parts["conductance"]
        stiffness[:n, :n] = self._parts["stiffness"]
        coupling = self.description.coupling
        for content, into, rows, columns in (
            (coupling.force_of_states, damping, slice(0, n), own),
            (coupling.flow_of_speeds, damping, own, slice(0, n)),
            (coupling.flow_of_displacements, stiffness, own, slice(0, n)),
        ):
            if content is not None:
                into[rows, columns] = -np.atleast_2d(np.array(content))
        for loop in self._loops if closed else ():
            loop.close(damping, stiffness)
        return Rig(
            mass, damping, stiffness, n,
            {item.name: self._padded(item.vector) for item in self.description.port},
            np.array([self._padded(self._inputs[name].vector) for name in drives]).reshape(-1, self.width),
            {item.name: self._padded(item.acts) for item in self.description.port if item.acts is not None},
        )  # fmt: skip

    # ------------------------------------------------------------ trials

    def acting(
        self, trial: Trial, conditions: Conditions, gain: float, tare: float, place: FloatArray | None
    ) -> tuple[Rig, Acting, tuple[str, ...]]:
        """Return the rig, what acts in a dynamic trial, and the inputs whose motion is prescribed.

        Every motion that an input can prescribe and that the trial does not record is held at zero, if an
        output is its reaction; else it is free.

        Raises
        ------
        ModelError
            If the trial records an input that the model does not have or that is of another quantity.
        """
        recorded = self.recorded(trial)
        named = {item.name for item in recorded}
        reactions = {item.reaction for item in self.description.output}
        held = [
            name
            for name, item in self._inputs.items()
            if item.quantity.moving and name in reactions and name not in named
        ]
        drives, loads, names = [], [], list[str]()
        references: dict[str, tuple[tuple[FloatArray, Course], ...]] = {}
        offsets = (*conditions.offset, *(0.0,) * len(recorded))
        for item, offset in zip(recorded, offsets, strict=False):
            following = [loop for loop in self._loops if loop.section.reference == item.name]
            for loop in following:
                pushed = loop.loads(trial, item, offset)
                loads += pushed
                references[loop.section.name] = tuple(pushed)
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
                names.append(item.name)
                order = order_of(item.quantity)
                drives.append(Drive.of(trial.time, self.factors.get(item.name, 1.0) * values, order))
                continue
            if (gain or tare) and item.quantity in (Quantity.FORCE, Quantity.TORQUE):
                values = (1.0 + gain) * values + tare * (item.values != 0.0)
            vector = np.array(section.vector) if place is None else place
            loads.append(
                (self._vector(vector, section.through, item.name), Course.of(trial.time, values, item.hold))
            )
        drives += [Drive.of(trial.time, np.zeros(len(trial.time))) for _ in held]
        prescribed = (*names, *held)
        acts = Acting(
            trial.time,
            loads,
            self._constant,
            drives,
            trial.begins,
            conditions.initial.ravel(),
            conditions.clock,
            references,
        )
        return self.rig(prescribed), acts, prescribed

    def recorded(self, trial: Trial) -> tuple[RecordedInput, ...]:
        """Return the recorded inputs of a trial; of a forced one its force at its place."""
        if trial.kind is TrialKind.DRIVEN:
            return trial.inputs
        forces = [name for name, item in self._inputs.items() if not item.quantity.moving]
        place = trial.load_place
        if place not in self._inputs and len(forces) == 1:
            place = forces[0]
        if not isinstance(place, str) or place not in self._inputs:
            raise ModelError(
                f"The load place {place!r} is not an input of the lumped model {self.description.name!r}; it "
                f"has {', '.join(self._inputs) or 'none'}."
            )
        return (RecordedInput(place, self._inputs[place].quantity, trial.force, trial.hold),)

    def _section(self, trial: Trial, item: RecordedInput) -> InputSection:
        section = self._inputs.get(item.name)
        if section is None:
            raise ModelError(
                f"The trial {trial.name!r} records the input {item.name!r}, which the lumped model "
                f"{self.description.name!r} does not have; it has {', '.join(self._inputs) or 'none'}."
            )
        same = item.quantity is section.quantity or (
            bool(section.quantity.moving) and item.quantity in section.quantity.moving
        )
        if not same:
            raise ModelError(
                f"The input {item.name!r} of the lumped model {self.description.name!r} is "
                f"{section.quantity.value}, but the trial {trial.name!r} records {item.quantity.value}."
            )
        return section

    def response(
        self,
        trial: Trial,
        outputs: Sequence[tuple[str, Quantity]],
        laws: Laws,
        conditions: Conditions,
        load: ActingLoad,
        refinement: int,
    ) -> Response:
        """Return the response of a trial.

        Raises
        ------
        ModelError
            If the trial is a ring-down, or begins at rest where there is none, or a port of a load does not
            exist.
        """
        gain, tare, place, at_ports = load
        name = self.description.name
        if (at_ports or laws.spans) and not trial.is_dynamic:
            raise ModelError(
                f"The trial {trial.name!r} has no time, which a law or a force in time asks for."
            )
        if trial.kind is TrialKind.RINGDOWN and self.description.is_plain:
            raise ModelError(
                f"The trial {trial.name!r} is a ring-down, which no force with a course in time can act on; "
                'say kind = "driven" and begins = "unknown".'
            )
        if trial.kind is TrialKind.RINGDOWN:
            raise ModelError(
                f"The trial {trial.name!r} is a ring-down, which the lumped model {name!r} cannot begin: it "
                'is free, driven or has states; say kind = "driven" and begins = "unknown".'
            )
        if trial.kind is TrialKind.STATIC:
            row = self._padded(self._inputs[self.recorded(trial)[0].name].vector)
            place = place if place is None else self._padded(place)
            force = acting_force(trial, gain, tare)
            return self._static(trial, force, row if place is None else place, self.shown(outputs), laws)
        try:
            motion, drives = self.moved(trial, conditions, laws, load, refinement)
            return motion.response(self.shown(outputs, drives, motion.acting.references))
        except ModelError as cause:
            raise ModelError(f"The trial {trial.name!r} of {name!r}: {cause}") from cause

    def moved(
        self, trial: Trial, conditions: Conditions, laws: Laws, load: ActingLoad, refinement: int = 1
    ) -> tuple[RigMotion, tuple[str, ...]]:
        """Return the motion of a dynamic trial, and the inputs whose motion is prescribed."""
        gain, tare, place, at_ports = load
        rig, acting, drives = self.acting(trial, conditions, gain, tare, place)
        if at_ports:
            acting = replace(acting, loads=(*acting.loads, *(self._at_port(item, rig) for item in at_ports)))
        return rig.motion(acting, laws, refinement), drives

    def _at_port(self, load: PortLoad, rig: Rig) -> tuple[FloatArray, FormulaCourse]:
        """Return the row and the course of a load at a port."""
        row = rig.acting_rows.get(load.port)
        if row is None:
            raise ModelError(
                f"A force acts at the port {load.port!r}, which {self.description.name!r} does not have; it "
                f"has {', '.join(rig.ports) or 'none'}."
            )
        spans = tuple(window.span for window in load.windows)
        return row, FormulaCourse(course_of(load.force, load.kind), spans)

    def _static(
        self, trial: Trial, force: FloatArray, row: FloatArray, shown: Sequence[Shown], laws: Laws
    ) -> Response:
        """Return the response of a static trial."""
        rig = self.rig()
        modal = (np.outer(force, row) + self._constant) @ rig.shapes[:, : len(rig.angular_frequency)]
        try:
            q, v, _ = rig.settled(modal, np.zeros((len(force), 0)), laws)
        except ModelError as cause:
            raise ModelError(f"The trial {trial.name!r} is static, but {cause}") from cause
        n, shapes = rig.displacements, rig.shapes
        values = [
            q @ (item.row[:n] @ shapes[:n]) + v @ (item.row[n:] @ shapes[n:]) + item.constant
            for item in shown
        ]
        return Response(np.stack(values, axis=1))

    def moving(self, trial: Trial, conditions: Conditions, *, still: bool = False) -> RigMotion:
        """Return the motion of a dynamic trial under the model's own laws; `still`: from rest."""
        rig, acting, _ = self.acting(trial, conditions, 0.0, 0.0, None)
        return rig.motion(replace(acting, begins=Start.STILL) if still else acting, self._laws)

    def port_motion(
        self, trial: Trial, conditions: Conditions, load: ActingLoad
    ) -> tuple[FloatArray, FloatArray]:
        """Return positions and speeds (N, P) of the ports in a dynamic trial, without laws."""
        motion, _ = self.moved(trial, conditions, NO_LAWS, load)
        shapes = np.array(list(motion.rig.ports.values())).reshape(-1, self.width) @ motion.rig.shapes
        return motion.q @ shapes.T, motion.velocity @ shapes.T

    def shown(
        self,
        outputs: Sequence[tuple[str, Quantity]],
        drives: Sequence[str] = (),
        references: Mapping[str, Sequence[tuple[FloatArray, Course]]] = MappingProxyType({}),
    ) -> list[Shown]:
        """Return what each output shows of a rig with some motions prescribed."""
        known = {item.name: item for item in self.description.output}
        found = []
        for name, quantity in outputs:
            item = known[name]
            further = quantity.derivatives_of(item.quantity)
            if item.reaction is not None:
                if item.reaction not in drives:
                    raise ModelError(
                        f"The output {name!r} of {self.description.name!r} is the reaction of "
                        f"{item.reaction!r}, whose motion this trial does not prescribe."
                    )
                found.append(Shown(np.zeros(self.width), reaction=list(drives).index(item.reaction)))
                continue
            if item.controller is not None:
                (loop,) = (loop for loop in self._loops if loop.section.name == item.controller)
                effort = loop.effort(references.get(item.controller, ()))
                found.append(Shown(np.zeros(self.width), effort=effort))
                continue
            row = self._padded(item.vector or ())
            found.append(
                Shown(row, order_of(item.quantity) + further, further, constant=item.constant * (not further))
            )
        return found
