"""Notices of operation: a gauge that is off, states that explain no gauges, readings that are absurd.

Beside the model as it is (every gauge shows what the state, a draw of the parameter and noise of unknown
scale say) run rivals with filters of their own, so that state and parameter are marginalised under each: that
a gauge shows a stated share too much or too little, and that several gauges have gains of their own, which no
state of the model explains. Each may begin in any step; the mixture over the first step is exact, because
until then the rival's belief is the model's. The ratio of the evidence of a rival to that of the model is an
e-process: its mean under the predictions of the model is one at every step, so that it ever exceeds a
threshold c with a probability of at most 1 / c, however often one looks (Ville 1939; Ramdas, Grünwald, Vovk
and Shafer 2023).
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from hashlib import sha256
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reporting.arrays import Float
from twin_master.errors import InvalidModelError, said
from twin_master.learning import rivals
from twin_master.learning.rivals import Shares
from twin_master.network.estimator import Carried, Estimate, Estimator, Hypothesis, Notice, Suspicion, Words
from twin_master.network.inference import smooth
from twin_master.network.sensor_model import GaussianSensorModel
from twin_master.scenario.tables import MOST_DRAWS, Noticing

Arrays = dict[str, NDArray[Any]]

_PREFIX = "notice/"
_FROM_THE_START = 0.5
"""Prior share of faults that are there from the first step; the others begin at a later one."""
_FREE = 0.5
"""Prior probability that a gauge has a gain of its own, where no state explains all of them."""
_GAINS = (-2.5, -1.0, 1.0, 2.5)
"""Gain errors of a gauge that is off, in those that are to be found; larger ones are found by the largest."""
_REACH = (1.0, 0.5, 0.5, 1.0)
"""How far about each of these the gain is learnt: half of a gain that is to be found is none."""
_LARGEST = 20_000_000
"""Numbers that the beliefs of the rivals may take: each step that is kept holds them."""
_CLEARLY = float(np.log(10.0))
"""A single gauge is the simpler explanation: several must be so much better for the alarm to say so."""
_OR_THE_ASSET = "or the asset near it is not as the model says, as where it has softened"
"""Said beside a gauge that is off: softening that the model does not know is mostly seen by one gauge."""
_NAMED_SHARE = 0.1
_NAMED_DEVIATIONS = 2.0
_MOST_NAMED = 6


class WatchfulEstimator:
    """An estimator with notices beside it; absurd readings are left out.

    Its belief is that of the mixture: of the estimator, of each gauge being off, and of what was off and is
    mended (see `rivals`). It carries beside the arrays of the estimator, under the prefix `notice/`, beliefs
    of the model and the rivals over draws and states, their log e-values, shares and sums of squares.

    Parameters
    ----------
    inner : Estimator
        What holds the belief.
    sensor_model : GaussianSensorModel
        Predictions (E, S, U, G) and assumed noise.
    draws : (E,)
        Values of the parameter.
    settings : Noticing, optional
    words : Words, optional

    Raises
    ------
    InvalidModelError
        The average over the draws stands inside the product over the sensors, or there are too many states.
    """

    def __init__(
        self,
        inner: Estimator,
        sensor_model: GaussianSensorModel,
        draws: Float,
        settings: Noticing | None = None,
        words: Words | None = None,
    ) -> None:
        if sensor_model.averages_inside:
            raise InvalidModelError(said("learning.inside", what="noticing"))
        self._inner, self._sensor_model, self.model = inner, sensor_model, inner.model
        self._settings = settings = settings or Noticing()
        self._words = words or Words()
        places, self._draw_weight = _spread(np.asarray(draws, np.float64), sensor_model.draw_weight)
        table, deviation = sensor_model.value_per_draw[places], sensor_model.total_standard_deviation
        sensors, states = sensor_model.sensor_count, inner.model.states.size
        self._shape = (sensors, len(_GAINS), len(places), states)
        if np.prod(self._shape, dtype=float) > _LARGEST:
            parts = states, len(places), sensors * len(_GAINS), _LARGEST
            raise InvalidModelError(said("learning.faults", parts=parts))
        # A model that takes the place of another, as one that was taught, begins without suspicion.
        digest = sha256(b"3" + np.ascontiguousarray(table).tobytes()).digest()
        self._key = np.frombuffer(digest[:8], dtype=np.uint64)
        controls = range(sensor_model.control_count)
        self._value = [np.ascontiguousarray(table[:, :, u]) for u in controls]
        independent = sensor_model.independent_standard_deviation
        self._inverse = [1.0 / independent[:, u] for u in controls]
        reach = settings.absurd_deviations * deviation
        self._low = (sensor_model.value_per_draw.min(axis=0) - reach).min(axis=0)  # (U, G)
        self._high = (sensor_model.value_per_draw.max(axis=0) + reach).max(axis=0)
        self._gains, self._reach = settings.gauge_gain * np.array([_GAINS, _REACH])
        # The prior of a gauge grows with the steps that it takes to be found, or weak ones would be lost.
        per_step = np.mean((settings.gauge_gain * sensor_model.mean / deviation) ** 2, axis=(0, 1))
        steps = 1.0 + 1.0 / np.maximum(per_step, 1e-3)
        self._log_prior: Float = np.log(steps / steps.sum())
        of_gauges = np.repeat(self._log_prior - np.log(len(_GAINS)), len(_GAINS))
        self._begins: Float = np.log(0.5) + np.concatenate([[-np.inf, -np.inf, 0.0], of_gauges])
        self._names = tuple(f"{self._words.sensors([g])} off" for g in range(sensors))

    def smoothed(self, carried: Sequence[Carried]) -> Float:
        """Return p(D_k | o_0..o_t) for the steps of `carried`, which end at t: (n, S).

        Under the model it is the estimator's; otherwise the beliefs of the mixture are smoothed, from that of
        the last step under all but the model.
        """
        own = self._inner.smoothed(carried)
        if not carried:
            return own
        with np.errstate(divide="ignore"):
            rows = np.log([step.arrays[_PREFIX + "belief"] for step in carried])
            rows[-1] = np.log(carried[-1].arrays[_PREFIX + "rivals"])
        others = smooth(self.model, [step.control_index for step in carried], rows)
        right = float(carried[-1].arrays[_PREFIX + "right"][0])
        return np.asarray(right * own + (1.0 - right) * others)

    def step(self, before: Carried | None, observation: Float, control_index: int, step: int) -> Estimate:
        """Advance the belief to step t and correct it by an observation, see `Estimator.step`."""
        seen, told = self._sensor_model.apart(observation)
        absurd = (seen < self._low[control_index]) | (seen > self._high[control_index])
        used = np.where(absurd, np.nan, seen)
        given = np.append(used, observation[len(used) :])
        estimate = self._inner.step(before, given, control_index, step)
        followed = before is not None and before.arrays.get(_PREFIX + "model_key") == self._key
        if before is not None and followed:
            own, shares = self._advanced(before, control_index)
        else:
            own, shares = self._start(estimate.forecast), self._first_shares(control_index)
        self._assimilate(own, shares, used, told, control_index)
        notices = self._left_out(own["left_out"] > 0.0, absurd, seen, control_index, step)
        # A gauge that is left out stays so while it is silent.
        own["left_out"] = (absurd | ((own["left_out"] > 0.0) & np.isnan(seen))).astype(np.float64)
        suspicion = self._suspicion(own, shares)
        notices += self._alarms(own, suspicion, step)
        believed = shares, estimate.filtered, own["mended"], own["gauge"]
        found = rivals.hypotheses(*believed, self._names)
        notices += self._leading(own, found, step)
        own["belief"], own["rivals"], right = rivals.beliefs_of(*believed)
        own["right"] = np.array([right])
        own |= {"share": shares.current, "hidden": shares.hidden, "shows": shares.shows}
        return replace(
            estimate,
            filtered=own["belief"],
            carried=Carried(control_index, {**estimate.carried.arrays, **self._packed(own)}),
            notices=(*estimate.notices, *notices),
            suspicion=replace(suspicion, hypotheses={one.name: one.probability for one in found}),
            hypotheses=found,
        )

    def _leading(self, own: Arrays, found: Sequence[Hypothesis], step: int) -> list[Notice]:
        """Return the notice that belief and decision follow another hypothesis than before, if it is so."""
        first = max(found, key=lambda one: one.probability)
        number = 0 if first is found[0] else -1 if first.belief is None else self._names.index(first.name) + 1
        if first.probability <= 0.5 or number == own["leading"][0]:
            return []
        own["leading"][0] = number
        told = {
            "words": self._words,
            "step_word": self._words.step.capitalize(),
            "step": step,
            "first": first,
        }
        sentence = said("learning.follows" if number else "learning.explained", **told)
        if number > 0:
            sentence = f"{sentence} {_OR_THE_ASSET[0].upper()}{_OR_THE_ASSET[1:]}: these data cannot tell."
        if number < 0:
            sentence = said("learning.unexplained", **told)
        return [Notice("hypothesis", sentence, (number,) if number > 0 else (), first.probability)]

    def _start(self, forecast: Float) -> Arrays:
        """Return what is carried, before the first observation of this model."""
        sensors, gains = self._shape[:2]
        model = self._draw_weight[:, None] * forecast
        weight = np.log(_FROM_THE_START)
        return {
            "model": model,
            "gauge": np.broadcast_to(model, self._shape).astype(np.float32, order="C"),
            "none": model[None].astype(np.float32),
            "mended": model.copy(),
            "leading": np.zeros(1),
            "log_gauge": np.full((sensors, gains), weight - np.log(gains)),
            "log_none": np.full(1, weight),
            "gauge_onset": np.zeros((sensors, gains)),
            "none_onset": np.zeros(1),
            "model_squares": np.zeros(sensors),
            "mended_squares": np.zeros(sensors),
            "gauge_squares": np.zeros((sensors, gains)),
            "gauge_sums": np.zeros((sensors, gains, 2)),
            "none_statistics": np.tile([_FREE, 0.0, 0.0, 0.0, 0.0], (sensors, 1)),
            "count": np.zeros(sensors),
            "steps": np.zeros(1),
            "alarmed": np.zeros(2),
            "left_out": np.zeros(sensors),
        }

    def _first_shares(self, control_index: int) -> Shares:
        """Return the shares of the hypotheses before the first observation of this model."""
        begun = 2.0 * self._settings.prior * _FROM_THE_START
        return Shares.at_first(begun, self._begins, control_index, len(self._value))

    def _advanced(self, before: Carried, control_index: int) -> tuple[Arrays, Shares]:
        """Return what was carried, one transition later, with the rivals that begin in this step.

        Parameters
        ----------
        before : Carried
            Of the step before.
        control_index : int
            Control in force in this step.
        """
        own = self._unpacked(before.arrays)
        shares = Shares(own["share"], own["hidden"], own["shows"])
        for name in ("model", "gauge", "none", "mended"):
            rows = own[name].reshape(-1, self._shape[-1])
            held = rows.any(axis=1)
            rows[held] = self.model.transition.forward(before.control_index, rows[held])
        step = float(own["steps"][0])
        inflow = np.log(self._to_begin(step - 1.0) - self._to_begin(step))
        gauges = own["gauge"].reshape(-1, *self._shape[2:])
        weight, onset = own["log_gauge"].reshape(-1), own["gauge_onset"].reshape(-1)
        keep = rivals.mix_onset(own["model"], gauges, weight, inflow - np.log(self._shape[1]), step, onset)
        keep = keep.reshape(self._shape[:2])
        fading = np.exp(-1.0 / self._settings.memory_steps)
        own["gauge_sums"] *= fading * keep[..., None]
        own["gauge_squares"] = keep * own["gauge_squares"] + (1.0 - keep) * own["model_squares"][:, None]
        kept = rivals.mix_onset(own["model"], own["none"], own["log_none"], inflow, step, own["none_onset"])
        statistics, fresh = own["none_statistics"], 1.0 - kept[0]
        statistics[:, 0] += fresh * (_FREE - statistics[:, 0])
        statistics[:, [1, 4]] += fresh * (own["model_squares"][:, None] - statistics[:, [1, 4]])
        statistics[:, 2:4] *= fading * kept[0]
        self._switch(own, shares, inflow, step, (before.control_index, control_index))
        return own, shares

    def _switch(
        self, own: Arrays, shares: Shares, inflow: float, step: float, controls: tuple[int, int]
    ) -> None:
        """Let faults begin, end and be hidden.

        "Mended" takes over beliefs and sums of squares of those that ended or are hidden now.

        Parameters
        ----------
        own : dict of str to array
            What is carried.
        shares : Shares
            Of the step before; brought up to date.
        inflow : float
            Log prior share of the faults that begin in the step.
        step : float
            Steps since the start of this model.
        controls : tuple of int
            Control of the step before, and of this step.
        """
        twice = 2.0 * self._settings.prior
        hazard = np.log(twice) + inflow - np.log1p(twice * (self._to_begin(step - 1.0) - 1.0))
        gone = np.zeros_like(shares.hidden)
        if controls[0] != controls[1]:
            gone += shares.change_control(*controls)
        gone += shares.advance(hazard, self._begins)
        came = gone.sum()
        if came == 0.0:
            return
        fresh = min(came * np.exp(-shares.log_mended_or_hidden), 1.0)
        weight = gone / came
        of_gauge = weight[1:].reshape(self._shape[:2])
        belief = weight[1:].astype(np.float32) @ own["gauge"].reshape(len(weight) - 1, -1)
        coming = belief.reshape(self._shape[2:]) + weight[0] * own["none"][0]
        own["mended"] += fresh * (coming / coming.sum() - own["mended"])
        statistics, squares = own["none_statistics"], own["model_squares"].copy()
        squares += np.sum(of_gauge * (own["gauge_squares"] - squares[:, None]), axis=1)
        free = statistics[:, 0]
        squares += weight[0] * (
            free * statistics[:, 4] + (1.0 - free) * statistics[:, 1] - own["model_squares"]
        )
        own["mended_squares"] += fresh * (squares - own["mended_squares"])

    def _packed(self, own: Arrays) -> Arrays:
        """Return what is carried: of the beliefs about gauges, most of which are zero, those that are not."""
        place = np.flatnonzero(own["gauge"] != 0.0)  # of truth values: ten times as fast as of numbers
        packed = own | {"gauge": own["gauge"].ravel()[place], "gauge_place": place.astype(np.int32)}
        return {_PREFIX + name: value for name, value in packed.items()} | {_PREFIX + "model_key": self._key}

    def _unpacked(self, arrays: Mapping[str, NDArray[Any]]) -> Arrays:
        own = {
            name.removeprefix(_PREFIX): value.copy()
            for name, value in arrays.items()
            if name.startswith(_PREFIX)
        }
        del own["model_key"]
        gauge = np.zeros(self._shape, dtype=np.float32)
        gauge.ravel()[own.pop("gauge_place")] = own["gauge"]
        return own | {"gauge": gauge}

    def _to_begin(self, step: float) -> float:
        """Return the prior share of faults that begin after a step."""
        return (1.0 - _FROM_THE_START) / (1.0 + step / self._settings.onset_steps)

    def _assimilate(self, own: Arrays, shares: Shares, seen: Float, told: Float, control_index: int) -> None:
        """Correct all hypotheses by the sensors, and by what else is told of each state (S,)."""
        degrees, count = self._settings.noise_degrees, own["count"]
        # By the noise that is learnt: else a gauge that is off would pull the place, and with it all others.
        precision = np.minimum((degrees + count) / (degrees + own["model_squares"]), 1.0)
        near = self._sensor_model.nearest(seen, control_index, self._value[control_index], precision)
        inverse, there = np.where(np.isnan(seen), 0.0, self._inverse[control_index]), ~np.isnan(seen)
        size = (near.value * inverse).reshape(-1, len(seen))
        residual = (np.where(there, seen - near.value, 0.0) * inverse).reshape(size.shape)
        shown = rivals.Shown(there, residual, size, 0.5 * (degrees + count + 1.0), degrees)
        prior = near.log_density + told + np.log(inverse[:, there]).sum(axis=1)
        before, mended = own["model_squares"].copy(), own["mended_squares"].copy()
        log_mended, _ = rivals.weigh_model(
            shown, own["mended_squares"], own["mended"].reshape(-1), prior.flatten()
        )
        log_mended += 0.5 * np.sum(np.log((degrees + before) / (degrees + mended)), where=there)
        log_likelihood = prior.flatten()
        log_model, known = rivals.weigh_model(
            shown, own["model_squares"], own["model"].reshape(-1), log_likelihood
        )
        of_model = rivals.OfModel(before, known, log_likelihood)
        gauges = own["gauge"].reshape(-1, len(size))
        with np.errstate(divide="ignore"):  # what is ruled out has the logarithm minus infinity
            log_gauges = rivals.weigh_gauges(
                shown, of_model, self._gains, self._reach, gauges, own["gauge_squares"], own["gauge_sums"]
            )
            log_none = rivals.weigh_none(
                shown, of_model, self._settings.all_gain, own["none"].reshape(-1), own["none_statistics"]
            )
        own["log_gauge"] += log_gauges - log_model
        own["log_none"] += log_none - log_model
        ratio = np.zeros_like(shares.current)
        ratio[rivals.MENDED], ratio[rivals.NONE] = log_mended - log_model, log_none - log_model
        ratio[rivals.GAUGES :] = (log_gauges - log_model).ravel()
        shares.weigh(ratio)
        count += ~np.isnan(seen)
        own["steps"] += 1.0

    def _suspicion(self, own: Arrays, shares: Shares) -> Suspicion:
        to_begin = np.log(self._to_begin(float(own["steps"][0]) - 1.0))
        begun = np.logaddexp.reduce(own["log_gauge"], axis=1)
        log_gauge = np.logaddexp(begun, to_begin)
        none = float(own["log_none"][0])
        return Suspicion(
            none_of_these=shares.none_of_these,
            gauge_off=float(shares.of_gauges.sum()),
            log_evidence_none=float(np.logaddexp(none, to_begin)),
            log_evidence_any_gauge=float(np.logaddexp.reduce(log_gauge + self._log_prior)),
            log_evidence_gauge=log_gauge,
            left_out=own["left_out"] > 0.0,
        )

    def _left_out(
        self, before: NDArray[np.bool_], absurd: NDArray[np.bool_], seen: Float, control_index: int, step: int
    ) -> list[Notice]:
        """Return a notice for each gauge whose readings begin or cease to be absurd."""
        notices, words = [], self._words
        when = f"{words.step.capitalize()} {step}"
        for g in np.flatnonzero(absurd & ~before).tolist():
            low, high = self._low[control_index, g], self._high[control_index, g]
            values = words.value(g, seen[g], low, high)
            sentence = said("learning.left_out", when=when, sensor=words.sensors([g]), values=values)
            notices.append(Notice("gauge_left_out", sentence, (g + 1,), float(seen[g])))
        for g in np.flatnonzero(before & ~absurd & ~np.isnan(seen)).tolist():
            sentence = f"{when}: the readings of {words.sensors([g])} are back, and used again."
            notices.append(Notice("gauge_back", sentence, (g + 1,), float(seen[g])))
        return notices

    def _alarms(self, own: Arrays, suspicion: Suspicion, step: int) -> list[Notice]:
        """Return the alarms that are raised in this step, each once.

        What explains less than the other kind of fault waits: a gauge that is off is also seen by the gains
        of all gauges, and a region that softens by its gauges. Waiting makes false alarms rarer still.
        """
        gauge, none = suspicion.log_evidence_any_gauge, suspicion.log_evidence_none
        threshold, notices = np.log(self._settings.threshold), []
        if gauge >= max(threshold, none - _CLEARLY) and not own["alarmed"][0]:
            own["alarmed"][0] = 1.0
            notices.append(self._gauge_alarm(own, gauge, step))
        if none >= max(threshold, gauge + _CLEARLY) and not own["alarmed"][1]:
            own["alarmed"][1] = 1.0
            sums = own["none_statistics"]
            deviations = np.abs(sums[:, 3]) / np.sqrt(1.0 + sums[:, 2])
            order = np.argsort(-deviations, kind="stable").tolist()
            named = [g for g in order if deviations[g] >= _NAMED_DEVIATIONS][:_MOST_NAMED] or order[:1]
            what = f"no state of the model explains all gauges together, least {self._words.sensors(named)}"
            notices.append(self._alarm(own, step, what, named, none, float(own["none_onset"][0])))
        return notices

    def _gauge_alarm(self, own: Arrays, log_value: float, step: int) -> Notice:
        log_weight = own["log_gauge"] + self._log_prior[:, None]
        share = np.exp(log_weight - np.logaddexp.reduce(log_weight, axis=None))
        order = np.argsort(-share.sum(axis=1), kind="stable").tolist()
        named = [g for g in order if share[g].sum() >= _NAMED_SHARE][:_MOST_NAMED] or order[:1]
        onset = float(np.sum(share * own["gauge_onset"]))
        sign = share @ np.sign(self._gains)
        if len(named) > 1:
            what = f"one of {self._words.sensors(named)} does not show what the model says"
        else:
            what = f"{self._words.sensors(named)} shows too {'much' if sign[named[0]] > 0.0 else 'little'}"
        what = f"{what}, {_OR_THE_ASSET}"
        return self._alarm(own, step, what, named, log_value, onset)

    def _alarm(
        self, own: Arrays, step: int, what: str, gauges: list[int], log_value: float, onset: float
    ) -> Notice:
        """Return an alarm; its onset is counted from the first step of this model, which may be taught."""
        odds, words = float(np.exp(min(log_value, 700.0))), self._words
        first = round(step + 1.0 - float(own["steps"][0]) + onset)
        since = f"since about {words.step} {first}" if first else "from the start"
        search = f"; to find the cause: {words.command}" if words.command else ""
        search += f" --from-step {first}" if search and first else ""
        evidence = f"{odds:,.0f}" if 1e3 <= odds < 1e6 else f"{odds:.3g}"
        sentence = said(
            "learning.alarm", when=f"{words.step.capitalize()} {step}", what=what, since=since,
            evidence=evidence, threshold=self._settings.threshold, search=search,
        )  # fmt: skip
        return Notice("alarm", sentence, tuple(g + 1 for g in gauges), odds, first)


def _spread(draws: Float, weight: Float) -> tuple[NDArray[np.int64], Float]:
    """Return some draws that lie evenly over the range of all, and the probability nearest to each.

    Evenly, because a true value between two of them must not look like a fault, in the tails least of all.
    """
    order = np.argsort(draws, kind="stable")
    grid = np.linspace(draws[order[0]], draws[order[-1]], MOST_DRAWS)
    chosen = np.unique([order[np.argmin(np.abs(draws[order] - value))] for value in grid])
    nearest = np.argmin(np.abs(draws[:, None] - draws[chosen]), axis=1)
    total = np.bincount(nearest, weight, minlength=len(chosen))
    return chosen, np.asarray(total / total.sum(), dtype=np.float64)
