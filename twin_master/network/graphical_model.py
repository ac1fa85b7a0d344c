"""State space, controls, transitions and policies of the dynamic decision network.

The factors (2)-(4) and (28)-(29) of Kapteyn et al. 2021 as arrays. Every stochastic matrix of the twin
passes `stochastic_matrix`, which checks it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from reporting.arrays import Float
from reporting.words import brief
from twin_master.errors import InvalidModelError, said
from twin_master.network.transition import TransitionModel, distribution, expect_shape, stochastic_matrix


@dataclass(frozen=True)
class Factor:
    """One named component of the state and the levels that it can take.

    Attributes
    ----------
    name : str
        For example the name of a region of the asset.
    levels : tuple of float
        Strictly increasing values, SI (a stiffness loss is a fraction).
    """

    name: str
    levels: tuple[float, ...]

    def __post_init__(self) -> None:
        levels = tuple(float(level) for level in self.levels)
        object.__setattr__(self, "levels", levels)
        if not self.name:
            raise InvalidModelError("a factor of the state space needs a name, got an empty one")
        if not levels or not np.all(np.isfinite(levels)) or np.any(np.diff(levels) <= 0.0):
            raise InvalidModelError(said("network.levels", name=self.name, levels=levels))

    @property
    def slack(self) -> float:
        """By how much a value may miss a level by rounding: a billionth of the largest level."""
        return 1e-9 * max(map(abs, self.levels))


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
            raise InvalidModelError(said("network.factors", names=names))

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
        """Return the joint index of the given levels, one per factor (matched to `Factor.slack`).

        Raises
        ------
        InvalidModelError
            If a value is no level of its factor.
        """
        if len(levels) != len(self.factors):
            raise InvalidModelError(f"expected one level for each of {self.names}, got {tuple(levels)}")
        indices = []
        for factor, value in zip(self.factors, levels, strict=True):
            distance = np.abs(np.asarray(factor.levels) - value)
            best = int(distance.argmin())
            if not distance[best] <= factor.slack:
                raise InvalidModelError(said("network.no_level", value=value, factor=factor))
            indices.append(best)
        return int(np.ravel_multi_index(indices, self.shape))

    def certain(self, levels: Sequence[float]) -> Float:
        """Return the distribution (S,) that is certain of the given levels."""
        belief = np.zeros(self.size)
        belief[self.index(levels)] = 1.0
        return belief

    def mean(self, belief: ArrayLike) -> Float:
        """Return the mean of each factor: (..., S) -> (..., factors)."""
        return np.asarray(belief, dtype=np.float64) @ self.coordinates

    def standard_deviation(self, belief: ArrayLike) -> Float:
        """Return the standard deviation of each factor: (..., S) -> (..., factors)."""
        belief = np.asarray(belief, dtype=np.float64)
        deviation = self.coordinates - self.mean(belief)[..., None, :]
        return np.asarray(np.sqrt(np.einsum("...s,...sf->...f", belief, deviation**2)))

    def within_interval(self, table: ArrayLike) -> Float:
        """Return what a table over the states (S, ...) changes by inside each state's interval: (S, ..., F).

        A level stands for the values nearest to it: half way to its neighbours, and at the ends to one side.
        The truth lies anywhere in there; between levels the table is taken for piecewise linear. The result
        is what it changes by where each factor is one standard deviation off its level, by the straight line
        that fits best; zero for a factor of one level.
        """
        table = np.asarray(table, dtype=np.float64)
        grid, result = table.reshape(*self.shape, *table.shape[1:]), []
        for axis, factor in enumerate(self.factors):
            along = np.moveaxis(grid, axis, -1)
            step = np.pad(np.diff(factor.levels), 1)  # no neighbour beyond an end: no interval there
            change = np.pad(np.diff(along), [(0, 0)] * (along.ndim - 1) + [(1, 1)])
            moment = step**2 * change
            scale = np.sqrt(12.0 * (step[1:] + step[:-1]) * (step[1:] ** 3 + step[:-1] ** 3))
            both = (moment[..., 1:] + moment[..., :-1]) / np.where(scale > 0.0, scale, 1.0)
            result.append(np.moveaxis(both, -1, axis).reshape(table.shape))
        return np.stack(result, axis=-1)

    def marginal(self, belief: ArrayLike, name: str) -> Float:
        """Return the marginal of the factor `name`: (..., S) -> (..., levels of that factor).

        Raises
        ------
        InvalidModelError
            If there is no such factor.
        """
        if name not in self.names:
            raise InvalidModelError(f"no factor is named {name!r}; there are {', '.join(self.names)}")
        belief = np.asarray(belief, dtype=np.float64)
        joint = belief.reshape(*belief.shape[:-1], *self.shape)
        keep = self.names.index(name)
        others = tuple(axis - len(self.shape) for axis in range(len(self.shape)) if axis != keep)
        return np.asarray(joint.sum(axis=others))


@dataclass(frozen=True)
class GraphicalModel:
    """States, controls, prior and transitions: what inference needs beside the log-likelihoods.

    Attributes
    ----------
    states : StateSpace
        S joint states.
    controls : tuple of str
        Names of the U controls.
    prior : (S,) dimensionless
        p(D_0).
    transition : TransitionModel
        Of the U controls and S states.
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
            raise InvalidModelError(said("network.controls", controls=self.controls))
        size = self.states.size
        object.__setattr__(self, "prior", distribution(self.prior, size=size, name="prior"))
        expect_shape("a transition", self.transition.shape, len(self.controls), size, size)

    @classmethod
    def from_tables(
        cls,
        levels: Mapping[str, Sequence[float]],
        tables: Mapping[str, Mapping[str, ArrayLike]],
        prior: Mapping[str, ArrayLike] | None = None,
    ) -> "GraphicalModel":
        """Return the model of factors that move independently given the control, as plain tables say it.

        Kapteyn et al. 2021, eqs. (28)-(29).

        Parameters
        ----------
        levels : mapping of str to sequence of float
            Factor of the state -> its L levels, strictly increasing, SI.
        tables : mapping of str to mapping of str to (L, L) array, dimensionless
            Control -> factor -> p(level of the next step | level), row-stochastic.
        prior : mapping of str to (L,) array, dimensionless, optional
            Factor -> p(level in step 0); certainly the lowest level if left out.

        Raises
        ------
        InvalidModelError
            If a factor, a level or a row of a table is no such thing, or a table of a factor is missing.
        """
        states = StateSpace(tuple(Factor(name, tuple(values)) for name, values in levels.items()))
        given = {"prior": prior, **tables} if prior is not None else dict(tables)
        for control, rows in given.items():
            if set(rows) != set(levels):
                raise InvalidModelError(said("network.tables", control=control, levels=levels, rows=rows))
        joint: Float = np.ones(1)
        for factor in states.factors:
            size = len(factor.levels)
            first = np.eye(size)[0] if prior is None else prior[factor.name]
            own = distribution(first, size=size, name=f"prior of {factor.name}")
            joint = np.asarray(np.kron(joint, own), dtype=np.float64)
        moves = [[tables[control][name] for name in levels] for control in tables]
        return cls(states, tuple(tables), joint, TransitionModel.from_factors(moves))

    @cached_property
    def log_prior(self) -> Float:
        """Log of the prior (S,), minus infinity where it is zero."""
        with np.errstate(divide="ignore"):
            result: Float = np.log(self.prior)
        return result

    def policy(self, rows: ArrayLike) -> Float:
        """Return a checked policy p(U | D): (S, U), read-only, row-stochastic.

        Raises
        ------
        InvalidModelError
            If a row is no distribution, or the shape is another one.
        """
        policy = stochastic_matrix(rows, name="policy[state]")
        expect_shape("a policy", policy.shape, self.states.size, len(self.controls))
        return policy


def worsening_table(level_count: int, probability: float) -> Float:
    """Return the transitions (n, n) of a factor that stays or worsens by one level.

    The last level absorbs: the row at the limit sums to one, where the authors' published table leaves
    the rows at a damage limit without the lost mass.

    Parameters
    ----------
    level_count : int
        Number n of levels.
    probability : float
        Probability to worsen by one level in one step, in [0, 1].
    """
    table = np.diag(np.full(level_count, 1.0 - probability))
    table += np.diag(np.full(level_count - 1, probability), 1)
    table[-1, -1] = 1.0
    return table


def repaired_table(table: Float, success: float) -> Float:
    """Return transitions (L, L) whose end is brought to the lowest level with a probability."""
    result = (1.0 - success) * table
    result[:, 0] += success
    return np.asarray(result / result.sum(axis=1, keepdims=True), dtype=np.float64)


def leaving_table(table: Float, factor: float) -> Float:
    """Return transitions (L, L) whose probabilities to leave a level are multiplied by a factor."""
    result = factor * np.where(np.eye(len(table), dtype=bool), 0.0, table)
    stay = 1.0 - result.sum(axis=1)
    if np.any(stay < 0.0):
        raise InvalidModelError(said("network.leaving", factor=factor, leaving=1.0 - float(stay.min())))
    return np.asarray(result + np.diag(stay), dtype=np.float64)
