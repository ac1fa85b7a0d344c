"""The log evidence of each twin's observations, as a function of the quantities to be learnt.

Twins are independent given the quantities that they share. The log evidence of a fleet is therefore
exactly the sum over its twins. The probability of the chosen controls is not a factor of the
evidence, because they depend on past observations alone.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from reporting.arrays import Float, Index
from twin_master.fleet.learning.evidence_kernels import (
    LANES_TOGETHER,
    LEAST_EVIDENCE,
    SubGrids,
    evidence_in_lanes,
    evidence_on_grid,
)
from twin_master.fleet.learning.grid_density import Axes
from twin_master.fleet.learning.posterior import GRID_POINTS
from twin_master.network.graphical_model import build_graphical_model, factor_tables
from twin_master.network.kernels import PredecessorLists
from twin_master.network.transition import predecessor_lists
from twin_master.scenario.schema import Scenario

_LEARNABLE_KIND = "independent_worsening"


def reason_transitions_are_fixed(scenario: Scenario) -> str:
    """Return why the transitions of a scenario cannot be learnt; an empty text if they can."""
    if scenario.transition.kind != _LEARNABLE_KIND:
        return f"transitions of the kind `{scenario.transition.kind}` have no probability to worsen"
    count = len(_assumed_probabilities(scenario))
    most = max(GRID_POINTS)
    if count > most:
        return f"they have {count} probabilities to worsen, and {most} are learnt together at most"
    return ""


class _Cause(NamedTuple):
    """The control, and the factor of the state, for which a probability of worsening holds.

    The factor is empty if the control has one probability for all factors.
    """

    control: str
    factor: str

    @property
    def name(self) -> str:
        """The name of the probability in records and files: "CONTROL" or "CONTROL, FACTOR"."""
        return f"{self.control}, {self.factor}" if self.factor else self.control


def _assumed_probabilities(scenario: Scenario) -> dict[_Cause, float]:
    """Return the probability of worsening that a scenario assumes for each of its controls."""
    probabilities = {}
    for control in scenario.control_names:
        entry = scenario.transition.probability[control]
        if isinstance(entry, Mapping):
            for factor, probability in entry.items():
                probabilities[_Cause(control, factor)] = probability
        else:
            probabilities[_Cause(control, "")] = entry
    return probabilities


def _predecessors(scenario: Scenario) -> PredecessorLists:
    """Return the predecessors of the levels of each factor of the state of a scenario."""
    tables_of_controls = factor_tables(scenario).values()
    blocks = []
    for name in scenario.state_names:
        blocks.append(np.stack([tables[name] for tables in tables_of_controls]))
    return predecessor_lists(blocks)


@dataclass(frozen=True)
class TransitionFamily:
    """The transition probabilities of a scenario as a function of K probabilities of worsening.

    A probability of worsening is the probability that a factor of the state moves to its next level
    in a step. Each entry of the lists of predecessors is a linear function of one of them. K is 0
    if the transitions are not learnt.

    Attributes
    ----------
    names : tuple of str
        The names of the probabilities: the control, and the factor if each has its own.
    assumed : (K,) array
        The probabilities that the scenario assumes.
    predecessors : PredecessorLists
        The predecessors of the levels of each factor of the state.
    parameter_index : (non-zeros,) array
        The index of the probability on which each entry of the lists depends.
    entries_at_zero, entries_at_one : (non-zeros,) array
        The entries of the lists if their probability of worsening is 0, and if it is 1.
    prior : (S,) array
        The belief p(D_0) over the S joint states before the first step.
    reason_fixed : str
        Why the transitions are not learnt; empty if they are.
    """

    names: tuple[str, ...]
    assumed: Float
    predecessors: PredecessorLists
    parameter_index: Index
    entries_at_zero: Float
    entries_at_one: Float
    prior: Float
    reason_fixed: str = ""

    @classmethod
    def fixed(cls, scenario: Scenario, reason: str) -> "TransitionFamily":
        """Return the constant transitions of a scenario, with the reason why none is learnt."""
        lists = _predecessors(scenario)
        entries = lists.probability
        return cls(
            names=(),
            assumed=np.empty(0),
            predecessors=lists,
            parameter_index=np.zeros(len(entries), dtype=np.int64),
            entries_at_zero=entries,
            entries_at_one=entries,
            prior=build_graphical_model(scenario).prior,
            reason_fixed=reason,
        )

    @classmethod
    def learnable(cls, scenario: Scenario) -> "TransitionFamily":
        """Return the transitions of a scenario as functions of its probabilities of worsening.

        The transition of the scenario is of the kind `independent_worsening`.
        """
        probabilities = _assumed_probabilities(scenario)
        # Each entry is a linear function of its probability p. Its values at p = 1/4 and 3/4
        # determine slope and ends. At p = 0 or 1 the lists would lack the entries that are zero.
        low, high = 0.25, 0.75
        lists = _predecessors_at(scenario, low)
        entries = lists.probability
        slope = (_predecessors_at(scenario, high).probability - entries) / (high - low)
        return cls(
            names=tuple(cause.name for cause in probabilities),
            assumed=np.array(list(probabilities.values())),
            predecessors=lists,
            parameter_index=_parameter_index(scenario, list(probabilities), lists),
            entries_at_zero=entries - slope * low,
            entries_at_one=entries + slope * (1.0 - low),
            prior=build_graphical_model(scenario).prior,
        )

    @property
    def axes_of_control(self) -> Index:
        """For each control (U,), the set of probabilities on which its transition depends.

        A set is a number whose bit k says whether probability k belongs to it.
        """
        levels, first_row, start, _, _, _ = self.predecessors
        is_changed = self.entries_at_zero != self.entries_at_one
        # Each block has a row for each control and level.
        end_row = np.append(first_row[1:], len(start) - 1)
        control_count = int((end_row[0] - first_row[0]) // levels[0])
        axes = np.zeros(control_count, dtype=np.int64)
        for block_row, level_count in zip(first_row.tolist(), levels.tolist(), strict=True):
            for control in range(control_count):
                row = block_row + control * level_count
                entries = slice(int(start[row]), int(start[row + level_count]))
                for k in self.parameter_index[entries][is_changed[entries]].tolist():
                    axes[control] |= 1 << k
        return axes

    def entries(self, points: Float) -> Float:
        """Return the entries of the lists, (P, non-zeros), for P values of K probabilities."""
        if not self.names:
            return np.tile(self.entries_at_zero, (len(points), 1))
        probability = points.take(self.parameter_index, axis=1)
        return np.asarray(
            (1.0 - probability) * self.entries_at_zero + probability * self.entries_at_one
        )


def _predecessors_at(scenario: Scenario, probability: float) -> PredecessorLists:
    """Return the predecessor lists of a scenario whose probabilities of worsening are all equal."""
    equal_probabilities = {"probability": dict.fromkeys(scenario.control_names, probability)}
    transition = scenario.transition.model_copy(update=equal_probabilities)
    return _predecessors(scenario.model_copy(update={"transition": transition}))


def _parameter_index(scenario: Scenario, causes: list[_Cause], lists: PredecessorLists) -> Index:
    """Return for each non-zero transition in the lists the index of its cause.

    A cause is a control with a factor, or a control alone, that has a probability of worsening of
    its own. The rows of the lists are ordered by factor, then by control, then by level.
    """
    levels_of_factors, _, start, _, _, _ = lists
    index_of_rows = []
    for factor, level_count in zip(scenario.state_names, levels_of_factors.tolist(), strict=True):
        for control in scenario.control_names:
            cause = _Cause(control, factor)
            if cause not in causes:  # the control has one probability for all factors
                cause = _Cause(control, "")
            index_of_rows += [causes.index(cause)] * level_count
    entries_of_rows = (start[1:] - start[:-1]).astype(np.int64)
    return np.repeat(np.array(index_of_rows), entries_of_rows)


def scaled(log_likelihood: Float) -> tuple[Float, Float]:
    """Return the likelihood of the states of B twins in T steps, over the largest of each step.

    Parameters
    ----------
    log_likelihood : (B, ..., T, S) array
        log p(o_t | D_t, u_t).

    Returns
    -------
    values : (B, ..., T, S) array
        p(o_t | D_t, u_t) divided by its largest value over the S states, for each step t.
    log_scale : (B, ...) array
        The sum over the steps of the logarithms of these largest values.
    """
    largest = log_likelihood.max(axis=-1, keepdims=True)
    return np.exp(log_likelihood - largest), largest.sum(axis=(-2, -1))


def transition_evidence(
    family: TransitionFamily, points: Float, log_likelihood: Float, control: Index
) -> Float:
    """Return the log evidence of the observations of B twins at P points.

    A point has a value for each of the K probabilities of worsening. The evidence is that of the T
    observations o_t under the controls u_t, with the S states D_t summed out.

    Parameters
    ----------
    points : (P, K) array
        The values of the probabilities of worsening at each point, between 0 and 1.
    log_likelihood : (B, T, S) array
        log p(o_t | D_t, u_t) of each twin, in each step and state.
    control : (B, T) array
        The index of the control u_t in force in each step.

    Returns
    -------
    (B, P) array
        The log evidence; -inf if the observations of a twin are impossible.
    """
    # each point is a lane of the compiled loop: a hidden Markov model with transitions of its own
    entries = np.ascontiguousarray(family.entries(points).T)  # (non-zeros, P)
    log_density = np.ascontiguousarray(log_likelihood)[..., None]  # the same at all points
    log_evidence = np.empty((len(control), len(points)))  # filled by the loop
    evidence_in_lanes(
        family.prior, family.predecessors, entries, control, log_density, log_evidence
    )
    return log_evidence


def sub_grids(family: TransitionFamily, axes: Axes) -> SubGrids:
    """Return the grids of all subsets of the K probabilities, with the transitions at their points.

    The transition of a control depends only on some of the probabilities; the grid of this subset
    has far fewer points than that of all.

    Parameters
    ----------
    axes : tuple of (N,) array
        The values of each of the K probabilities.
    """
    first = [0]
    strides = []
    indices = []
    entries = []
    for number in range(2 ** len(axes)):
        has_axis = [bool(number >> k & 1) for k in range(len(axes))]
        lengths = [len(axis) if has else 1 for axis, has in zip(axes, has_axis, strict=True)]
        index = np.indices(lengths).reshape(len(axes), -1).T  # (lanes, K)
        # The stride of the last axis is 1, and that of another the product of the later lengths.
        stride = np.append(np.cumprod(lengths[:0:-1])[::-1], 1)[: len(axes)]
        strides.append(np.where(has_axis, stride, 0))
        missing = -len(index) % LANES_TOGETHER
        index = np.concatenate((index, np.repeat(index[-1:], missing, axis=0)))
        points = np.column_stack([axis[column] for axis, column in zip(axes, index.T, strict=True)])
        first.append(first[-1] + len(index))
        indices.append(index)
        entries.append(family.entries(points).T)
    return SubGrids(
        axes_of_control=family.axes_of_control,
        first=np.array(first),
        stride=np.array(strides, dtype=np.int64),
        index_on_axis=np.concatenate(indices),
        entries=np.ascontiguousarray(np.concatenate(entries, axis=1)),
    )


def grid_evidence(family: TransitionFamily, axes: Axes, likelihood: Float, control: Index) -> Float:
    """Return the log evidence of B twins on a tensor grid of K probabilities of worsening.

    At the points of the grid it equals that of `transition_evidence`, to rounding, without the
    `log_scale` of each twin's likelihood, which is a constant.

    Parameters
    ----------
    axes : tuple of (N,) array
        The values of each probability, between 0 and 1.
    likelihood : (B, T, S) array
        The likelihoods p(o_t | D_t, u_t), scaled by `scaled`.
    control : (B, T) array
        The control in force in each step.

    Returns
    -------
    (B, N^K) array
        The log evidence, the last axis varies fastest; -inf if the observations of a twin are
        impossible.
    """
    if not axes:  # the transitions are not learnt: the grid has a single point without coordinates
        return transition_evidence(family, np.empty((1, 0)), _log(likelihood), control)
    result = np.empty((len(control), math.prod(len(axis) for axis in axes)))
    grids = sub_grids(family, axes)
    evidence_on_grid(family.prior, family.predecessors, grids, control, likelihood, result)
    is_improbable = ~(result > LEAST_EVIDENCE).all(axis=1)
    if is_improbable.any():
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
        result[is_improbable] = transition_evidence(
            family, points, _log(likelihood[is_improbable]), control[is_improbable]
        )
    return result


def _log(likelihood: Float) -> Float:
    """Return the logarithm of a likelihood; -inf where it is zero."""
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(likelihood))
