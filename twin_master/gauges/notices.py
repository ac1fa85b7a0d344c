"""The notices of the watch over the gauges, as sentences for an operator."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from reporting.arrays import Float, Index
from reporting.words import listing
from twin_master.gauges.discriminating_control import DiscriminatingControls
from twin_master.gauges.watch_state import WatchState
from twin_master.network.estimator import Notice, NoticeWording
from twin_master.network.sensor_model import GaussianSensorModel

CLEARLY_BETTER = float(np.log(10.0))
"""Smallest log evidence of free gains over a single gauge, which is the simpler explanation."""
_OR_THE_ASSET = "or the asset near it differs from the model, for example because it has softened"
"""The other cause of a faulty gauge: one gauge sees most of a softening that the model lacks."""
_LEAST_NAMED_PROBABILITY = 0.1
"""An alarm names the gauges that are the faulty one with at least this probability."""
_LEAST_NAMED_DEVIATIONS = 2.0
"""An alarm names the gauges whose gain is at least so many prior standard deviations from zero."""
_MOST_NAMED = 6
"""The largest number of gauges that an alarm names."""
_LEAST_ADVISED_PROBABILITY = 0.1
"""A control is advised if it discriminates with at least this probability."""
_LARGEST_LOG = 700.0
"""Logarithms up to this have an exponential that is a finite number."""


@dataclass(frozen=True)
class NoticeWriter:
    """The writer of the notices of a step.

    Attributes
    ----------
    threshold : float
        The evidence from which an alarm is raised.
    gains : (K,) array
        The gain errors of single gauges that are compared.
    log_gauge_prior : (G,) array
        The log prior probability of each gauge to be the one that is off.
    lowest_plausible, highest_plausible : (U, G) array
        Readings beyond these are absurd under a control, SI.
    noise : (G,) array
        The standard deviation of the assumed noise, SI.
    hypothesis_names : tuple of str
        The name of the hypothesis that a gauge is off, for each gauge.
    """

    wording: NoticeWording
    threshold: float
    gains: Float
    log_gauge_prior: Float
    lowest_plausible: Float
    highest_plausible: Float
    noise: Float
    hypothesis_names: tuple[str, ...]

    def is_absurd(self, readings: Float, control_index: Index) -> NDArray[np.bool_]:
        """Return for readings (B, G) under controls (B,) whether no state can show them.

        A missing reading (NaN) is not absurd.
        """
        is_too_low = readings < self.lowest_plausible[control_index]
        is_too_high = readings > self.highest_plausible[control_index]
        return np.asarray(is_too_low | is_too_high)

    def report_absurd_readings(
        self, begins: NDArray[np.bool_], readings: Float, control_index: int, step: int
    ) -> list[Notice]:
        """Return a notice for each gauge whose readings begin to be absurd.

        Parameters
        ----------
        begins : (G,) array of bool
            Whether the reading of the gauge is absurd now, and was used before.
        readings : (G,) array
            The readings, SI; NaN where nothing was received.
        control_index : int
            The control in force.
        """
        notices = []
        for g in np.flatnonzero(begins).tolist():
            reading, low, high = self.wording.format_values(
                g,
                readings[g],
                self.lowest_plausible[control_index, g],
                self.highest_plausible[control_index, g],
            )
            sentence = (
                f"{self.wording.name_step(step)}: {self.wording.name_sensors([g])} shows "
                f"{reading}, and no state can show less than {low} or more than {high}; its "
                "readings are left out until they come back."
            )
            notices.append(Notice("gauge_left_out", sentence, (g + 1,), float(readings[g])))
        return notices

    def report_stuck_gauges(
        self, begins: NDArray[np.bool_], readings: Float, still_since: Float, step: int
    ) -> list[Notice]:
        """Return a notice for each gauge that is found to be stuck.

        Parameters
        ----------
        begins : (G,) array of bool
            Whether the gauge is found to be stuck in this step.
        readings : (G,) array
            The readings, SI.
        still_since : (G,) array
            The first step in which the gauge repeated its reading.
        """
        notices = []
        for g in np.flatnonzero(begins).tolist():
            since = round(float(still_since[g]))
            reading, noise = self.wording.format_values(g, readings[g], self.noise[g])
            sentence = (
                f"{self.wording.name_step(step)}: {self.wording.name_sensors([g])} is stuck: since "
                f"{self.wording.step} {since} it shows {reading} unchanged, in spite of noise of "
                f"{noise}; its readings are left out until they move."
            )
            notices.append(Notice("gauge_left_out", sentence, (g + 1,), float(readings[g]), since))
        return notices

    def report_gauges_back(
        self, is_back: NDArray[np.bool_], readings: Float, step: int
    ) -> list[Notice]:
        """Return a notice for each gauge (G,) whose readings are used again."""
        return [
            self.wording.notice_of_return(step, g, float(readings[g]))
            for g in np.flatnonzero(is_back).tolist()
        ]

    def report_own_likelihood(self, sensor_model: GaussianSensorModel) -> list[Notice]:
        """Return the notice that alarms do not use the likelihood of a user's sensor model.

        Alarms compare faults of gauges under Gaussian noise. The list is empty if the likelihood of
        the sensor model is Gaussian, too.
        """
        if not sensor_model.has_own_likelihood:
            return []
        sentence = (
            f"Notices and alarms take the noise of the {self.wording.sensor}s as Gaussian, with "
            "the predictions and standard deviations of the sensor model "
            f"{type(sensor_model).__qualname__}; the likelihood of that sensor model decides on "
            "the belief alone. Say `notice = false` in the scenario if Gaussian noise does not fit."
        )
        return [Notice("gaussian", sentence)]

    def report_followed_hypothesis(
        self, followed_hypothesis: int, probability: float, step: int
    ) -> list[Notice]:
        """Return the notice that belief and decision follow another hypothesis from now on.

        Parameters
        ----------
        followed_hypothesis : int
            The hypothesis: 0 is the model, -1 free gains, and g > 0 is gauge g, counted from 1.
        """
        sensors = f"{self.wording.sensor}s"
        in_brackets = f"(probability {probability:.3g})"
        if followed_hypothesis == 0:
            sentence = f"the model explains the {sensors} again {in_brackets}."
        elif followed_hypothesis < 0:
            sentence = (
                f"no state explains the {sensors}: no state is believed, and the twin proposes the "
                f"safest control {in_brackets}."
            )
        else:
            or_the_asset = f"{_OR_THE_ASSET[0].upper()}{_OR_THE_ASSET[1:]}"
            sentence = (
                f"{self.hypothesis_names[followed_hypothesis - 1]}: belief and decision follow the "
                f"other {sensors} {in_brackets}. {or_the_asset}: these data cannot tell."
            )
        numbers = (followed_hypothesis,) if followed_hypothesis > 0 else ()
        sentence = f"{self.wording.name_step(step)}: {sentence}"
        return [Notice("hypothesis", sentence, numbers, probability)]

    def advise_control(
        self, comparison: DiscriminatingControls, controls: tuple[str, ...], step: int
    ) -> Notice:
        """Return the advice which control best tells the hypotheses of an alarm apart."""
        hypotheses = [
            f"{'the model' if name == 'model' else name} ({probability:.2g})"
            for name, probability in zip(comparison.names, comparison.probabilities, strict=True)
        ]
        by_control = dict(zip(controls, comparison.by_control.tolist(), strict=True))
        best, *others = sorted(by_control, key=by_control.__getitem__, reverse=True)
        is_one_step = comparison.steps == 1
        steps = self.wording.step if is_one_step else f"{comparison.steps} {self.wording.step}s"
        if by_control[best] < _LEAST_ADVISED_PROBABILITY:
            sentence = (
                f"no control tells {listing(hypotheses)} apart within {steps}: inspect the "
                f"{self.wording.sensor}s, or measure with another sensor."
            )
            return Notice("advice", f"{self.wording.name_step(step)}: {sentence}")
        steps_tell = (
            f"a {steps} under {best} tells" if is_one_step else f"{steps} under {best} tell"
        )
        next_best = f", and {by_control[others[0]]:.2f} under {others[0]}" if others else ""
        sentence = (
            f"{steps_tell} {listing(hypotheses)} apart best, if it is safe: with a probability of "
            f"{by_control[best]:.2f}{next_best}."
        )
        return Notice(
            "advice", f"{self.wording.name_step(step)}: {sentence}", value=by_control[best]
        )

    def may_raise_alarm(
        self, state: WatchState, log_gauge: Float, log_free_gains: Float
    ) -> NDArray[np.bool_]:
        """Return for B twins whether an alarm that was not raised yet has reached its threshold.

        Parameters
        ----------
        log_gauge, log_free_gains : (B,) array
            The log evidence of the two kinds of fault.
        """
        log_threshold = np.log(self.threshold)
        may_name_gauge = (log_gauge >= log_threshold) & ~state.gauge_alarm_raised
        may_doubt_states = (log_free_gains >= log_threshold) & ~state.free_gains_alarm_raised
        return np.asarray(may_name_gauge | may_doubt_states)

    def raise_alarms(
        self, state: WatchState, twin: int, log_gauge: float, log_free_gains: float, step: int
    ) -> list[Notice]:
        """Return the alarms that a twin raises in this step, and mark them as raised in `state`.

        Two kinds of faults raise an alarm, each once: a fault of a single gauge, and free gains of
        several gauges. A faulty gauge also increases the evidence for free gains, and a region that
        softens also that for faults of its gauges. Therefore only the kind with more evidence
        raises an alarm, and free gains only if they explain the readings clearly better than a
        fault of a single gauge, which is simpler.
        """
        log_threshold = np.log(self.threshold)
        notices = []
        is_gauge_alarm = log_gauge >= max(log_threshold, log_free_gains - CLEARLY_BETTER)
        if is_gauge_alarm and not state.gauge_alarm_raised[twin]:
            state.gauge_alarm_raised[twin] = True
            notices.append(self._gauge_alarm(state, twin, log_gauge, step))
        is_free_gains_alarm = log_free_gains >= max(log_threshold, log_gauge + CLEARLY_BETTER)
        if is_free_gains_alarm and not state.free_gains_alarm_raised[twin]:
            state.free_gains_alarm_raised[twin] = True
            notices.append(self._free_gains_alarm(state, twin, log_free_gains, step))
        return notices

    def _gauge_alarm(self, state: WatchState, twin: int, log_evidence: float, step: int) -> Notice:
        """Return the alarm that a single gauge is faulty; it names the probable ones."""
        by_gauge = (len(self.log_gauge_prior), -1)
        log_weight = (
            state.log_gauge_evidence[twin].reshape(by_gauge) + self.log_gauge_prior[:, None]
        )
        weight = np.exp(log_weight - np.logaddexp.reduce(log_weight, axis=None))  # (G, K)
        probability = weight.sum(axis=1)
        named_gauges = _largest(probability, _LEAST_NAMED_PROBABILITY)
        onset = float(np.sum(weight * state.gauge_onset[twin].reshape(by_gauge)))
        if len(named_gauges) > 1:
            sensors = self.wording.name_sensors(named_gauges)
            finding = f"one of {sensors} does not show what the model predicts"
        else:
            expected_sign = weight @ np.sign(self.gains)
            amount = "much" if expected_sign[named_gauges[0]] > 0.0 else "little"
            finding = f"{self.wording.name_sensors(named_gauges)} shows too {amount}"
        finding = f"{finding}, {_OR_THE_ASSET}"
        # The step counts from the first one of this model, which may have replaced another.
        onset += step + 1.0 - float(state.step_count[twin])
        return self._alarm(step, finding, named_gauges, log_evidence, onset)

    def _free_gains_alarm(
        self, state: WatchState, twin: int, log_evidence: float, step: int
    ) -> Notice:
        """Return the alarm that no state explains all gauges, naming those of largest gain."""
        statistics = state.free_gain_statistics
        gain_deviations = np.abs(statistics.sum_cx[twin]) / np.sqrt(1.0 + statistics.sum_cc[twin])
        named_gauges = _largest(gain_deviations, _LEAST_NAMED_DEVIATIONS)
        finding = (
            "no state of the model explains all gauges together, least "
            f"{self.wording.name_sensors(named_gauges)}"
        )
        onset = float(state.free_gains_onset[twin])
        # The step counts from the first one of this model, which may have replaced another.
        onset += step + 1.0 - float(state.step_count[twin])
        return self._alarm(step, finding, named_gauges, log_evidence, onset)

    def _alarm(
        self,
        step: int,
        finding: str,
        gauges: list[int],
        log_evidence: float,
        onset: float,
    ) -> Notice:
        """Return the alarm with a finding, the time of its begin, its evidence, and what to do.

        Parameters
        ----------
        finding : str
            What was found, as a clause.
        gauges : list of int
            The gauges that the alarm names, from 0.
        log_evidence : float
            The log probability of all observations under the fault over that under the model.
        onset : float
            The estimated step in which the fault began.
        """
        evidence = float(np.exp(min(log_evidence, _LARGEST_LOG)))
        first_step = round(onset)
        since = f"since about {self.wording.step} {first_step}" if first_step else "from the start"
        evidence_text = f"{evidence:,.0f}" if 1e3 <= evidence < 1e6 else f"{evidence:.3g}"
        search = ""
        if self.wording.command:
            search = f"; to find the cause: {self.wording.command}"
            if first_step:
                search += f" --from-step {first_step}"
        sentence = (
            f"{self.wording.name_step(step)}: {finding}, {since} (evidence {evidence_text} against "
            f"the model, alarm from {self.threshold:g}){search}"
        )
        return Notice("alarm", sentence, tuple(g + 1 for g in gauges), evidence, first_step)


def _largest(values: Float, least: float) -> list[int]:
    """Return the indices of the values (G,) of at least `least`, the largest first.

    There are at most `_MOST_NAMED`; if no value is large enough, the largest one is returned.
    """
    order = np.argsort(-values, kind="stable").tolist()
    large_enough = [g for g in order if values[g] >= least]
    return large_enough[:_MOST_NAMED] or order[:1]
