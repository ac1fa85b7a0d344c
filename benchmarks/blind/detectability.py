"""How far a hidden effect stands out of the noise when everything else is fitted again.

d^2 is the least sum of squared differences, over noise, between the signals with the effect and those of
the nominal structure whose calibrated parameters, gains, zeros and release amplitudes may move as their
priors let them: twice the log likelihood ratio that the data could at best show. Gauss-Newton, with
derivatives taken once.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.blind.changes import Changes
from benchmarks.blind.instruments import Chance, Rig, Signals, true_signals
from benchmarks.blind.plan import CampaignPlan

FloatArray = NDArray[np.float64]
DIFFERENCE = 0.1  # prior deviations
ITERATIONS = 4
FARTHEST = 4.0  # prior deviations that a parameter may move


@dataclass(frozen=True)
class Reference:
    """The nominal signals of a case, and how they change.

    Attributes
    ----------
    nominal : Signals
        Without an effect.
    matrix : (n, k)
        Whitened, zeros projected out: parameters, gains, release amplitudes, each per prior deviation.
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
        """Return d^2 of signals."""
        plan, names = self.plan, list(self.plan.priors)
        moved = np.zeros(self.matrix.shape[1])
        best = np.inf
        for _ in range(ITERATIONS):
            there = self._moved(moved, len(names))
            gains = dict(zip(plan.channels, moved[len(names) :], strict=False))
            difference = {
                t.name: signals[t.name]
                - there[t.name] * [1.0 + plan.channels[c].gain * gains[c] for c in t.channels]
                for t in plan.trials
            }
            residual = whitened(plan, difference)
            cost = float(residual @ residual + moved @ moved)
            if cost > 0.999 * best:
                best = min(best, cost)
                break
            best = cost
            moved = moved + np.linalg.solve(self.normal, self.matrix.T @ residual - moved)
            moved[: len(names)] = np.clip(moved[: len(names)], -FARTHEST, FARTHEST)
        return best

    def _moved(self, moved: FloatArray, parameters: int) -> Signals:
        if not moved.any():
            return self.nominal
        plan = self.plan
        values = {
            name: self.chance.parameters[name] + deviation * moved[k]
            for k, (name, (_, deviation)) in enumerate(plan.priors.items())
        }
        rings = [t for t in plan.trials if t.kind == "ringdown"]
        first = parameters + len(plan.channels)
        amplitude = {
            t.name: self.chance.amplitude[t.name] * (1.0 + plan.release_deviation * moved[first + k])
            for k, t in enumerate(rings)
        }
        chance = replace(self.chance, parameters=values, amplitude=amplitude)
        return true_signals(self.rig, plan, chance, Changes())


def whitened(plan: CampaignPlan, difference: Mapping[str, FloatArray]) -> FloatArray:
    """Differences over noise (n,), all trials one after the other, the freedom of the zeros taken out."""
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
    columns = []
    for name, (_, deviation) in plan.priors.items():
        step = DIFFERENCE * deviation
        moved = replace(chance, parameters={**chance.parameters, name: chance.parameters[name] + step})
        other = true_signals(rig, plan, moved, Changes())
        columns.append(
            whitened(plan, {t.name: (other[t.name] - nominal[t.name]) / DIFFERENCE for t in plan.trials})
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
                t.name: nominal[t.name] * (plan.release_deviation if t is ring else 0.0) for t in plan.trials
            }
            columns.append(whitened(plan, part))
    matrix = np.array(columns).T
    return Reference(rig, plan, chance, nominal, matrix, matrix.T @ matrix + np.eye(matrix.shape[1]))
