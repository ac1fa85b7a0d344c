"""A lumped model as a rig: its matrices, what acts in a trial, and what its outputs show."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from discrepancy.campaign.records import Campaign, Hold, Quantity, RecordedInput, Start, Trial, TrialKind
from discrepancy.errors import ModelError
from discrepancy.models.input_course import Course, Drive
from discrepancy.models.interface import Conditions, PortScale, Response, Scales
from discrepancy.models.lumped_file import InputSection, LumpedDescription, matrix_of
from discrepancy.models.rig import Acting, Rig, RigMotion, Shown, order_of
from fe.runtime.motion import NO_LAWS, Laws

FloatArray = NDArray[np.float64]


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
            np.zeros(description.size + description.states),
        )

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
        row = np.array(vector)
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
            at = slice(n, None) if of_states else slice(0, n)
            whole[at] = matrix @ row[at]
            row = whole
        return np.asarray(self.factors.get(name, 1.0) * row)

    def rig(self, drives: tuple[str, ...] = ()) -> Rig:
        """Return the rig with the motions of some inputs prescribed."""
        found = self._rigs.get(drives)
        if found is None:
            found = self._rigs[drives] = self._made(drives)
        return found

    def _made(self, drives: tuple[str, ...]) -> Rig:
        n, m = self.description.size, self.description.states
        mass, damping, stiffness = np.zeros((3, n + m, n + m))
        mass[:n, :n], mass[n:, n:] = self._parts["mass"], self._parts["capacity"]
        damping[:n, :n], damping[n:, n:] = self._parts["damping"], self._parts["conductance"]
        stiffness[:n, :n] = self._parts["stiffness"]
        coupling = self.description.coupling
        for content, into, rows, columns in (
            (coupling.force_of_states, damping, slice(0, n), slice(n, None)),
            (coupling.flow_of_speeds, damping, slice(n, None), slice(0, n)),
            (coupling.flow_of_displacements, stiffness, slice(n, None), slice(0, n)),
        ):
            if content is not None:
                into[rows, columns] = -np.atleast_2d(np.array(content))
        return Rig(
            mass, damping, stiffness, n,
            {item.name: np.array(item.vector) for item in self.description.port},
            np.array([self._inputs[name].vector for name in drives]).reshape(len(drives), n + m),
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
        offsets = (*conditions.offset, *(0.0,) * len(recorded))
        for item, offset in zip(recorded, offsets, strict=False):
            section = self._section(trial, item)
            values = item.values + offset if offset else item.values
            if section.quantity.moving:
                names.append(item.name)
                order = order_of(item.quantity)
                drives.append(Drive(trial.time, self.factors.get(item.name, 1.0) * values, order))
                continue
            if (gain or tare) and item.quantity in (Quantity.FORCE, Quantity.TORQUE):
                values = (1.0 + gain) * values + tare * (item.values != 0.0)
            vector = np.array(section.vector) if place is None else place
            loads.append(
                (self._vector(vector, section.through, item.name), Course(trial.time, values, item.hold))
            )
        drives += [Drive(trial.time, np.zeros(len(trial.time))) for _ in held]
        prescribed = (*names, *held)
        acts = Acting(
            trial.time,
            loads,
            self._constant,
            drives,
            trial.begins,
            conditions.initial.ravel(),
            conditions.clock,
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
        return (RecordedInput(place, self._inputs[place].quantity, trial.force, Hold.LINEAR),)

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
        load: tuple[float, float, FloatArray | None],
        refinement: int,
    ) -> Response:
        """Return the response of a trial; `load`: gain, tare and moved row of its force.

        Raises
        ------
        ModelError
            If the trial is a ring-down, or begins at rest where there is none.
        """
        gain, tare, place = load
        name = self.description.name
        if trial.kind is TrialKind.RINGDOWN:
            raise ModelError(
                f"The trial {trial.name!r} is a ring-down, which the lumped model {name!r} cannot begin: it "
                'is free, driven or has states; say kind = "driven" and begins = "unknown".'
            )
        if trial.kind is TrialKind.STATIC:
            row = self._vector(self._inputs[self.recorded(trial)[0].name].vector, None, "")
            force = trial.force * (1.0 + gain) + tare * (trial.force != 0.0)
            return self._static(trial, force, row if place is None else place, self.shown(outputs), laws)
        rig, acting, drives = self.acting(trial, conditions, gain, tare, place)
        try:
            return rig.motion(acting, laws, refinement).response(self.shown(outputs, drives))
        except ModelError as cause:
            raise ModelError(f"The trial {trial.name!r} of {name!r}: {cause}") from cause

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
        """Return the motion of a dynamic trial without laws; `still`: from rest under nothing."""
        rig, acting, _ = self.acting(trial, conditions, 0.0, 0.0, None)
        return rig.motion(replace(acting, begins=Start.STILL) if still else acting, NO_LAWS)

    def shown(self, outputs: Sequence[tuple[str, Quantity]], drives: Sequence[str] = ()) -> list[Shown]:
        """Return what each output shows of a rig with some motions prescribed."""
        known = {item.name: item for item in self.description.output}
        size = self.description.size + self.description.states
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
                found.append(Shown(np.zeros(size), reaction=list(drives).index(item.reaction)))
                continue
            row = np.array(item.vector)
            found.append(
                Shown(row, order_of(item.quantity) + further, further, constant=item.constant * (not further))
            )
        return found


def state_sizes(lumped: LumpedRig, campaign: Campaign, trial: Trial, conditions: Conditions) -> FloatArray:
    """Return natural sizes (L,) of a state at the begin of a trial: of motion from rest, and of data."""
    rig, _, drives = lumped.acting(trial, conditions, 0.0, 0.0, None)
    count, moving = len(rig.angular_frequency), rig.moving
    moved = lumped.moving(trial, conditions, still=True)
    x, v = (np.max(np.abs(item[:, :count]), axis=0) for item in (moved.q, moved.velocity))
    pace = np.maximum(rig.angular_frequency[:moving], 1.0 / float(trial.time[-1] - trial.time[0]))
    n, shapes = rig.displacements, rig.shapes[:, :count]
    channels = [campaign.channels[name] for name in trial.channels]
    shown = lumped.shown([(channel.output, channel.quantity) for channel in channels], drives)
    for column, item in enumerate(shown):
        kept = trial.values[trial.used[:, column], column] - item.constant
        if item.reaction is not None or not kept.size:
            continue
        size = float(np.max(np.abs(kept)))
        of_u, of_x = item.row[:n] @ shapes[:n, :moving], item.row[n:] @ shapes[n:, moving:]
        if np.any(of_u):
            at = size / float(np.linalg.norm(of_u)) / pace**item.order
            x[:moving], v[:moving] = np.maximum(x[:moving], at), np.maximum(v[:moving], at * pace)
        if np.any(of_x):
            v[moving:] = np.maximum(v[moving:], size / float(np.linalg.norm(of_x)))
    found = np.concatenate((x[:moving], v))
    return np.asarray(np.where(found > 0.0, found, max(float(found.max(initial=0.0)), 1e-9)))


TURNS = 1e-3
"""Share of the largest speed of a port that both directions must reach, for a motion that turns."""


class PortSizes:
    """What the ports of a model saw in a campaign, for scales that the structure does not have.

    Where no stiffness holds a port, its stiffness is the peak force over the peak displacement, and its
    angular frequency the peak speed over it: effects are measured by what acts and moves.

    Parameters
    ----------
    lumped : LumpedRig
        The model at its prior mean.
    driven_only : bool
        Whether all trials are followed in time from known inputs, so that what was not seen to turn does not.
    """

    def __init__(self, lumped: LumpedRig, *, driven_only: bool = False) -> None:
        self._rig, self._driven_only = lumped.rig(), driven_only
        self._sizes = {name: np.zeros(4) for name in self._rig.ports}
        self._turns = dict.fromkeys(self._rig.ports, False)

    def add(self, motion: RigMotion, measured: float, fitted: bool) -> None:
        """Take up the motion of a trial, and the largest force that was measured in it [N]."""
        rig = motion.rig
        count = len(rig.angular_frequency)
        drag = motion.velocity[:, :count] @ rig.free.damping.T
        for name, row in rig.ports.items():
            modal = row @ rig.shapes
            own = modal[:count]
            lent = float(own @ own)
            forces = np.abs(motion.acceleration[:, :count] @ own), np.abs(drag @ own)
            force = max(float(np.max(item)) for item in forces) / lent if lent > 0.0 else measured
            x, v = (float(np.max(np.abs(item @ modal))) for item in (motion.q, motion.velocity))
            self._sizes[name] = np.maximum(self._sizes[name], (x * fitted, x, v, force))
            speed = motion.velocity @ modal
            self._turns[name] |= bool(np.min(speed) < -TURNS * v and np.max(speed) > TURNS * v)

    def scale(self, name: str) -> PortScale:
        """Return the natural scales of a port."""
        usual, largest, speed, force = self._sizes[name].tolist()
        rig = self._rig
        along = (rig.ports[name] @ rig.shapes)[: rig.moving]
        frequency, weight = rig.angular_frequency[: rig.moving], along**2
        seen = weight > 1e-6 * float(weight.sum())
        amount = usual or largest or 1.0
        if np.any(seen) and np.all(frequency[seen] > 0.0):
            first = int(np.flatnonzero(seen)[0])
            still = 1.0 / float(np.sum(weight[seen] / frequency[seen] ** 2))
            w = float(frequency[first])
            return PortScale(amount, w**2 / float(weight[first]), w, still, largest or 1.0)
        free = not np.any(frequency[seen] > 0.0)
        return PortScale(
            amount, (force or 1.0) / amount, (speed or 1.0) / amount, None, largest or amount, free=free,
            turns=self._turns[name] or not (free and self._driven_only and np.any(seen)),
        )  # fmt: skip


def rig_scales(
    lumped: LumpedRig, parameters: FloatArray, campaign: Campaign, stations: tuple[float, float] | None
) -> Scales:
    """Return the natural scales of a rig under a campaign, at its prior mean."""
    driven_only = all(trial.is_dynamic and trial.kind is not TrialKind.RINGDOWN for trial in campaign.trials)
    conditions, ports = Conditions(parameters), PortSizes(lumped, driven_only=driven_only)
    rig, description = lumped.rig(), lumped.description
    force, peak, speed, weight = 0.0, 0.0, 0.0, 0.0
    for trial in campaign.trials:
        pushes = [
            float(np.max(np.abs(trial.values[trial.used[:, column], column]), initial=0.0))
            for column, name in enumerate(trial.channels)
            if campaign.channels[name].quantity in (Quantity.FORCE, Quantity.TORQUE)
        ]
        force = max(force, float(np.max(np.abs(trial.force))))
        if not trial.is_dynamic or trial.kind is TrialKind.RINGDOWN:
            continue
        try:
            motion = lumped.moving(trial, conditions)
        except ModelError:
            motion = lumped.moving(trial, conditions, still=True)
        ports.add(motion, max(pushes, default=0.0), not trial.held_out)
        here = motion.q @ motion.rig.shapes.T[:, : description.size]
        pace = motion.velocity @ motion.rig.shapes.T[:, : description.size]
        peak = max(peak, float(np.max(np.abs(here), initial=0.0)))
        speed = max(speed, float(np.max(np.abs(pace), initial=0.0)))
        weight = max(weight, float(np.max(np.abs(motion.rig.load_at(motion.acting, motion.time)))))
    dynamic = [trial for trial in campaign.trials if trial.is_dynamic]
    duration = max((float(trial.time[-1] - trial.time[0]) for trial in dynamic), default=1.0)
    elastic = rig.angular_frequency[rig.angular_frequency > 0.0]
    begins = [trial.start + (trial.time[0] if trial.is_dynamic else 0.0) for trial in campaign.trials]
    ends = [trial.start + (trial.time[-1] if trial.is_dynamic else 0.0) for trial in campaign.trials]
    frequency = float(elastic[0]) if len(elastic) else speed / peak if peak > 0.0 < speed else 1.0 / duration
    mass = float(np.trace(rig.mass)) / max(len(rig.mass), 1)
    stiffness = weight / peak if peak > 0.0 < weight else mass * frequency**2
    return Scales(
        length=description.characteristic_length or (max(map(abs, stations)) if stations else 0.0) or 1.0,
        tip_stiffness=stiffness,
        modal_mass=mass,
        angular_frequency=frequency,
        force=force or weight,
        load_factor=0.0,
        duration=duration,
        campaign_time=max(max(ends) - min(begins), 0.0) or 1.0,
        ports={item.name: ports.scale(item.name) for item in description.port},
    )
