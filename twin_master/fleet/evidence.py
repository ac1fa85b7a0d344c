"""The log evidence of each twin's observations, as a function of what a fleet can learn.

Twins are independent given what they share, so that the log evidence of a fleet is the sum of theirs: exact,
in any order, shard by shard. What the twins decided takes no part, for they decided by what they had seen.
"""

from dataclasses import dataclass

import numpy as np

from fe.compilation import compiled
from reporting.arrays import Float, Index
from twin_master.fleet.posterior import POINTS
from twin_master.network.kernels import PredecessorLists, apply_blocks
from twin_master.network.sensor_model import GaussianSensorModel
from twin_master.network.transition import predecessor_lists
from twin_master.network.twin import build_graphical_model, factor_tables
from twin_master.scenario.schema import Scenario


@compiled
def _on_points(
    prior: Float,
    lists: PredecessorLists,
    probability: Float,
    control: Index,
    likelihood: Float,
    result: Float,
) -> None:
    """Fill result (B, P) with the log evidence of B twins for probabilities (P, non-zeros) of P points.

    The likelihood (B, T, S) is scaled so that the largest of a row is 1.
    """
    twins, steps, size = likelihood.shape
    levels, first_row, start, source, _, _ = lists
    belief, work = np.empty(size), np.empty(size)
    for twin in range(twins):
        for point in range(len(probability)):
            own = levels, first_row, start, source, probability[point], probability[point]
            belief[:], result[twin, point] = prior, 0.0
            for t in range(steps):
                if t > 0:
                    apply_blocks(own, control[twin, t - 1], belief, belief, work)
                total = 0.0
                for state in range(size):
                    belief[state] *= likelihood[twin, t, state]
                    total += belief[state]
                if total <= 0.0:
                    result[twin, point] = -np.inf
                    break
                result[twin, point] += np.log(total)
                for state in range(size):
                    belief[state] /= total


def why_transitions_are_kept(scenario: Scenario) -> str:
    """Return why a fleet cannot learn the transitions of a scenario, in words; empty where it can."""
    if scenario.transition.kind != "independent_worsening":
        return f"transitions of the kind `{scenario.transition.kind}` have no probability to worsen"
    entries = scenario.transition.probability.values()
    count = sum(len(entry) if isinstance(entry, dict) else 1 for entry in entries)
    if count > max(POINTS):
        return f"they have {count} probabilities to worsen, and {max(POINTS)} are learnt together at most"
    return ""


def _predecessors(scenario: Scenario) -> PredecessorLists:
    """Return the predecessors of the levels of each factor of the state of a scenario."""
    tables = factor_tables(scenario).values()
    return predecessor_lists([np.stack([rows[name] for rows in tables]) for name in scenario.state_names])


@dataclass(frozen=True)
class Worsening:
    """The K probabilities to worsen that are learnt of a scenario, and what its transitions make of them.

    K is 0 where its transitions stay as they are assumed; `kept_because` says why.

    Attributes
    ----------
    names : tuple of str
        One for each probability: the control, and the factor where each has its own.
    assumed : (K,)
        What the scenario assumes.
    lists : PredecessorLists
        Predecessors of the levels of each factor of the state.
    place : (non-zeros,)
        Number of the probability of each entry of the lists, which is linear in it.
    ends : (2, non-zeros)
        The entry where its probability is 0, and 1.
    prior : (S,)
        p(D_0).
    kept_because : str
        Why the transitions are not learnt, in words; empty where they are.
    """

    names: tuple[str, ...]
    assumed: Float
    lists: PredecessorLists
    place: Index
    ends: Float
    prior: Float
    kept_because: str = ""

    @classmethod
    def kept(cls, scenario: Scenario, reason: str) -> "Worsening":
        """Return none for a scenario whose transitions stay as assumed, for a reason."""
        lists = _predecessors(scenario)
        ends = np.stack([lists.probability, lists.probability])
        place = np.zeros(len(lists.probability), dtype=np.int64)
        return cls((), np.empty(0), lists, place, ends, build_graphical_model(scenario).prior, reason)

    @classmethod
    def of(cls, scenario: Scenario) -> "Worsening":
        """Return those of a scenario whose transitions are of the kind `independent_worsening`."""
        given = scenario.transition.probability
        each = {c: entry if isinstance(entry, dict) else {"": entry} for c, entry in given.items()}
        assumed = {(c, name): value for c in scenario.control_names for name, value in each[c].items()}

        def lists_at(probability: float) -> PredecessorLists:
            same = {"probability": dict.fromkeys(scenario.control_names, probability)}
            transition = scenario.transition.model_copy(update=same)
            return _predecessors(scenario.model_copy(update={"transition": transition}))

        lists, other, keys = lists_at(0.25), lists_at(0.75), [*assumed]
        rows = np.array(
            [
                keys.index((control, name if name in each[control] else ""))
                for name, levels in zip(scenario.state_names, lists.levels.tolist(), strict=True)
                for control in scenario.control_names
                for _ in range(levels)
            ]
        )
        count = (lists.start[1:] - lists.start[:-1]).astype(np.int64)
        slope = 2.0 * (other.probability - lists.probability)
        return cls(
            tuple(f"{control}, {name}" if name else control for control, name in keys),
            np.array([*assumed.values()]), lists, np.repeat(rows, count),
            lists.probability + slope * [[-0.25], [0.75]], build_graphical_model(scenario).prior,
        )  # fmt: skip

    def probability(self, points: Float) -> Float:
        """Return the entries of the lists (P, non-zeros) for probabilities (P, K) between 0 and 1."""
        if not self.names:
            return np.tile(self.ends[0], (len(points), 1))
        share = points.take(self.place, axis=1)
        return np.asarray((1.0 - share) * self.ends[0] + share * self.ends[1])


def scaled_likelihood(model: GaussianSensorModel, observed: Float, control: Index) -> tuple[Float, Float]:
    """Return p(o_t | D_t, u_t) of B twins over the largest of each step (B, T, S), and the logs of that (B,).

    Parameters
    ----------
    model : GaussianSensorModel
    observed, control
        (B, T, G), SI, NaN where lost, and (B, T).
    """
    rows = model.log_likelihood_sequence(observed.reshape(-1, observed.shape[-1]), control.ravel())
    return _scaled(rows.reshape(*control.shape, -1))


def _scaled(log_likelihood: Float) -> tuple[Float, Float]:
    best = log_likelihood.max(axis=2, keepdims=True)
    return np.exp(log_likelihood - best), best.sum(axis=(1, 2))


def transition_evidence(worsening: Worsening, points: Float, likelihood: Float, control: Index) -> Float:
    """Return the log evidence of B twins at P points (P, K): (B, P), up to a constant of each twin.

    Parameters
    ----------
    worsening : Worsening
    points : (P, K)
        Probabilities, between 0 and 1.
    likelihood : (B, T, S)
        Of `scaled_likelihood`.
    control : (B, T)
        Controls in force.
    """
    result = np.empty((len(control), len(points)))
    _on_points(worsening.prior, worsening.lists, worsening.probability(points), control, likelihood, result)
    return result


def node_evidence(
    worsening: Worsening, probability: Float, model: GaussianSensorModel, observed: Float, control: Index
) -> Float:
    """Return the log evidence of B twins at E values of a parameter that does not change in time: (B, E).

    Parameters
    ----------
    worsening : Worsening
    probability : (K,)
        To worsen.
    model : GaussianSensorModel
        Its draws are the values of the parameter.
    observed, control
        (B, T, G), SI, NaN where lost, and (B, T).
    """
    result = np.empty((len(control), model.draw_count))
    for twin, (seen, in_force) in enumerate(zip(observed, control, strict=True)):
        scaled, common = _scaled(
            np.ascontiguousarray(np.moveaxis(model.log_density_of_draws(seen, in_force), 2, 0))
        )
        alike = np.tile(in_force, (model.draw_count, 1))
        result[twin] = transition_evidence(worsening, probability[None], scaled, alike)[:, 0] + common
    return result
