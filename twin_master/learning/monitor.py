"""Notices of operation: a gauge that is off, states that do not explain the gauges, readings that are absurd.

Beside the model as it is (every gauge shows what the state, a draw of the parameter and noise of unknown scale
say) run rival hypotheses with filters of their own, so that state and parameter are marginalised under each: for
each gauge that its gain is free, and that the gain of every gauge is free, which no state of the model explains.
The ratio of the evidence of a rival to that of the model is an e-process: its mean under the model is at most
one at every turn, so that it exceeds a threshold c with a probability of at most 1 / c however often one looks
(Ville 1939; Ramdas, Grünwald, Vovk and Shafer 2023). What begins later is met by a mixture over its first turn.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from twin_master.learning.monitor_kernels import watch_turn
from twin_master.network.estimator import Carried, Estimate, Estimator, Learnt, Notice
from twin_master.network.graphical_model import GraphicalModel
from twin_master.network.sensor_model import GaussianSensorModel

__all__ = ["MonitorSettings", "WatchfulEstimator"]

Float = NDArray[np.float64]

COMMAND = "uav-twin discrepancy run --from-run DIR"
_PREFIX = "notice/"
_FROM_THE_START = 0.75
"""Prior share of faults that are there from the first turn; the others begin at a later one."""
_DRAWS = 15
"""Draws of the parameter that the rivals keep apart: they compare evidence, and need no fine posterior."""
_NAMED_SHARE = 0.1
_NAMED_DEVIATIONS = 2.0
_MOST_NAMED = 6


@dataclass(frozen=True)
class MonitorSettings:
    """What is noticed, and when.

    Attributes
    ----------
    threshold : float
        Of the e-processes: false alarms of each are at most 1 / threshold, whatever the number of turns.
    gain, all_gain : float
        Prior standard deviation of the gain error of a gauge that is off, and of every gauge where no state of
        the model explains them.
    absurd : float
        A reading this many assumed standard deviations beyond what any state can show is left out.
    memory_turns : float
        Turns after which what was learnt of a free gain has faded to 1 / e.
    onset : float
        Probability that what was right until then goes wrong in a turn.
    prior : float
        Prior probability of each of the two rivals, for their posterior.
    noise_degrees : float
        Degrees of freedom of the noise scale about the assumed one.
    """

    threshold: float = 100.0
    gain: float = 0.2
    all_gain: float = 0.1
    absurd: float = 8.0
    memory_turns: float = 20.0
    onset: float = 0.02
    prior: float = 0.01
    noise_degrees: float = 10.0


class WatchfulEstimator:
    """An estimator with notices beside it; its beliefs are those of the estimator, absurd readings left out.

    Parameters
    ----------
    inner : Estimator
        What holds the belief.
    sensor_model : GaussianSensorModel
        Predictions (E, S, U, G) and assumed noise.
    draws : (E,)
        Values of the parameter.
    settings : MonitorSettings
    """

    def __init__(
        self, inner: Estimator, sensor_model: GaussianSensorModel, draws: Float, settings: MonitorSettings
    ) -> None:
        self._inner, self._sensor_model, self._settings = inner, sensor_model, settings
        order = np.argsort(draws, kind="stable")
        places = np.linspace(0, len(order) - 1, min(_DRAWS, len(order))).round().astype(int)
        table = sensor_model.value_per_draw[order[places]]
        self._value = [np.ascontiguousarray(table[:, :, u]) for u in range(sensor_model.control_count)]
        deviation = sensor_model.total_standard_deviation
        self._inverse = [np.ascontiguousarray(1.0 / deviation[:, u]) for u in range(deviation.shape[1])]
        reach = settings.absurd * deviation
        self._low = (sensor_model.value_per_draw.min(axis=0) - reach).min(axis=0)  # (U, G)
        self._high = (sensor_model.value_per_draw.max(axis=0) + reach).max(axis=0)
        # A gauge that shows little needs the longest to be found: it is given more of the prior.
        response = np.mean((settings.gain * sensor_model.mean / deviation) ** 2, axis=(0, 1))
        weight = 1.0 / np.sqrt(1.0 + response / settings.gain**2)
        self._log_weight: Float = np.log(weight / weight.sum())

    @property
    def model(self) -> GraphicalModel:
        """States, controls, prior and transitions."""
        return self._inner.model

    def smoothed(self, carried: Sequence[Carried]) -> Float:
        """Return p(D_k | o_0..o_t) for the turns of `carried`, which end at t: (n, S)."""
        return self._inner.smoothed(carried)

    def turn(self, before: Carried | None, observation: Float, control_index: int, turn: int) -> Estimate:
        """Advance the belief to turn t and correct it by an observation, see `Estimator.turn`."""
        seen = self._sensor_model.checked(observation)
        absurd = (seen < self._low[control_index]) | (seen > self._high[control_index])
        used = np.where(absurd, np.nan, seen)
        estimate = self._inner.turn(before, used, control_index, turn)
        arrays = self._start() if before is None else self._advanced(before)
        self._assimilate(arrays, used, control_index)
        notices = self._left_out(arrays["absurd"], absurd, seen, control_index, turn)
        arrays["absurd"] = absurd
        log_gauge, log_none = self._log_evidence(arrays)
        notices += self._alarms(arrays, log_gauge, log_none, turn)
        carried = Carried(
            control_index,
            {**estimate.carried.arrays, **{_PREFIX + name: value for name, value in arrays.items()}},
        )
        return Estimate(
            forecast=estimate.forecast,
            filtered=estimate.filtered,
            log_evidence=estimate.log_evidence,
            carried=carried,
            learnt={**estimate.learnt, **self._probabilities(log_gauge, log_none)},
            notices=(*estimate.notices, *notices),
        )

    def _start(self) -> dict[str, NDArray[np.float64]]:
        sensors = self._sensor_model.sensor_count
        rivals = sensors + 1
        draws = len(self._value[0])
        belief = np.broadcast_to(self.model.prior / draws, (rivals + 1, draws, len(self.model.prior)))
        return {
            "belief": belief.copy(),
            "statistics": np.zeros((rivals + 1, sensors, 6)),
            "count": np.zeros((rivals + 1, sensors)),
            "always": np.zeros(rivals),
            "begun": np.full(rivals, -np.inf),
            "turns": np.zeros(1),
            "alarmed": np.zeros(2),
            "absurd": np.zeros(sensors, dtype=bool),
        }

    def _advanced(self, before: Carried) -> dict[str, NDArray[np.float64]]:
        arrays = {
            name.removeprefix(_PREFIX): value.copy()
            for name, value in before.arrays.items()
            if name.startswith(_PREFIX)
        }
        arrays["belief"] = arrays["belief"] @ self.model.transition.matrix[before.control_index]
        return arrays

    def _assimilate(self, arrays: dict[str, Float], seen: Float, control_index: int) -> None:
        settings, sensors = self._settings, self._sensor_model.sensor_count
        log_evidence = np.zeros(sensors + 2)
        watch_turn(
            seen, self._value[control_index], self._inverse[control_index], np.full(sensors, settings.gain),
            settings.all_gain, settings.noise_degrees, float(np.exp(-1.0 / settings.memory_turns)),
            arrays["belief"], arrays["statistics"], arrays["count"], log_evidence,
        )  # fmt: skip
        ratio = np.nan_to_num(log_evidence[1:] - log_evidence[0], nan=0.0)
        # The mixture over the first turn of a fault: those that have begun, and one that begins now.
        quiet = arrays["turns"][0] * np.log1p(-settings.onset)
        arrays["begun"] = np.logaddexp(arrays["begun"], np.log(settings.onset) + quiet) + ratio
        arrays["always"] = arrays["always"] + ratio
        arrays["turns"] = arrays["turns"] + 1.0

    def _log_evidence(self, arrays: dict[str, Float]) -> tuple[Float, float]:
        """Return the log e-values of each gauge, with its weight (G,), and of "none of these"."""
        quiet = arrays["turns"][0] * np.log1p(-self._settings.onset)
        late = np.log(1.0 - _FROM_THE_START) + np.logaddexp(arrays["begun"], quiet)
        both = np.logaddexp(np.log(_FROM_THE_START) + arrays["always"], late)
        return both[:-1] + self._log_weight, float(both[-1])

    def _probabilities(self, log_gauge: Float, log_none: float) -> dict[str, Learnt]:
        """Return the posterior probabilities of the two rivals."""
        prior = self._settings.prior
        log_share = np.array([0.0, np.logaddexp.reduce(log_gauge), log_none])
        log_share += np.log([1.0 - 2.0 * prior, prior, prior])
        share = np.exp(log_share - np.logaddexp.reduce(log_share))
        return {
            name: Learnt(p, float(np.sqrt(p * (1.0 - p))), p, p)
            for name, p in zip(("gauge_off", "none_of_these"), share[1:].tolist(), strict=True)
        }

    def _left_out(
        self, before: Float, absurd: Float, seen: Float, control_index: int, turn: int
    ) -> list[Notice]:
        """Return a notice for each gauge whose readings begin or cease to be absurd."""
        notices = []
        for g in np.flatnonzero(absurd & ~before.astype(bool)).tolist():
            low, high = self._low[control_index, g], self._high[control_index, g]
            notices.append(
                Notice(
                    "gauge_left_out",
                    f"Turn {turn}: gauge {g + 1} shows {seen[g]:.4g}, and no state can show less than "
                    f"{low:.4g} or more than {high:.4g}; it is left out until it comes back.",
                    (g + 1,),
                    float(seen[g]),
                )
            )
        for g in np.flatnonzero(before.astype(bool) & ~absurd & ~np.isnan(seen)).tolist():
            notices.append(
                Notice("gauge_back", f"Turn {turn}: gauge {g + 1} is back, and used again.", (g + 1,))
            )
        return notices

    def _alarms(self, arrays: dict[str, Float], log_gauge: Float, log_none: float, turn: int) -> list[Notice]:
        """Return the alarms that are raised in this turn, each once."""
        notices, threshold = [], np.log(self._settings.threshold)
        log_any = float(np.logaddexp.reduce(log_gauge))
        if log_any >= threshold and not arrays["alarmed"][0]:
            arrays["alarmed"][0] = 1.0
            share = np.exp(log_gauge - log_any)
            named = [g for g in np.argsort(-share).tolist() if share[g] >= _NAMED_SHARE][:_MOST_NAMED]
            notices.append(self._alarm(turn, "does not show what the model says", named or [0], log_any))
        if log_none >= threshold and not arrays["alarmed"][1]:
            arrays["alarmed"][1] = 1.0
            sums = arrays["statistics"][-1]
            deviations = np.abs(sums[:, 4]) / np.sqrt(1.0 + sums[:, 2])
            named = [g for g in np.argsort(-deviations).tolist() if deviations[g] >= _NAMED_DEVIATIONS]
            notices.append(
                self._alarm(
                    turn,
                    "stands out where no state of the model explains all gauges together",
                    named[:_MOST_NAMED] or [int(np.argmax(deviations))],
                    log_none,
                )
            )
        return notices

    def _alarm(self, turn: int, what: str, gauges: list[int], log_value: float) -> Notice:
        numbers = tuple(g + 1 for g in gauges)
        one = len(numbers) == 1
        names = f"gauge {numbers[0]}" if one else f"gauges {', '.join(map(str, numbers))}"
        verb = what if one else what.replace("does not", "do not").replace("stands", "stand")
        odds = float(np.exp(min(log_value, 700.0)))
        return Notice(
            "alarm",
            f"Turn {turn}: {names} {verb} (evidence {odds:.3g}, alarm from "
            f"{self._settings.threshold:g}); to find the cause: {COMMAND}",
            numbers,
            odds,
        )
