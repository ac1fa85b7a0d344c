"""The log evidence of twins whose calibrated parameter is unknown, but the same in all steps.

At each of E values of the parameter, the nodes, the evidence of a twin is that of a hidden Markov
model. Over the nodes it is averaged with the prior of the parameter. Where the readings at chosen
values are unknown, the nodes are the draws of the calibration. A likelihood that averages
over the parameter in each step anew would take a stiffer asset for a less damaged one: it finds
damage to grow 2.4 % too fast in a fleet whose stiffness is spread by 1 %.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from reporting.arrays import Float, Index
from twin_master.fleet.learning.evidence import (
    TransitionFamily,
    grid_evidence,
    scaled,
)
from twin_master.fleet.learning.evidence_kernels import evidence_in_lanes
from twin_master.fleet.learning.grid_density import Axes
from twin_master.network.sensor_model import GaussianSensorModel

LEAST_POSTERIOR = 1e-4
"""Posterior probability of a value of the parameter from which on it counts."""
_VALUES_TOGETHER = 300_000
"""Log densities of nodes that are in memory at the same time at most, 2.4 MB."""


def parameter_evidence(
    family: TransitionFamily,
    probability: Float,
    model: GaussianSensorModel,
    observations: Float,
    control: Index,
) -> Float:
    """Return the log evidence of B twins for E values of a parameter that is constant in time.

    For each value the likelihood of all steps is computed with this value.

    Parameters
    ----------
    probability : (K,) array
        The probabilities of worsening.
    model : GaussianSensorModel
        The model of the G sensors; its E draws are the values of the parameter.
    observations : (B, T, G) array
        The observations in SI units; NaN where one was lost.
    control : (B, T) array
        The control in force in each step.

    Returns
    -------
    (B, E) array
        The log evidence; -inf if the observations of a twin are impossible.
    """
    parts = _twins_at_nodes(family, probability, model, observations, control)
    return np.concatenate([log_evidence for _, log_evidence in parts])


class TwinLikelihood(NamedTuple):
    """The likelihood of the states of B twins in T steps, at some nodes for each twin.

    There is a row for each node of each twin, M rows in all. Those of a twin follow each other.

    Attributes
    ----------
    values : (M, T, S) array
        The likelihood of the S states, divided by its largest value in each step.
    control : (M, T) array
        The control in force in each step.
    log_weight : (M,) array
        The logarithm of the factor with which the evidence at a node counts.
    first_row : (B,) array
        The first row of each twin.
    """

    values: Float
    control: Index
    log_weight: Float
    first_row: Index

    def evidence_on_grid(self, family: TransitionFamily, axes: Axes) -> Float:
        """Return the log evidence of each twin on a grid of the probabilities of worsening.

        Parameters
        ----------
        axes : tuple of (N,) array
            The values of each probability.

        Returns
        -------
        (B, N^K) array
            The log evidence, the last axis varies fastest.
        """
        evidence_at_nodes = grid_evidence(family, axes, self.values, self.control)
        weighted = evidence_at_nodes + self.log_weight[:, None]
        # The sum over the rows of each twin, which begin with its first one.
        return np.asarray(np.logaddexp.reduceat(weighted, self.first_row, axis=0))


def likelihood_at_nodes(
    family: TransitionFamily,
    probability: Float,
    prior: Float,
    model: GaussianSensorModel,
    observations: Float,
    control: Index,
) -> TwinLikelihood:
    """Return the likelihood of twins at the probable values of their parameter.

    The evidence of a twin is the sum of those at all values, each times its prior. Values are left
    out whose posterior is below `LEAST_POSTERIOR`, and twins whose observations are impossible.

    Parameters
    ----------
    probability : (K,) array
        The probabilities of worsening for the posterior of the values; any course of the state must
        be possible.
    prior : (E,) array
        The probability of each value of the parameter.
    model : GaussianSensorModel
        The model of the G sensors; its E draws are the values of the parameter.
    observations : (B, T, G) array
        The observations in SI units; NaN where one was lost.
    control : (B, T) array
        The control in force in each step.
    """
    from scipy.special import logsumexp

    values = []
    rows_of_nodes = []
    log_weights = []
    node_counts = []
    first_twin = 0
    parts = _twins_at_nodes(family, probability, model, observations, control)
    for log_density, log_evidence in parts:
        average = logsumexp(log_evidence, b=prior, axis=1, keepdims=True)
        with np.errstate(invalid="ignore"):  # NaN if the observations of a twin are impossible
            is_probable = prior * np.exp(log_evidence - average) > LEAST_POSTERIOR
        twin, node = np.nonzero(is_probable)
        likelihood, log_scale = scaled(log_density[twin, :, :, node])
        values.append(likelihood)
        rows_of_nodes.append(first_twin + twin)
        log_weights.append(log_scale + np.log(prior[node]))
        node_counts.append(is_probable.sum(axis=1))
        first_twin += len(is_probable)
    count = np.concatenate(node_counts)
    count = count[count > 0]
    return TwinLikelihood(
        values=np.concatenate(values),
        control=control[np.concatenate(rows_of_nodes)],
        log_weight=np.concatenate(log_weights),
        first_row=np.cumsum(count) - count,
    )


def _twins_at_nodes(
    family: TransitionFamily,
    probability: Float,
    model: GaussianSensorModel,
    observations: Float,
    control: Index,
) -> Iterator[tuple[Float, Float]]:
    """Yield the densities and the evidence at E nodes, for as many twins as memory allows.

    They are log p(o_t | D_t, u_t, e), a (B, T, S, E) array, and the log evidence of all steps (B,
    E). The arguments are those of `parameter_evidence`.
    """
    twin_count, step_count = control.shape
    entries = np.repeat(family.entries(probability[None]).T, model.draw_count, axis=1)
    values_of_twin = max(1, step_count * model.state_count * model.draw_count)
    twins_together = max(1, _VALUES_TOGETHER // values_of_twin)
    for first in range(0, twin_count, twins_together):
        some_control = control[first : first + twins_together]
        all_steps = observations[first : first + twins_together].reshape(-1, observations.shape[-1])
        log_density = model.log_density_of_draws(all_steps, some_control.ravel())
        log_density = log_density.reshape(-1, step_count, model.state_count, model.draw_count)
        evidence = np.empty((len(some_control), model.draw_count))
        evidence_in_lanes(
            family.prior, family.predecessors, entries, some_control, log_density, evidence
        )
        yield log_density, evidence
