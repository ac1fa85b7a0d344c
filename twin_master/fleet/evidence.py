"""The log evidence of each twin's observations, as a function of what a fleet can learn.

Twins are independent given what they share, so that the log evidence of a fleet is the sum of theirs: exact,
in any order, shard by shard. What the twins decided takes no part, for they decided by what they had seen.
"""

from dataclasses import dataclass
from functools import reduce

import numpy as np

from fe.compilation import compiled
from reporting.arrays import Float, Index, Unsigned
from twin_master.errors import FleetError
from twin_master.network.sensor_model import GaussianSensorModel
from twin_master.network.transition import predecessor_lists
from twin_master.network.twin import build_graphical_model, factor_tables
from twin_master.scenario.schema import Scenario


@compiled
def _on_points(
    prior: Float,
    start: Unsigned,
    source: Unsigned,
    probability: Float,
    control: Index,
    likelihood: Float,
    result: Float,
) -> None:
    """Fill result (B, P) with the log evidence of B twins for probabilities (P, non-zeros) of P points.

    The likelihood (B, T, S) is scaled so that the largest of a row is 1.
    """
    twins, steps, size = likelihood.shape
    belief, following = np.empty(size), np.empty(size)
    for twin in range(twins):
        for point in range(len(probability)):
            belief[:] = prior
            result[twin, point] = 0.0
            for t in range(steps):
                total = 0.0
                for state in range(size):
                    value = belief[state]
                    if t > 0:
                        row = control[twin, t - 1] * size + state
                        value = 0.0
                        for k in range(start[row], start[row + 1]):
                            value += belief[source[k]] * probability[point, k]
                    following[state] = value * likelihood[twin, t, state]
                    total += following[state]
                if total <= 0.0:
                    result[twin, point] = -np.inf
                    break
                result[twin, point] += np.log(total)
                for state in range(size):
                    belief[state] = following[state] / total


@dataclass(frozen=True)
class Worsening:
    """The K probabilities to worsen of a scenario, and what its transitions make of them.

    An entry of the joint table is a product over the factors of the state, each linear in its probability.

    Attributes
    ----------
    names : tuple of str
        One for each probability: the control, and the factor where each has its own.
    assumed : (K,)
        What the scenario assumes.
    start, source
        Of the predecessor lists of all states.
    factors : for each factor of the state
        For each entry (non-zeros,) the number of its probability p, and what it is where p is 0, and 1.
    prior : (S,)
        p(D_0).
    """

    names: tuple[str, ...]
    assumed: Float
    start: Unsigned
    source: Unsigned
    factors: tuple[tuple[Index, Float, Float], ...]
    prior: Float

    @classmethod
    def of(cls, scenario: Scenario) -> "Worsening":
        """Return those of a scenario.

        Raises
        ------
        FleetError
            Its transitions are tables.
        """
        if scenario.transition.kind != "independent_worsening":
            raise FleetError("probabilities are learnt of transitions of the kind `independent_worsening`.")
        given, keys, assumed = scenario.transition.probability, [], []
        for control in scenario.control_names:
            entry = given[control]
            named = entry if isinstance(entry, dict) else {None: entry}
            keys += [(control, name) for name in named]
            assumed += list(named.values())

        def at(probability: float) -> Scenario:
            same = {"probability": dict.fromkeys(scenario.control_names, probability)}
            transition = scenario.transition.model_copy(update=same)
            return scenario.model_copy(update={"transition": transition})

        model = build_graphical_model(at(0.5))
        _, _, start, source, *_ = predecessor_lists([model.transition.matrix])
        shape, size = model.states.shape, model.states.size
        row = np.repeat(np.arange(len(start) - 1), (start[1:] - start[:-1]).astype(np.int64))
        in_force, to = np.divmod(row, size)
        before, after = np.unravel_index(source.astype(np.int64), shape), np.unravel_index(to, shape)

        never, always = factor_tables(at(0.0)), factor_tables(at(1.0))
        factors = []
        for name, *ends in zip(scenario.state_names, before, after, strict=True):
            own = [(control, name) if (control, name) in keys else (control, None) for control in never]
            limits = [
                np.stack([tables[control][name] for control in never])[in_force, *ends]
                for tables in (never, always)
            ]
            factors.append((np.array([keys.index(key) for key in own])[in_force], *limits))
        names = tuple(control if name is None else f"{control}, {name}" for control, name in keys)
        return cls(names, np.array(assumed), start, source, tuple(factors), model.prior)

    def probability(self, points: Float) -> Float:
        """Return the entries of the lists (P, non-zeros) for probabilities (P, K) between 0 and 1."""
        shares = (never + points[:, k] * (always - never) for k, never, always in self.factors)
        return np.asarray(reduce(np.multiply, shares))


def scaled_likelihood(model: GaussianSensorModel, observed: Float, control: Index) -> tuple[Float, Float]:
    """Return p(o_t | D_t, u_t) of B twins over the largest of each turn (B, T, S), and the logs of that (B,).

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
    _on_points(
        worsening.prior, worsening.start, worsening.source, worsening.probability(points), control,
        likelihood, result,
    )  # fmt: skip
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
