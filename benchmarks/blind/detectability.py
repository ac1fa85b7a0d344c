"""How far a hidden effect stands out of the noise when everything else is fitted again.

d^2 is the least sum of squared differences, over noise, between the signals with the effect and
those of the nominal structure whose calibrated parameters, gains, zeros and release amplitudes may
move as their priors let them: twice the log likelihood ratio that the data could at best show.
Levenberg-Marquardt, with new derivatives where the old ones no longer help.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.blind.changes import Changes
from benchmarks.blind.instruments import Chance, Rig, Signals, true_signals
from benchmarks.blind.plan import CampaignPlan

FloatArray = NDArray[np.float64]
# In prior deviations:
DIFFERENCE = 0.02
ITERATIONS = 12
QUICK, SETTLED = 0.5, 0.02  # relative gains: above, derivatives are kept; below, the fit is done
NEGLIGIBLE = 1e-9
STARTS = (-3.0, -2.25, -1.5, -0.75, -0.35, 0.35, 0.75, 1.5, 2.25, 3.0)
LONGEST = 1.5  # step of a parameter


@dataclass(frozen=True)
class Reference:
    """The nominal signals of a case, and how they change.

    Attributes
    ----------
    nominal : Signals
        Without an effect.
    matrix : (n, k)
        Whitened, zeros projected out: parameters, gains, release amplitudes, each per prior
        deviation.
    normal : (k, k)
        Its normal matrix with the prior.
    """

    rig: Rig
    plan: CampaignPlan
    chance: Chance
    nominal: Signals
    matrix: FloatArray
    normal: FloatArray

    def distance(self, signals: Signals) -> float:
        """Return d^2 of signals: the least cost that Levenberg-Marquardt finds.

        It begins at the truth or where another value of the first parameter, which scales the
        stiffness, fits better: out of phase, a record says nothing about its frequency.
        """
        matrix = self.matrix
        normal = self.normal
        fresh = True
        damping = 0.0
        moved = np.zeros(self.matrix.shape[1])
        residual = self._residual(signals, moved)
        cost = float(residual @ residual)
        for first in STARTS if cost > 100.0 else ():
            start = np.zeros(len(moved))
            start[0] = first
            after = self._residual(signals, start)
            reached = float(after @ after + first**2)
            if reached < cost:
                moved = start
                residual = after
                cost = reached
                fresh = False
        if not fresh:
            matrix = self._derivatives(moved)
            fresh = True
            normal = matrix.T @ matrix + np.eye(len(moved))
        for _ in range(ITERATIONS):
            if cost < NEGLIGIBLE:
                break
            step = np.linalg.solve(
                normal + damping * np.diag(np.diag(normal)), matrix.T @ residual - moved
            )
            longest = float(np.abs(step[: len(self.plan.priors)]).max())
            start = moved + step * min(1.0, LONGEST / longest)
            after = self._residual(signals, start)
            reached = float(after @ after + start @ start)
            if reached < cost:
                gain = 1.0 - reached / cost
                moved = start
                residual = after
                cost = reached
                damping = 0.1 * damping
                if gain < SETTLED and fresh:
                    break
                fresh = False
                if gain > QUICK:
                    continue
            elif fresh:
                damping = max(10.0 * damping, 0.1)
                continue
            matrix = self._derivatives(moved)
            fresh = True
            normal = matrix.T @ matrix + np.eye(len(moved))
        return cost

    def _residual(self, signals: Signals, moved: FloatArray) -> FloatArray:
        plan = self.plan
        parameters = self._moved(moved, len(plan.priors))
        gains = dict(zip(plan.channels, moved[len(plan.priors) :], strict=False))
        difference = {
            t.name: signals[t.name]
            - parameters[t.name] * [1.0 + plan.channels[c].gain * gains[c] for c in t.channels]
            for t in plan.trials
        }
        return whitened(plan, difference)

    def _derivatives(self, moved: FloatArray) -> FloatArray:
        return _derivatives(
            self.rig, self.plan, self._chance(moved), self._moved(moved, len(self.plan.priors))
        )

    def _moved(self, moved: FloatArray, parameters: int) -> Signals:
        if not moved.any():
            return self.nominal
        return true_signals(self.rig, self.plan, self._chance(moved), Changes())

    def _chance(self, moved: FloatArray) -> Chance:
        plan = self.plan
        values = {
            name: self.chance.parameters[name] + deviation * moved[k]
            for k, (name, (_, deviation)) in enumerate(plan.priors.items())
        }
        rings = [t for t in plan.trials if t.kind == "ringdown"]
        first = len(plan.priors) + len(plan.channels)
        amplitude = {
            t.name: self.chance.amplitude[t.name]
            * (1.0 + plan.release_deviation * moved[first + k])
            for k, t in enumerate(rings)
        }
        return replace(self.chance, parameters=values, amplitude=amplitude)


def whitened(plan: CampaignPlan, difference: Mapping[str, FloatArray]) -> FloatArray:
    """Return differences over noise (n,) of all trials, orthogonal to the zeros of channels."""
    parts = []
    for trial in plan.trials:
        channels = [plan.channels[name] for name in trial.channels]
        noise = np.array([c.noise for c in channels])
        zero = np.array([c.offset for c in channels])
        values = difference[trial.name] / noise
        # The symmetric root of (1 + (zero / noise)^2 11')^-1.
        along = len(values) * (zero / noise) ** 2
        share = 1.0 - 1.0 / np.sqrt(1.0 + along)
        parts.append((values - share * values.mean(axis=0)).ravel())
    return np.concatenate(parts)


def reference(rig: Rig, plan: CampaignPlan, chance: Chance) -> Reference:
    """Return the nominal signals of a case and their derivatives."""
    nominal = true_signals(rig, plan, chance, Changes())
    matrix = _derivatives(rig, plan, chance, nominal)
    return Reference(
        rig, plan, chance, nominal, matrix, matrix.T @ matrix + np.eye(matrix.shape[1])
    )


def _derivatives(rig: Rig, plan: CampaignPlan, chance: Chance, nominal: Signals) -> FloatArray:
    """Return derivatives (n, k) by parameters, gains and amplitudes, per prior deviation."""
    columns = []
    for name, (_, deviation) in plan.priors.items():
        step = DIFFERENCE * deviation
        moved = replace(
            chance, parameters={**chance.parameters, name: chance.parameters[name] + step}
        )
        other = true_signals(rig, plan, moved, Changes())
        columns.append(
            whitened(
                plan, {t.name: (other[t.name] - nominal[t.name]) / DIFFERENCE for t in plan.trials}
            )
        )
    for channel in plan.channels.values():
        part = {
            t.name: nominal[t.name] * (np.array(t.channels) == channel.name) * channel.gain
            for t in plan.trials
        }
        columns.append(whitened(plan, part))
    for ring in plan.trials:
        if ring.kind == "ringdown":
            part = {
                t.name: nominal[t.name] * (plan.release_deviation if t is ring else 0.0)
                for t in plan.trials
            }
            columns.append(whitened(plan, part))
    return np.array(columns).T
