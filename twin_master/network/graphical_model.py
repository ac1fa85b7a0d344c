"""State space, controls, transitions and policies of the dynamic decision network.

They are the factors (2)-(4) and (28)-(29) of Kapteyn et al. 2021 as arrays. Every stochastic matrix
of the twin passes `stochastic_matrix`, which checks it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from reporting.arrays import Float, Index, nan_where_masked, product_of_each
from reporting.words import brief, comma_list
from twin_master.errors import InvalidModelError
from twin_master.network.transition import (
    TransitionModel,
    check_shape,
    distribution,
    kronecker_product,
    stochastic_matrix,
)
from twin_master.scenario.schema import Scenario
from twin_master.scenario.tables import probability_of


def interpolation_weights(nodes: Float, values: ArrayLike) -> Float:
    """Return the weight (n, ...) of each of n increasing nodes in a linear interpolation at values.

    It is the hat function of the node: piecewise linear, one at the node and zero at all others.
    """
    values = np.asarray(values, dtype=np.float64)
    return np.array([np.interp(values, nodes, hat) for hat in np.eye(len(nodes))])


@dataclass(frozen=True)
class Factor:
    """One named component of the state, and the levels that it can take.

    Attributes
    ----------
    name : str
        The name of the factor, such as that of a region of the asset.
    levels : tuple of float
        The values of the factor, strictly increasing, SI (a stiffness loss is a fraction).
    """

    name: str
    levels: tuple[float, ...]

    def __post_init__(self) -> None:
        levels = tuple(float(level) for level in self.levels)
        object.__setattr__(self, "levels", levels)
        if not self.name:
            raise InvalidModelError("a factor of the state space needs a name, got an empty one")
        if not levels or not np.all(np.isfinite(levels)) or np.any(np.diff(levels) <= 0.0):
            raise InvalidModelError(
                f"the factor {self.name!r} must have one or more finite, strictly increasing "
                f"levels, but they are {comma_list(levels)}"
            )

    @property
    def slack(self) -> float:
        """Largest difference of a value from its level by rounding: 1e-9 of the largest level."""
        return 1e-9 * max(map(abs, self.levels))

    def index(self, value: float) -> int:
        """Return the index of the level that equals a value within rounding (`slack`).

        Raises
        ------
        InvalidModelError
            If the value is none of the levels.
        """
        distance = np.abs(np.asarray(self.levels) - value)
        nearest_level = int(distance.argmin())
        if not distance[nearest_level] <= self.slack:
            raise InvalidModelError(
                f"{value} is not a level of factor {self.name!r}; its levels are "
                f"{comma_list(self.levels)}"
            )
        return nearest_level


@dataclass(frozen=True)
class StateSpace:
    """Joint state of named factors, flattened in C order (the last factor varies fastest).

    Attributes
    ----------
    factors : tuple of Factor
        At least one, with different names.
    """

    factors: tuple[Factor, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "factors", tuple(self.factors))
        names = [factor.name for factor in self.factors]
        if not names or len(set(names)) != len(names):
            raise InvalidModelError(
                "a state space needs one or more factors with different names, got "
                f"{comma_list(names)}"
            )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the factors."""
        return tuple(factor.name for factor in self.factors)

    @cached_property
    def shape(self) -> tuple[int, ...]:
        """Number of levels of each factor."""
        return tuple(len(factor.levels) for factor in self.factors)

    @cached_property
    def size(self) -> int:
        """Number S of joint states."""
        return int(np.prod(self.shape))

    @cached_property
    def coordinates(self) -> Float:
        """Levels of each joint state: (S, factors)."""
        grids = np.meshgrid(*(factor.levels for factor in self.factors), indexing="ij")
        table: Float = np.stack([grid.ravel() for grid in grids], axis=-1).astype(np.float64)
        table.setflags(write=False)
        return table

    def index(self, levels: Sequence[float]) -> int:
        """Return the index of the joint state with the given levels, one for each factor.

        Raises
        ------
        InvalidModelError
            If a value is not a level of its factor.
        """
        if len(levels) != len(self.factors):
            raise InvalidModelError(
                f"a state must have one level for each of {comma_list(self.names)}, but "
                f"{comma_list(levels)} was given"
            )
        pairs = zip(self.factors, levels, strict=True)
        indices = [factor.index(value) for factor, value in pairs]
        return int(np.ravel_multi_index(indices, self.shape))

    def nearest(self, values: ArrayLike) -> Index:
        """Return the index of the joint state nearest to values of the factors: (..., F) -> (...).

        Half-way between two levels the higher one is taken, as also within rounding of that.
        """
        table = nan_where_masked(values)
        level_of_factor = []
        for axis, factor in enumerate(self.factors):
            levels = np.asarray(factor.levels)
            half_way = 0.5 * (levels[1:] + levels[:-1]) - factor.slack
            level_of_factor.append(np.searchsorted(half_way, table[..., axis], side="right"))
        return np.asarray(np.ravel_multi_index(level_of_factor, self.shape), dtype=np.int64)

    def interpolate(self, table: ArrayLike, values: ArrayLike) -> Float:
        """Return a function of the state at values of the factors between the levels.

        The function is linear in each factor between its levels, and constant beyond them.

        Parameters
        ----------
        table : (S, N) array
            N functions of the state.
        values : (..., F) array
            The values of the factors, SI.

        Returns
        -------
        (..., N) array
            The functions at these values; NaN where a value is NaN.
        """
        from scipy.interpolate import RegularGridInterpolator  # slow to import

        levels = [np.asarray(factor.levels) for factor in self.factors]
        lowest = [factor_levels[0] for factor_levels in levels]
        highest = [factor_levels[-1] for factor_levels in levels]
        grid = np.asarray(table, dtype=np.float64).reshape(*self.shape, -1)
        within_levels = np.clip(nan_where_masked(values), lowest, highest)
        return np.asarray(RegularGridInterpolator(levels, grid)(within_levels))

    def certain_belief(self, levels: Sequence[float]) -> Float:
        """Return the belief (S,) with probability one at the given levels."""
        belief = np.zeros(self.size)
        belief[self.index(levels)] = 1.0
        return belief

    def mean(self, belief: ArrayLike) -> Float:
        """Return the mean of each factor: (..., S) -> (..., factors)."""
        return product_of_each(nan_where_masked(belief), self.coordinates)

    def standard_deviation(self, belief: ArrayLike) -> Float:
        """Return the standard deviation of each factor: (..., S) -> (..., factors)."""
        belief = nan_where_masked(belief)
        deviation = self.coordinates - self.mean(belief)[..., None, :]
        return np.asarray(np.sqrt(product_of_each(belief, deviation**2)))

    def change_within_interval(self, table: ArrayLike) -> Float:
        """Return how much a table typically changes within the interval that a state stands for.

        A level stands for the interval of values that are nearest to it: half way to its
        neighbours, and on one side only for the first and the last level. The true value is taken
        as uniformly distributed in this interval, and the table as linear between levels.

        Parameters
        ----------
        table : (S, ...) array
            A function of the state.

        Returns
        -------
        (S, ..., F) array
            The change of the table if each of F factors is one standard deviation off its level,
            by the straight line that fits the table best; zero for a factor of one level.
        """
        table = nan_where_masked(table)
        # The axis of joint states becomes one axis for the levels of each factor.
        table_by_levels = table.reshape(*self.shape, *table.shape[1:])
        change_of_factors = []
        for factor_axis, factor in enumerate(self.factors):
            levels_last = np.moveaxis(table_by_levels, factor_axis, -1)
            change = _change_within_interval(levels_last, factor.levels)
            change_by_levels = np.moveaxis(change, -1, factor_axis)
            change_of_factors.append(change_by_levels.reshape(table.shape))
        return np.stack(change_of_factors, axis=-1)

    def marginal(self, belief: ArrayLike, name: str) -> Float:
        """Return the marginal of the factor `name`: (..., S) -> (..., levels of that factor).

        Raises
        ------
        InvalidModelError
            If there is no such factor.
        """
        if name not in self.names:
            raise InvalidModelError(
                f"no factor is named {name!r}; there are {', '.join(self.names)}"
            )
        belief = nan_where_masked(belief)
        belief_by_levels = belief.reshape(*belief.shape[:-1], *self.shape)
        # The axes of the factors are the last ones, counted from the end by negative numbers.
        factor_count = len(self.shape)
        summed_axes = []
        for factor_index, factor_name in enumerate(self.names):
            if factor_name != name:
                summed_axes.append(factor_index - factor_count)
        return np.asarray(belief_by_levels.sum(axis=tuple(summed_axes)))


def _change_within_interval(values: Float, levels: tuple[float, ...]) -> Float:
    """Return how much a function of a factor changes one standard deviation off each level.

    `values` (..., L) are the function at the L levels, between which it is linear; the result has
    the same shape. The distance x of the true factor from its level is uniform, from half way to
    the level below to half way to the level above.

    With v the value at the level, m the integral of x (v(x) - v), and q that of x², the
    least-squares slope through the level is m / q. The change is this slope times the root mean
    square of x, which is sqrt(q / w) in an interval of width w; hence it is m / sqrt(q w).

    For a neighbour at the distance h, to which the function changes by d, the nearer half of the
    way contributes h² d / 24 to m, h³ / 24 to q, and h / 2 to w.
    """
    # The steps between levels, (L + 1,), and the differences of the values over them, (..., L + 1):
    # zero beyond the first and the last level, which have no neighbour there.
    step = np.pad(np.diff(levels), 1)
    no_padding = [(0, 0)] * (values.ndim - 1)
    difference = np.pad(np.diff(values), [*no_padding, (1, 1)])
    moment = step**2 * difference
    step_below = step[:-1]
    step_above = step[1:]
    sum_of_steps = step_above + step_below
    sum_of_cubes = step_above**3 + step_below**3
    sum_of_moments = moment[..., 1:] + moment[..., :-1]
    # m / sqrt(q w) = (sum h² d / 24) / sqrt((sum h³ / 24) (sum h / 2))
    divisor = np.sqrt(12.0 * sum_of_steps * sum_of_cubes)
    safe_divisor = np.where(divisor > 0.0, divisor, 1.0)  # a factor of one level does not change
    return np.asarray(sum_of_moments / safe_divisor)


@dataclass(frozen=True)
class GraphicalModel:
    """States, controls, prior and transitions of a dynamic decision network.

    Attributes
    ----------
    states : StateSpace
        S joint states.
    controls : tuple of str
        The names of the U controls.
    prior : (S,) array
        The distribution p(D_0) of the first state.
    transition : TransitionModel
        The transitions between the S states under the U controls.
    """

    states: StateSpace
    controls: tuple[str, ...]
    prior: Float
    transition: TransitionModel

    def __repr__(self) -> str:
        return brief(self, states=self.states.size, controls=self.controls)

    def __post_init__(self) -> None:
        object.__setattr__(self, "controls", tuple(self.controls))
        if not self.controls or len(set(self.controls)) != len(self.controls):
            raise InvalidModelError(
                "expected one or more controls with different names, got "
                f"{comma_list(self.controls)}"
            )
        size = self.states.size
        object.__setattr__(self, "prior", distribution(self.prior, size=size, name="prior"))
        check_shape("a transition", self.transition.shape, len(self.controls), size, size)

    @classmethod
    def from_tables(
        cls,
        levels: Mapping[str, Sequence[float]],
        tables: Mapping[str, Mapping[str, ArrayLike]],
        prior: Mapping[str, ArrayLike] | None = None,
    ) -> GraphicalModel:
        """Return the model of a state whose factors change independently of each other.

        Each control has transition tables of its own. Kapteyn et al. 2021, eqs. (28)-(29).

        Parameters
        ----------
        levels : mapping of str to sequence of float
            For each factor of the state its L levels, strictly increasing, SI.
        tables : mapping of str to mapping of str to (L, L) array
            For each control and factor p(level of the next step | level), row-stochastic.
        prior : mapping of str to (L,) array, optional
            For each factor p(level in step 0); if left out, it is certainly the lowest level.

        Raises
        ------
        InvalidModelError
            If levels do not increase, a row is not a distribution, or the table of a factor is
            missing.
        """
        states = StateSpace(tuple(Factor(name, tuple(values)) for name, values in levels.items()))
        if prior is not None:
            _check_factor_names("prior", prior, levels)
        for control, table in tables.items():
            _check_factor_names(control, table, levels)

        # the joint prior is the product over the factors, the last factor varies fastest
        priors = []
        for factor in states.factors:
            size = len(factor.levels)
            certainly_lowest = np.eye(size)[0]
            factor_prior = certainly_lowest if prior is None else prior[factor.name]
            priors.append(distribution(factor_prior, size=size, name=f"prior of {factor.name}"))
        ordered_tables = [[tables[control][name] for name in levels] for control in tables]
        transition = TransitionModel.from_factors(ordered_tables)
        return cls(states, tuple(tables), kronecker_product(priors), transition)

    @cached_property
    def log_prior(self) -> Float:
        """Log of the prior of the S states, minus infinity for a prior of zero."""
        with np.errstate(divide="ignore"):
            result: Float = np.log(self.prior)
        return result

    def policy(self, rows: ArrayLike) -> Float:
        """Return a policy p(control | state), checked and read-only: (states, controls).

        Raises
        ------
        InvalidModelError
            If a row is not a distribution, or the shape is not (S, U).
        """
        policy = stochastic_matrix(rows, name="policy[state]")
        check_shape("a policy", policy.shape, self.states.size, len(self.controls))
        return policy


def _check_factor_names(
    table: str, rows: Mapping[str, ArrayLike], levels: Mapping[str, Sequence[float]]
) -> None:
    """Refuse a table that does not have one entry for each factor."""
    if set(rows) != set(levels):
        raise InvalidModelError(
            f"{table} must have one table for each of the factors {comma_list(levels)}, but it has "
            f"{comma_list(rows)}"
        )


def worsening_table(level_count: int, probability: float) -> Float:
    """Return the transitions (n, n) of a factor that stays or worsens by one level.

    The last level absorbs: its row sums to one. In the authors' published table the rows at a
    damage limit lack the probability to worsen.

    Parameters
    ----------
    level_count : int
        The number n of levels.
    probability : float
        The probability to worsen by one level in one step, in [0, 1].
    """
    table = np.diag(np.full(level_count, 1.0 - probability))
    table += np.diag(np.full(level_count - 1, probability), 1)
    table[-1, -1] = 1.0
    return table


def repaired_table(table: Float, success: float) -> Float:
    """Return the transition table (L, L) of a step that ends with an attempt at a repair.

    A repair that succeeds sets the factor to its lowest level.

    Parameters
    ----------
    table : (L, L) array
        The transitions without the repair, row-stochastic.
    success : float
        The probability that the repair succeeds.
    """
    result = (1.0 - success) * table
    undamaged = 0  # the lowest level
    result[:, undamaged] += success
    # Rows sum to one but for rounding, which the division removes.
    return np.asarray(result / result.sum(axis=1, keepdims=True), dtype=np.float64)


def leaving_table(table: Float, factor: float) -> Float:
    """Multiply each probability of leaving a level by a factor; return the transition table (L, L).

    The probability of staying at a level changes so that each row still sums to one.

    Raises
    ------
    InvalidModelError
        If the factor makes a probability to leave a level larger than one.
    """
    is_staying = np.eye(len(table), dtype=bool)
    result = factor * np.where(is_staying, 0.0, table)
    staying = 1.0 - result.sum(axis=1)
    if np.any(staying < 0.0):
        leaving = 1.0 - float(staying.min())
        raise InvalidModelError(
            f"a factor of {factor:g} on the transition probabilities is too large: the probability "
            f"of leaving a level would be {leaving:g}. Take smaller `learning.transition_factors`"
        )
    return np.asarray(result + np.diag(staying), dtype=np.float64)


def factor_tables(
    scenario: Scenario, leaving_multiplier: float = 1.0
) -> dict[str, dict[str, Float]]:
    """Return the transition table of each state factor under each control, repairs included.

    Parameters
    ----------
    leaving_multiplier : float
        All probabilities of leaving a level are multiplied by this, but not those of a repair.

    Returns
    -------
    dict of str to dict of str to (levels, levels) array
        p(next level | level), by the name of the control, then that of the state factor.
    """
    transition = scenario.transition
    tables: dict[str, dict[str, Float]] = {}
    for control in scenario.control_names:
        tables[control] = {}
        for factor in scenario.state:
            if transition.kind == "independent_tables":
                table = np.asarray(transition.tables[control][factor.name], np.float64)
            else:
                probability = probability_of(transition.probability, control, factor.name)
                table = worsening_table(len(factor.levels), probability)
            if leaving_multiplier != 1.0:
                table = leaving_table(table, leaving_multiplier)
            tables[control][factor.name] = table
    for action in scenario.action:
        action_tables = tables[action.name]
        for name in action.repairs:
            action_tables[name] = repaired_table(action_tables[name], action.success)
    return tables


def build_graphical_model(scenario: Scenario, leaving_multiplier: float = 1.0) -> GraphicalModel:
    """Return the states, controls, prior and transitions of a scenario.

    It is assumed that the factors of the state change independently given the control, and are
    independent before the first observation: Kapteyn et al. 2021, eqs. (28)-(29).

    Parameters
    ----------
    leaving_multiplier : float
        All probabilities of leaving a level are multiplied by this, but not those of a repair.

    Raises
    ------
    InvalidModelError
        If the multiplier makes a probability larger than one.
    """
    return GraphicalModel.from_tables(
        levels={factor.name: factor.levels for factor in scenario.state},
        tables=factor_tables(scenario, leaving_multiplier),
        prior={factor.name: factor.prior for factor in scenario.state},
    )
