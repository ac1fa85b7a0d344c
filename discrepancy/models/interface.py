"""What the workflow asks of a model: structural response under a patch, before any sensor touches it."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from discrepancy.campaign.records import Campaign, FloatArray, Quantity, Release, Start, Trial, TrialKind
from discrepancy.errors import ModelError
from fe.runtime.patch import ModelPatch, Primitive
from reporting.words import counted

Place = str | tuple[float, float]
DEFAULT_PLACE = "tip_load"
"""What a campaign says when it does not say where the force acts; a model with one input takes that one."""


@dataclass(frozen=True)
class ModelParameter:
    """A calibrated parameter of the model; its posterior from calibration is the prior here.

    Attributes
    ----------
    name : str
        Such as "young_modulus_factor".
    mean, deviation : float
        Mean and standard deviation [unit].
    unit : str
        SI.
    low, high : float
        Range in which the model holds.
    """

    name: str
    mean: float
    deviation: float
    unit: str
    low: float
    high: float


@dataclass(frozen=True)
class PortScale:
    """Natural scales of a port for the campaign at hand: they make dimensionless effects physical.

    Attributes
    ----------
    displacement : float
        A, the largest motion of the port by the unpatched model in the dynamic trials that are fitted; in the
        other trials if there are none [m or rad].
    stiffness : float
        k, the stiffness of the first bending mode seen at the port, w1^2 / phi1(port)^2 [N/m or N m/rad].
    angular_frequency : float
        w1 [rad/s].
    static_stiffness : float or None
        1 / (p . K^-1 p), the stiffness at rest seen at the port [N/m or N m/rad]. At a stiff joint it is a
        small part of `stiffness`, and no effect can take away more. None: not known, taken as `stiffness`.
    largest_displacement : float or None
        The largest motion of the port in all trials, flights too [m or rad]. None: taken as `displacement`.
    spread : tuple of (float, float)
        Where a force at the port acts: its share, and the motion there over that of the port, by place. A
        force that is spread over the wing acts on the motion of each place, and A is the mean's.
    free : bool
        Whether nothing holds the port (a body that falls or rolls), so that no place is its zero.
    turns : bool
        Whether its motion turns in a trial, or may: one that goes one way shows no memory.
    of_state : bool
        Whether it is a port of a state (a level, a temperature), at which laws are flows: `displacement`
        times `angular_frequency` is then its largest value, `displacement` times `stiffness` the flow scale.
    driven : bool
        Whether drives alone move it, so that no force holds it still.
    """

    displacement: float
    stiffness: float
    angular_frequency: float
    static_stiffness: float | None = None
    largest_displacement: float | None = None
    spread: tuple[tuple[float, float], ...] = ((1.0, 1.0),)
    free: bool = False
    turns: bool = True
    of_state: bool = False
    driven: bool = False

    def mean_power(self, exponent: float) -> float:
        """Return the mean of |motion / A|^exponent over the places where a force at the port acts."""
        return sum((share * float(abs(motion) ** exponent) for share, motion in self.spread), 0.0)


@dataclass(frozen=True)
class Scales:
    """Natural scales of a model under a campaign.

    Attributes
    ----------
    length : float
        Semi-span or characteristic length L [m].
    tip_stiffness : float
        Static stiffness at the load point [N/m].
    modal_mass : float
        Mass of the first mode referred to the load point [kg].
    angular_frequency : float
        w1 [rad/s].
    force, load_factor : float
        Largest applied force [N] and load factor [1] of the campaign.
    duration : float
        Longest dynamic record [s]; 1 without one.
    campaign_time : float
        Time from the first to the last sample of the campaign [s]; 1 if unknown.
    ports : mapping of str to PortScale
        By port name; besides those of `Model.ports` the places of forces that are spread over the structure.
    """

    length: float
    tip_stiffness: float
    modal_mass: float
    angular_frequency: float
    force: float
    load_factor: float
    duration: float
    campaign_time: float
    ports: Mapping[str, PortScale]


def campaign_sizes(campaign: Campaign) -> dict[str, float]:
    """Return what `Scales` has of the campaign alone: force, load factor, duration and campaign time."""
    trials = campaign.trials
    moments = [trial.start + trial.time if trial.is_dynamic else trial.time for trial in trials]
    span = float(max(map(np.max, moments)) - min(map(np.min, moments))) if moments else 0.0
    lengths = (float(trial.time[-1] - trial.time[0]) for trial in trials if trial.is_dynamic)
    return {
        "force": max((float(np.max(np.abs(trial.force))) for trial in trials), default=0.0),
        "load_factor": max((float(np.max(np.abs(trial.load_factor))) for trial in trials), default=0.0),
        "duration": max(lengths, default=1.0),
        "campaign_time": span or 1.0,
    }


@dataclass(frozen=True)
class Conditions:
    """All that a response depends on besides trial and patch.

    Attributes
    ----------
    parameters : (P,) ndarray
        Values of `Model.parameters`, in order.
    initial : (R, 2) ndarray
        Ring-downs. At rest: column 0 holds deviations from the static release shape, in units of the release
        displacement, by mode, row 0 that of the whole shape (so the motion starts at (1 + initial[0, 0])
        times the static shape plus initial[r, 0] of mode r); column 1 is zero. Not at rest: displacement and
        velocity / w_r of mode r, in units of the release displacement, at the release point.
    clock : tuple of float
        (rate, zero): a sample stamped t shows the motion at (1 + rate) t + zero [1], [s].
    health : (N, 2) ndarray
        Stiffness losses z1, z2 of each row (dynamic trials: row 0 holds for all).
    offset : tuple of float
        Constants that the recorded inputs of a driven trial lack, in their order [SI]; empty: none.
    components : bool
        Whether `transverse` and `shear` are wanted.
    refinement : int
        Time steps are this many times smaller than usual, to check the integration.
    """

    parameters: FloatArray
    initial: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    clock: tuple[float, float] = (0.0, 0.0)
    health: FloatArray = field(default_factory=lambda: np.zeros((1, 2)))
    offset: tuple[float, ...] = ()
    components: bool = False
    refinement: int = 1

    @property
    def key(self) -> tuple[object, ...]:
        """All of it as a value that can be looked up."""
        return (
            self.parameters.tobytes(), self.initial.tobytes(), self.clock, self.health.tobytes(), self.offset,
            self.components, self.refinement,
        )  # fmt: skip


@dataclass(frozen=True)
class Response:
    """What perfect sensors would show.

    Attributes
    ----------
    values : (N, C) ndarray
        By output, SI units.
    rates : (N, C) ndarray or None
        Their time derivatives, for dynamic trials.
    transverse, shear : (N, C) ndarray or None
        Strain across the gauge's direction, and engineering shear strain, for strain outputs (zero for the
        others); None unless asked for.
    """

    values: FloatArray
    rates: FloatArray | None = None
    transverse: FloatArray | None = None
    shear: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class PortedSystem:
    """A model in motion as a linear system with ports: what a force that nobody knows of does to readings.

    s' = A s - sum_p b_p g_p, y = C s - sum_p e_p g_p, in the coordinates s = (q, q') of the modes. What is
    known to act is in the model's own response; s is what a missing force adds to it.

    Attributes
    ----------
    generator : (n, n) ndarray
        A [1/s].
    ports : tuple of str
        Names, P of them.
    actions : (P, n) ndarray
        b of each port: what takes its force from the state.
    positions, speeds : (P, n) ndarray
        Rows by which a port moves. A port of a state moves at the speed that the state is.
    outputs : (C, n) ndarray
        Rows of the outputs.
    through : (P, C) ndarray
        e of each port: what an output shows of its force at once.
    """

    generator: FloatArray
    ports: tuple[str, ...]
    actions: FloatArray
    positions: FloatArray
    speeds: FloatArray
    outputs: FloatArray
    through: FloatArray


Outputs = tuple[tuple[str, Quantity], ...]
"""Outputs, and the quantity wanted of each."""
NO_PATCH = ModelPatch()


class Model(Protocol):
    """A model that can be patched."""

    @property
    def name(self) -> str:
        """Name for people."""

    @property
    def parameters(self) -> tuple[ModelParameter, ...]:
        """Calibrated parameters."""

    def output_quantity(self, output: str) -> Quantity | None:
        """Return what an output is, or None if the model has no such output."""

    def supports(self, primitive: type[Primitive]) -> bool:
        """Whether the model can carry a primitive; sensors are not asked for: they need no model."""

    def ports(self) -> tuple[str, ...]:
        """Names of the ports where internal forces can act on one motion; user effects act at these."""

    def stations(self) -> tuple[float, float] | None:
        """Return the least and largest station [m] along the structure, None if it has no length."""

    def scales(self, campaign: Campaign) -> Scales:
        """Return the natural scales under a campaign."""

    def respond(self, trial: Trial, outputs: Outputs, patch: ModelPatch, conditions: Conditions) -> Response:
        """Return the response of a trial; sensor primitives in `patch` are ignored here.

        Parameters
        ----------
        trial : Trial
            Inputs and sample times.
        outputs : tuple of (str, Quantity)
            Output and the quantity wanted of it (velocity and acceleration are derivatives of displacement;
            a signal is the output itself).
        patch : ModelPatch
            Changes of structure, internal forces and loads.
        conditions : Conditions
            The rest.

        Returns
        -------
        Response
            Values without sensors.

        Raises
        ------
        ModelError
            If the model lacks an output or cannot carry a primitive.
        """


def prior_mean(campaign: Campaign, parameters: Sequence[ModelParameter]) -> FloatArray:
    """Return the means (P,) of parameters, those of the campaign where it says them."""
    return np.array([campaign.parameters.get(item.name, (item.mean, 0.0))[0] for item in parameters])


def check_parameters(what: str, parameters: Sequence[ModelParameter], values: FloatArray) -> None:
    """Refuse values of another number than a model, `what`, has parameters."""
    if values.shape != (len(parameters),):
        raise ModelError(f"{what} has {counted(len(parameters), 'parameter')}, but {values.size} came.")


def check_outputs(what: str, model: Model, outputs: Outputs, known: Iterable[str]) -> None:
    """Refuse outputs that a model, `what`, does not have beside those `known`, or no channel can measure."""
    for output, quantity in outputs:
        own = model.output_quantity(output)
        if own is None:
            raise ModelError(f"{what} has no output {output!r}; it has {', '.join(known)}.")
        if not quantity.shows(own):
            raise ModelError(
                f"{what}: the output {output!r} is a {own.value}, but a channel measures {quantity.value}."
            )


def place_among(places: Sequence[str], place: Place, what: str, where: str = "a trial") -> str:
    """Return the load place of a model, `what`, that a trial means: the only one where it says none.

    Raises
    ------
    ModelError
        If there is no such place, or none is named of several.
    """
    if place == DEFAULT_PLACE and place not in places and len(places) == 1:
        return places[0]
    if not isinstance(place, str) or place not in places:
        said = "no load_place is said" if place == DEFAULT_PLACE else f"the load place is {place!r}"
        known = f"forces at {', '.join(places)}: name one of these" if places else "no force"
        raise ModelError(f"In {where} {said}, and {what} takes {known}.")
    return place


def release_of(trial: Trial) -> Release:
    """Return how a ring-down began; raises `ModelError` where it does not say it."""
    if trial.release is None:
        raise ModelError(f"The ring-down {trial.name!r} does not say how it was released.")
    return trial.release


def check_no_inputs(trial: Trial, what: str) -> None:
    """Refuse a static trial under other inputs than a force, for a model that has none."""
    if trial.kind is TrialKind.STATIC and trial.inputs:
        names = ", ".join(repr(item.name) for item in trial.inputs)
        raise ModelError(
            f"The trial {trial.name!r} is static under the inputs {names}, which {what} does not have at "
            'rest: describe the asset as an FMU model with [[input]], or record the trial as "driven".'
        )


def check_lumped(trial: Trial, what: str) -> None:
    """Refuse a flight, and a static trial under other inputs than a force, for a model without either."""
    if trial.kind is TrialKind.FLIGHT:
        raise ModelError(f"The trial {trial.name!r} is a flight, but {what} has no lift; leave it out.")
    check_no_inputs(trial, what)


def check_plain(trial: Trial, what: str) -> None:
    """Refuse a driven trial, and a forced one that is not settled, for a model that cannot follow them."""
    if trial.kind is TrialKind.DRIVEN or trial.begins is not Start.SETTLED:
        came = "is driven" if trial.kind is TrialKind.DRIVEN else f"begins {trial.begins.value}"
        raise ModelError(
            f"The trial {trial.name!r} {came}, which {what} cannot follow: describe the rig as a lumped "
            "model, or record it forced from rest."
        )
