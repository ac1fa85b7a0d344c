"""What holds the belief of a twin, and its notices: one protocol, the exact filter of the graphical model.

An estimator has no state of its own. What it carries from step to step are arrays that it hands out with each
estimate and is given back for the next: a twin that keeps them can smooth over them, go back and take in what
came late, and be stored and continued to the last bit.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reporting.arrays import Float
from reporting.words import listing
from twin_master.errors import ImpossibleObservation
from twin_master.network.graphical_model import GraphicalModel
from twin_master.network.inference import filter_sequence, smooth
from twin_master.scenario.schema import Scenario

BELIEVED = 0.5
"""Largest probability of "none of these" with which a state is still believed."""


def is_state_believed(none_of_these: float) -> bool:
    """Return whether a state may be told, given the probability that none explains the sensors."""
    return none_of_these <= BELIEVED


class SensorModel(Protocol):
    """What the sensors say in each state: a `GaussianSensorModel`, or one of a user's own.

    It may have `worst_residuals(observation, control_index)`, a mapping of the sensors that fit worst to
    their standardised residuals, for the message about an impossible observation.
    """

    def log_likelihood(self, observation: ArrayLike, control_index: int, /) -> Float:
        """Return log p(o | D, u) for each state (S,); of an observation (G,), NaN where a sensor is lost."""


@dataclass(frozen=True)
class Carried:
    """What an estimator carries from one step to the next.

    Attributes
    ----------
    control_index : int
        Control u_t in force in the step.
    arrays : dict of str to array
        All that the estimator needs of the step, to go on and to smooth.
    """

    control_index: int
    arrays: Mapping[str, NDArray[Any]]


@dataclass(frozen=True)
class Learnt:
    """Posterior of a quantity that does not change in time.

    Attributes
    ----------
    mean, standard_deviation, lower, upper : float
        Moments and the bounds of the central 90 % interval, in `unit`.
    unit : str
    """

    mean: float
    standard_deviation: float
    lower: float
    upper: float
    unit: str = "1"

    @property
    def figures(self) -> tuple[float, float, float, float]:
        """Mean, standard deviation and the bounds of the interval."""
        return self.mean, self.standard_deviation, self.lower, self.upper


@dataclass(frozen=True)
class Notice:
    """Something that the operator should know.

    Attributes
    ----------
    kind : str
        What sort of notice, for programs: `alarm`, `gauge_left_out`, ...
    sentence : str
        For people; an alarm ends with the command to type.
    sensors : tuple of int
        Numbers of the sensors that it concerns, from 1.
    value : float or None
        The figure that it rests on.
    since : int or None
        The step since about which it is so, of an alarm.
    """

    kind: str
    sentence: str
    sensors: tuple[int, ...] = ()
    value: float | None = None
    since: int | None = None

    def as_record(self) -> dict[str, Any]:
        """Return it as it stands in a journal, with lists in the place of tuples."""
        return vars(self) | {"sensors": list(self.sensors)}


@dataclass(frozen=True)
class Suspicion:
    """How well the model explains the sensors up to a step.

    A log e-value is the logarithm of the evidence for a fault over that for the model; its exponential has a
    mean of one where the model holds, at every step.

    Attributes
    ----------
    none_of_these : float
        Posterior probability that no state of the model explains the sensors.
    gauge_off : float
        Posterior probability that a single sensor does not show what is there.
    log_evidence_none, log_evidence_any_gauge : float
        Log e-values of the two.
    log_evidence_gauge : (G,)
        Log e-value of each sensor.
    left_out : (G,)
        Whether the readings of a sensor are absurd and left out.
    hypotheses : dict of str to float
        Probability of what may hold by name, see `Hypothesis`.
    decided_by : str
        That of them which adds most to the probability of the control that is decided for.
    """

    none_of_these: float
    gauge_off: float
    log_evidence_none: float
    log_evidence_any_gauge: float
    log_evidence_gauge: Float
    left_out: NDArray[np.bool_]
    hypotheses: Mapping[str, float] = field(default_factory=dict)
    decided_by: str = "model"


@dataclass(frozen=True)
class Hypothesis:
    """What may hold in a step.

    Attributes
    ----------
    name : str
        `model`, `gauge 5 off`, ..., `none of these`.
    probability : float
    belief : (S,) or None
        p(D_t | hypothesis, o_0..o_t); None where no state is believed.
    """

    name: str
    probability: float
    belief: Float | None


@dataclass(frozen=True)
class Estimate:
    """What an estimator concludes in one step t.

    Attributes
    ----------
    forecast : (S,)
        p(D_t | o_0..o_{t-1}).
    filtered : (S,)
        p(D_t | o_0..o_t), under all hypotheses that believe in a state.
    log_evidence : float
        log p(o_t | o_0..o_{t-1}), under the model, as the forecast.
    carried : Carried
        For the step after.
    learnt : dict of str to Learnt
        Posterior of what is learnt, by name.
    notices : tuple of Notice
        What the operator should know of this step.
    suspicion : Suspicion or None
        How well the model explains the sensors, where that is watched.
    hypotheses : tuple of Hypothesis
        What may hold, where more than the model is compared; those that are very improbable are left out.
    """

    forecast: Float
    filtered: Float
    log_evidence: float
    carried: Carried
    learnt: Mapping[str, Learnt] = field(default_factory=dict)
    notices: tuple[Notice, ...] = ()
    suspicion: Suspicion | None = None
    hypotheses: tuple[Hypothesis, ...] = ()

    @property
    def unexplained(self) -> float:
        """Probability of what believes in no state."""
        return sum(one.probability for one in self.hypotheses if one.belief is None)


class Estimator(Protocol):
    """What holds the belief: the exact filter, or one that learns beside it."""

    @property
    def model(self) -> GraphicalModel:
        """States, controls, prior and transitions: what the twin predicts with."""

    def step(self, before: Carried | None, observation: Float, control_index: int, step: int) -> Estimate:
        """Advance the belief to step t and correct it by an observation.

        Parameters
        ----------
        before : Carried or None
            Of step t - 1; None at the first step, which starts from the prior.
        observation : (G,)
            SI; NaN where a sensor is lost. With all of them lost the belief is predicted through.
        control_index : int
            Control u_t in force.
        step : int
            Number t of the step, for messages.

        Raises
        ------
        ImpossibleObservation
            The observation has probability zero wherever the belief has support.
        """

    def smoothed(self, carried: Sequence[Carried]) -> Float:
        """Return p(D_k | o_0..o_t) for the steps of `carried`, which end at t: (n, S)."""


class ExactFilter:
    """The exact filter and smoother: Kapteyn et al. 2021, eqs. (2), (28)-(31).

    It carries the logarithm of the filtered belief, `log_filtered` (S,).

    Parameters
    ----------
    model : GraphicalModel
    sensor_model : SensorModel
    name : str
        Name of the twin, for messages.
    """

    def __init__(self, model: GraphicalModel, sensor_model: SensorModel, name: str = "twin") -> None:
        self.model = model
        self._sensor_model, self._name = sensor_model, name

    def step(self, before: Carried | None, observation: Float, control_index: int, step: int) -> Estimate:
        """Advance the belief to step t and correct it by an observation, see `Estimator.step`."""
        likelihood = self._sensor_model.log_likelihood(observation, control_index)
        followed = None if before is None else (before.arrays["log_filtered"], before.control_index)
        try:
            filtering = filter_sequence(self.model, [control_index], likelihood[None], followed)[0]
        except ImpossibleObservation:
            own = getattr(self._sensor_model, "worst_residuals", None)
            worst = None if own is None else own(observation, control_index)
            raise ImpossibleObservation(self._name, step, worst) from None
        carried = Carried(control_index, {"log_filtered": filtering.log_filtered})
        return Estimate(filtering.forecast, filtering.filtered, float(filtering.log_evidence), carried)

    def smoothed(self, carried: Sequence[Carried]) -> Float:
        """Return p(D_k | o_0..o_t) for the steps of `carried`, which end at t: (n, S)."""
        size = self.model.states.size
        rows = np.array([step.arrays["log_filtered"] for step in carried]).reshape(-1, size)
        return smooth(self.model, [step.control_index for step in carried], rows)


@dataclass(frozen=True)
class Words:
    """How sentences speak of steps and sensors.

    Attributes
    ----------
    step, sensor : str
        What one is called.
    factor : float
        From the values of the sensors, SI, to what is printed.
    units : tuple of str
        Printed unit of each sensor; none where they are empty or "1".
    names : tuple of str
        What each sensor is called beside its number, if anything.
    command : str
        What looks for the cause of an alarm; empty where nothing can.
    """

    step: str = "step"
    sensor: str = "gauge"
    factor: float = 1.0
    units: tuple[str, ...] = ()
    names: tuple[str, ...] = ()
    command: str = "uav-twin discrepancy run --from-run DIR"

    @classmethod
    def of(cls, scenario: Scenario) -> "Words":
        """Return how sentences speak of the steps and sensors of a scenario."""
        observation = scenario.observation
        own = scenario.mission.step_name, observation.word, *observation.printed, observation.titles
        return cls(*own) if scenario.searchable else cls(*own, command="")

    def value(self, sensor: int, *values: float) -> list[str]:
        """Return values of a sensor as they are printed."""
        unit = self.units[sensor] if self.units else "1"
        return [f"{self.factor * value:.4g}{'' if unit == '1' else f' {unit}'}" for value in values]

    def sensors(self, numbers: Sequence[int]) -> str:
        """Return sensors, counted from 0, in words."""
        names = [f"{g + 1} ({self.names[g]})" if self.names else str(g + 1) for g in numbers]
        return f"{self.sensor}{'s' if len(names) > 1 else ''} {listing(names)}"
