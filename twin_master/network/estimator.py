"""Estimators of the belief of a twin: their protocol, and what a twin keeps of their steps.

An estimator has no state of its own. It returns the arrays that it needs of a step with each
estimate, and receives them for the next step. So a twin that keeps these arrays can smooth over the
steps, filter again with late observations, and be stored and continued to the last bit.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reporting.arrays import AnyArray, Float
from reporting.json_file import JsonObject
from reporting.words import listing
from twin_master.network.graphical_model import GraphicalModel
from twin_master.scenario.schema import Scenario

CarriedArrays = Mapping[str, AnyArray]
"""Arrays of several types by name, which an estimator carries from step to step."""
BELIEVED = 0.5
"""Largest probability that no state explains the sensors with which a state is still believed.

Beyond one half, that explanation is more probable than all others together."""
RECENT_STEPS = 3
"""The last steps of which all arrays are kept: most late observations are of one of them."""
CHECKPOINT_STEPS = 40
"""Of earlier steps, all arrays are kept once in so many steps."""


MOMENTS = ("mean", "standard_deviation", "lower", "upper")
"""The stored numbers of each posterior; the last two bound the central 90 % interval."""


def is_state_believed(none_of_these: float) -> bool:
    """Return whether the twin believes in any state.

    `none_of_these` is the probability that no state of the model explains the sensors.
    """
    return none_of_these <= BELIEVED


class SensorModel(Protocol):
    """The probability of observations in each state: a `GaussianSensorModel`, or a user's own.

    It may have a method `worst_residuals(observation, control_index)`. That returns the
    standardised residuals of the sensors that fit worst, by name, for the message about an
    impossible observation.

    Missions and fleets take a `GaussianSensorModel` or a class derived from it. Its vectorised form
    `log_likelihood_sequence(observations, control_index)`, (T, G) and (T,) -> (T, S), gives the
    likelihoods of many twins at once; each of the two methods has the other as its default.
    """

    def log_likelihood(self, observation: ArrayLike, control_index: int, /) -> Float:
        """Return log p(o | D, u) of an observation for each state: (S,).

        Parameters
        ----------
        observation : (G,) array
            The sensor values, SI; NaN where a sensor is lost.
        control_index : int
            The control u in force.
        """


@dataclass(frozen=True)
class Carried:
    """The arrays that an estimator carries from one step to the next.

    Attributes
    ----------
    control_index : int
        The control u_t in force in the step.
    arrays : dict of str to array
        All that the estimator needs of the step, to go on and to smooth.
    """

    control_index: int
    arrays: CarriedArrays


@dataclass(frozen=True)
class Learnt:
    """Posterior of a quantity that does not change in time.

    Attributes
    ----------
    mean, standard_deviation : float
        The moments of the quantity, in `unit`.
    lower, upper : float
        The bounds of its central 90 % interval, in `unit`.
    unit : str
        The unit of the quantity.
    """

    mean: float
    standard_deviation: float
    lower: float
    upper: float
    unit: str = "1"

    @property
    def moments_and_bounds(self) -> tuple[float, float, float, float]:
        """The numbers of the posterior, in the order of `MOMENTS`."""
        return self.mean, self.standard_deviation, self.lower, self.upper


@dataclass(frozen=True)
class Notice:
    """Something that the operator should know.

    Attributes
    ----------
    kind : str
        The kind of notice, for programs: `alarm`, `gauge_left_out`, ...
    sentence : str
        The notice in words. An alarm ends with the command that looks for its cause.
    sensors : tuple of int
        The numbers of the sensors that it concerns, from 1.
    value : float or None
        The number on which the notice is based, such as a probability or a reading in SI.
    since : int or None
        For an alarm, the step in which the fault is estimated to have begun.
    """

    kind: str
    sentence: str
    sensors: tuple[int, ...] = ()
    value: float | None = None
    since: int | None = None

    def as_record(self) -> JsonObject:
        """Return the notice as a record for the journal, with a list for the tuple of sensors."""
        return vars(self) | {"sensors": list(self.sensors)}


@dataclass(frozen=True)
class Suspicion:
    """How well the model explains the sensors up to a step.

    A log e-value is the logarithm of the evidence for a fault over that for the model. Its
    exponential has a mean of one at every step if the model holds.

    Attributes
    ----------
    none_of_these : float
        The posterior probability that no state of the model explains the sensors.
    gauge_off : float
        The posterior probability that a single sensor is off.
    log_evidence_none, log_evidence_any_gauge : float
        The log e-values that no state explains the sensors, and that a single sensor is off.
    log_evidence_gauge : (G,) array
        The log e-value of each sensor.
    left_out : (G,) array of bool
        Whether the readings of a sensor are left out: absurd, or stuck.
    hypotheses : dict of str to float
        The probability of each hypothesis by name, see `Hypothesis`.
    decided_by : str
        The hypothesis that adds most to the probability of the chosen control.
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
    """A hypothesis about the sensors in a step, and the belief about the state under it.

    Attributes
    ----------
    name : str
        `model`, `gauge 5 off`, ..., `none of these`.
    probability : float
        The posterior probability of the hypothesis.
    belief : (S,) array or None
        p(D_t | hypothesis, o_0..o_t); None if no state is believed under the hypothesis.
    """

    name: str
    probability: float
    belief: Float | None


@dataclass(frozen=True)
class Estimate:
    """The conclusions of an estimator in one step t.

    Attributes
    ----------
    forecast : (S,) array
        p(D_t | o_0..o_{t-1}), under the model.
    filtered : (S,) array
        p(D_t | o_0..o_t), averaged over all hypotheses under which a state is believed.
    log_evidence : float
        log p(o_t | o_0..o_{t-1}), under the model.
    carried : Carried
        The arrays that the next step needs.
    learnt : dict of str to Learnt
        The posterior of each learnt quantity, by name.
    notices : tuple of Notice
        The notices to the operator in this step.
    suspicion : Suspicion or None
        How well the model explains the sensors; None if that is not watched.
    hypotheses : tuple of Hypothesis
        The hypotheses that are not very improbable; empty if only the model is considered.
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
        """Probability of the hypotheses under which no state is believed."""
        return sum(
            hypothesis.probability for hypothesis in self.hypotheses if hypothesis.belief is None
        )


class Estimator(Protocol):
    """The estimator of a twin's belief: an exact filter, a learning one, or one with a watch.

    It may have a method `for_smoothing(carried)`, which returns the `Carried` of a step with those
    arrays alone that `smoothed` needs of earlier steps. The twin then keeps no more of most steps,
    and filters observations again where it needs the rest.
    """

    @property
    def model(self) -> GraphicalModel:
        """States, controls, prior and transitions, with which the twin predicts."""

    def step(
        self, before: Carried | None, observation: Float, control_index: int, step: int
    ) -> Estimate:
        """Advance the belief to step t and correct it by an observation.

        Parameters
        ----------
        before : Carried or None
            What was carried on from step t - 1; None in the first step, which starts from the
            prior.
        observation : (G,) array
            The sensor values, SI; NaN where a sensor is lost. If all are lost, the belief is
            predicted through the step.
        control_index : int
            The control u_t in force.
        step : int
            The number t of the step, for messages.

        Raises
        ------
        ImpossibleObservation
            If the observation has probability zero in every state that the belief allows.
        """

    def smoothed(self, carried: Sequence[Carried]) -> Float:
        """Return p(D_k | o_0..o_t) over S states for n consecutive steps k, up to step t: (n, S).

        Parameters
        ----------
        carried : sequence of Carried
            What was carried on from each of the n steps; empty if n is 0.
        """


@dataclass(frozen=True)
class KeptStep:
    """A step that the twin keeps.

    Attributes
    ----------
    observation : (G,) array
        The observed values, SI; NaN where nothing was received.
    carried : Carried
        The arrays that the estimator carried on from the step.
    proposals : int
        How often in a row a harder control was proposed, this step included; 0 without a `Hold`.
    is_complete : bool
        Whether `carried` has all arrays, and not only those for smoothing.
    """

    observation: Float
    carried: Carried
    proposals: int = 0
    is_complete: bool = True


class KeptSteps:
    """The last steps of a twin, by their numbers.

    The arrays with which an estimator goes on may be large. If it tells which of them smoothing
    needs (`Estimator.for_smoothing`), only these are kept of most steps. The others are computed
    anew when they are needed: the observations since the last complete step are filtered again,
    with the same result to the last bit.

    Parameters
    ----------
    estimator : Estimator
        The estimator that filters the steps.
    most : int or None
        The number of last steps that are needed; all if it is None. A few earlier ones are kept,
        too, back to a complete one.

    Attributes
    ----------
    end : int
        The number of the step after the last one.
    """

    def __init__(self, estimator: Estimator, most: int | None) -> None:
        self._estimator = estimator
        self._most = most
        self._steps: deque[KeptStep] = deque()
        self.end = 0
        # The first step that this estimator has filtered, and not that of a restored state.
        self._first_filtered = 0

    def __getitem__(self, step: int) -> KeptStep:
        """Return a kept step; an IndexError is raised if it is not kept."""
        index = step - self.end + len(self._steps)
        if index < 0:
            raise IndexError(f"step {step} is not kept")
        return self._steps[index]

    @property
    def first(self) -> int:
        """The number of the first step that is needed."""
        count = len(self._steps)
        return self.end - (count if self._most is None else min(count, self._most))

    def restore(self, end: int, steps: Iterable[KeptStep]) -> None:
        """Replace all steps by complete ones, the last of which has the number `end` - 1."""
        self._steps = deque(steps)
        self.end = end
        self._first_filtered = end

    def replace_from(self, step: int, new_steps: Sequence[KeptStep]) -> None:
        """Replace the steps from number `step` on by complete ones."""
        for _ in range(self.end - step):
            self._steps.pop()
        self._steps.extend(new_steps)
        self.end = step + len(new_steps)
        self._leave_out_arrays(step)
        self._leave_out_steps()

    def _leave_out_arrays(self, first_new: int) -> None:
        """Keep only the arrays for smoothing of steps that are no longer recent."""
        for_smoothing = getattr(self._estimator, "for_smoothing", None)
        if for_smoothing is None:
            return
        first = max(first_new - RECENT_STEPS, self._first_filtered)
        for step in range(first, self.end - RECENT_STEPS):
            kept_step = self[step]
            if kept_step.is_complete and step % CHECKPOINT_STEPS != 0:
                self._steps[step - self.end] = replace(
                    kept_step, carried=for_smoothing(kept_step.carried), is_complete=False
                )

    def _leave_out_steps(self) -> None:
        """Keep only the needed steps, and earlier ones back to the last complete step."""
        if self._most is None:
            return
        count = 0
        for index in range(1, len(self._steps) - self._most + 1):
            if self._steps[index].is_complete:
                count = index
        for _ in range(count):
            self._steps.popleft()

    def complete_steps(self, first: int, end: int) -> list[KeptStep]:
        """Return the steps from number `first` up to `end` with all arrays."""
        begin = first
        while begin < end and not self[begin].is_complete:
            begin -= 1
        complete_steps: list[KeptStep] = []
        for step in range(begin, end):
            kept_step = self[step]
            if not kept_step.is_complete:
                with np.errstate(over="ignore", invalid="ignore"):
                    estimate = self._estimator.step(
                        complete_steps[-1].carried,
                        kept_step.observation,
                        kept_step.carried.control_index,
                        step,
                    )
                kept_step = replace(kept_step, carried=estimate.carried, is_complete=True)
            complete_steps.append(kept_step)
        return complete_steps[first - begin :]


@dataclass(frozen=True)
class NoticeWording:
    """The words and units with which notices name the steps and sensors of a scenario.

    Attributes
    ----------
    step, sensor : str
        The nouns for a step and for a sensor.
    factor : float
        The factor from a sensor value in SI to the printed number.
    units : tuple of str
        The printed unit of each sensor; no unit is printed if it is empty or "1".
    names : tuple of str
        The name of each sensor, printed beside its number; empty if sensors have only numbers.
    command : str
        The command that looks for the cause of an alarm; empty if none can.
    """

    step: str = "step"
    sensor: str = "gauge"
    factor: float = 1.0
    units: tuple[str, ...] = ()
    names: tuple[str, ...] = ()
    command: str = "uav-twin discrepancy run --from-run DIR"

    @classmethod
    def of(cls, scenario: Scenario) -> NoticeWording:
        """Return the wording for the steps and sensors of a scenario."""
        observation = scenario.observation
        factor, units = observation.printed
        return cls(
            step=scenario.mission.step_name,
            sensor=observation.word,
            factor=factor,
            units=units,
            names=observation.titles,
            command=cls.command if scenario.searchable else "",
        )

    def format_values(self, sensor: int, *values: float) -> list[str]:
        """Return SI values of a sensor, counted from 0, as text in its printed unit."""
        unit = self.units[sensor] if self.units else "1"
        unit_text = "" if unit == "1" else f" {unit}"
        return [f"{self.factor * value:.4g}{unit_text}" for value in values]

    def name_step(self, step: int) -> str:
        """Return the beginning of a sentence about a step, such as "Step 12"."""
        return f"{self.step.capitalize()} {step}"

    def notice_of_return(self, step: int, sensor: int, value: float | None = None) -> Notice:
        """Return the notice that readings of a sensor, counted from 0, are used again.

        Parameters
        ----------
        value : float, optional
            The first of these readings, SI.
        """
        sentence = (
            f"{self.name_step(step)}: the readings of {self.name_sensors([sensor])} are back, and "
            "used again."
        )
        return Notice("gauge_back", sentence, (sensor + 1,), value)

    def name_sensors(self, sensors: Sequence[int]) -> str:
        """Return sensors, counted from 0, in words, such as "gauges 1 (root) and 3 (tip)"."""
        names = [f"{g + 1} ({self.names[g]})" if self.names else str(g + 1) for g in sensors]
        noun = f"{self.sensor}s" if len(sensors) > 1 else self.sensor
        return f"{noun} {listing(names)}"
