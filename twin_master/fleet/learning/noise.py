"""The noise of the sensors of a fleet, learnt from some of its twins."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fe.runtime.errors import OutsideModelError
from reporting.arrays import Float
from reporting.progress import SilentProgress
from twin_master.assets.parameter import ParameterDraws
from twin_master.errors import FleetError
from twin_master.fleet.checks import source_of
from twin_master.fleet.learning.evidence import TransitionFamily
from twin_master.fleet.learning.evidence_tasks import with_all_transitions_possible
from twin_master.fleet.learning.grid_density import (
    Axes,
    Distribution,
    cell_probabilities,
    resolve_density,
)
from twin_master.fleet.learning.parameter_evidence import parameter_evidence
from twin_master.fleet.reading import TwinsOfScenario
from twin_master.fleet.storage.store_layout import StoredObservations
from twin_master.network.sensor_model import GaussianSensorModel

NOISE_TWINS = 100
"""Largest number of twins of a group from which the noise is learnt.

They determine the factor on the noise to a few parts in a thousand.
"""
LARGEST_NOISE = 3.0
"""Largest factor on the assumed noise that is considered; the smallest is its inverse."""
NOISE_POINTS = 13
"""Number of points of the grid of the factor on the noise."""
NODES = 61
"""Number of values of the calibrated parameter at which the evidence is computed."""
NODE_DEVIATIONS = 6.0
"""Distance of the first and the last of these values from the calibrated mean.

The unit is the standard deviation of the calibration.
"""


@dataclass(frozen=True)
class ParameterNodes:
    """Values of the calibrated parameter at which the evidence of twins is computed.

    Attributes
    ----------
    values : (E,) array
        The equally spaced values.
    prior : (E,) array
        Their probabilities in the calibration, a normal distribution.
    predicted : (E, S, U, G) array
        The noise-free readings of the sensors for each value, state and control, in SI units.
    """

    values: Float
    prior: Float
    predicted: Float

    @property
    def every_second(self) -> "ParameterNodes":
        """Every second value: enough for the growth of damage, which hardly depends on them."""
        prior = self.prior[::2] / self.prior[::2].sum()
        return ParameterNodes(self.values[::2], prior, self.predicted[::2])


def parameter_nodes(twins: TwinsOfScenario, *, is_real: bool) -> ParameterNodes | None:
    """Return values of the calibrated parameter, with the readings that a model predicts.

    Return None if the calibration has no uncertainty, or if the source of the readings cannot
    compute them at chosen values of the parameter.

    Raises
    ------
    FleetError
        If some of the values are outside the range of the model.
    """
    knowledge = twins.knowledge
    draws = knowledge.draws
    if draws.standard_deviation <= 0.0:
        return None
    deviations = np.linspace(-NODE_DEVIATIONS, NODE_DEVIATIONS, NODES)
    values = draws.mean + draws.standard_deviation * deviations
    prior = np.exp(-0.5 * deviations**2)
    source = source_of(knowledge.scenario, is_real=is_real)
    source.prepare(twins.folder, SilentProgress())
    nodes = ParameterDraws(draws.name, values, draws.mean, draws.standard_deviation, "nodes")
    try:
        predicted_readings = source.observation_table(nodes, knowledge.model)
    except OutsideModelError as error:
        raise FleetError(
            f"{error} `fleet learn` computes the readings at values of {draws.name} up to "
            f"{NODE_DEVIATIONS:g} standard deviations from the mean of the calibration, which is "
            f"{draws.mean:.4g} ± {draws.standard_deviation:.2g} here: give `[calibration]` a "
            "smaller standard deviation, or a model with a wider range, and fly the fleet again."
        ) from error
    if len(predicted_readings) != NODES:  # a stored library of observations has fixed draws
        return None
    return ParameterNodes(values, prior / prior.sum(), predicted_readings)


def with_noise_factor(
    model: GaussianSensorModel, factor: float, value_per_draw: Float | None = None
) -> GaussianSensorModel:
    """Return a copy of a sensor model with a factor on the standard deviation of its noise.

    Parameters
    ----------
    value_per_draw : (E, S, U, G) array, optional
        The noise-free readings at other values of the parameter; by default those of the model.
    """
    return type(model)(
        model.value_per_draw if value_per_draw is None else value_per_draw,
        model.standard_deviation * factor,
        average="inside" if model.averages_inside else "outside",
        model_error=model.model_error,
        interval=model.interval,
        **model.extra_arguments,
    )


def noise_factor(
    store: StoredObservations,
    twins_by_scenario: Sequence[TwinsOfScenario],
    family: TransitionFamily,
    nodes: ParameterNodes | None,
) -> Distribution:
    """Return the posterior of the factor on the assumed noise, with a uniform prior of its log.

    The calibrated parameter of an asset is the same in all steps. A likelihood that averages over
    it in each step separately would attribute part of the noise to the parameter. So the evidence
    of all steps is computed at each value first and then averaged over the values: over the nodes
    or, without nodes, over the draws of the calibration.
    """
    first_twins = [
        twins._replace(rows=twins.rows[:NOISE_TWINS]) for twins in twins_by_scenario[:NOISE_TWINS]
    ]

    def log_likelihood(axes: Axes) -> Float:
        log_evidence = [
            _evidence_of_noise(store, first_twins, family, nodes, factor)
            for factor in np.exp(axes[0]).tolist()
        ]
        return np.array(log_evidence)

    largest_log_factor = np.log(LARGEST_NOISE)
    widest_axis = np.linspace(-largest_log_factor, largest_log_factor, NOISE_POINTS)
    (axis,), values = resolve_density(log_likelihood, (widest_axis,))
    return Distribution(axis, cell_probabilities(values), np.exp)


def _evidence_of_noise(
    store: StoredObservations,
    twins_by_scenario: Sequence[TwinsOfScenario],
    family: TransitionFamily,
    nodes: ParameterNodes | None,
    factor: float,
) -> float:
    """Return the log evidence of twins for a factor on the noise.

    Twins whose observations no course of states explains are left out.
    """
    from scipy.special import logsumexp

    probability = with_all_transitions_possible(family.assumed)
    total_log_evidence = 0.0
    for twins in twins_by_scenario:
        value_per_draw = None if nodes is None else nodes.predicted
        model = with_noise_factor(twins.knowledge.sensor_model, factor, value_per_draw)
        prior = model.draw_weight if nodes is None else nodes.prior
        for observed, control in store.blocks(twins.rows):
            at_nodes = parameter_evidence(family, probability, model, observed, control)
            log_evidence = logsumexp(at_nodes, b=prior, axis=1)
            total_log_evidence += float(log_evidence[np.isfinite(log_evidence)].sum())
    return total_log_evidence
