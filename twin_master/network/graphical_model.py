"""State space, controls, transitions and policies of the dynamic decision network.

The factors (2)-(4) and (28)-(29) of Kapteyn et al. 2021 as arrays. Every stochastic matrix of the twin
passes `stochastic_matrix`, which checks it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import prod

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twin_master.errors import InvalidModelError
from twin_master.network.distributions import distribution, stochastic_matrix
from twin_master.network.memory import TRANSITION_COPIES, check_fits, transition_bytes

__all__ = [
    "Factor",
    "GraphicalModel",
    "SparseTransition",
    "StateSpace",
    "TransitionModel",
    "deterministic_policy",
    "worsening_table",
]

Float = NDArray[np.float64]
Unsigned = NDArray[np.uint64]


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
            raise InvalidModelError(
                f"factor {self.name!r}: expected one or more finite, strictly increasing levels, got {levels}"
            )


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
                f"a state space needs one or more factors with different names, got {names}"
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
        """Return the joint index of the given levels, one per factor (matched to 1e-9).

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
            if not distance[best] <= 1e-9:
                raise InvalidModelError(
                    f"{value} is no level of factor {factor.name!r}; its levels are {factor.levels}"
                )
            indices.append(best)
        return int(np.ravel_multi_index(indices, self.shape))

    def certain(self, levels: Sequence[float]) -> Float:
        """Return the distribution (S,) that is certain of the given levels."""
        belief = np.zeros(self.size)
        belief[self.index(levels)] = 1.0
        return belief

    def mean(self, belief: ArrayLike) -> Float:
        """Return the mean of each factor: (..., S) -> (..., factors)."""
        result: Float = np.asarray(belief, dtype=np.float64) @ self.coordinates
        return result

    def standard_deviation(self, belief: ArrayLike) -> Float:
        """Return the standard deviation of each factor: (..., S) -> (..., factors)."""
        belief = np.asarray(belief, dtype=np.float64)
        deviation = self.coordinates - self.mean(belief)[..., None, :]
        result: Float = np.sqrt(np.einsum("...s,...sf->...f", belief, deviation**2))
        return result

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
        result: Float = joint.sum(axis=others)
        return result


@dataclass(frozen=True)
class SparseTransition:
    """The non-zero transitions as predecessor lists.

    Row ``control * S + state`` lists the states from which `state` is reached under `control`. The arrays
    are for the compiled loops, which never write to them; unsigned indices spare the loops the test for
    negative ones.

    Attributes
    ----------
    start : (U * S + 1,)
        Where each row begins.
    source : (non-zeros,)
        The predecessor.
    probability, log_probability : (non-zeros,) dimensionless
        Of the transition from it.
    """

    start: Unsigned
    source: Unsigned
    probability: Float
    log_probability: Float

    @classmethod
    def from_matrix(cls, matrix: Float) -> "SparseTransition":
        """Build the lists from a transition array (U, S, S)."""
        rows = matrix.transpose(0, 2, 1).reshape(-1, matrix.shape[2])
        row, source = np.nonzero(rows)
        start = np.zeros(len(rows) + 1, dtype=np.uint64)
        np.cumsum(np.bincount(row, minlength=len(rows)), out=start[1:])
        probability = rows[row, source]
        return cls(start, source.astype(np.uint64), probability, np.log(probability))


@dataclass(frozen=True)
class TransitionModel:
    """p(D_t | D_{t-1}, U_{t-1}): one row-stochastic matrix for each control, eqs. (28)-(29).

    Attributes
    ----------
    matrix : (U, S, S) dimensionless
        ``matrix[u, i, j]`` is the probability to go from state i to state j under control u.
    """

    matrix: Float

    def __post_init__(self) -> None:
        matrix = stochastic_matrix(self.matrix, name="transition[control, state]")
        if matrix.ndim != 3 or matrix.shape[1] != matrix.shape[2]:
            raise InvalidModelError(
                f"transition: expected shape (controls, states, states), got {matrix.shape}"
            )
        object.__setattr__(self, "matrix", matrix)

    @classmethod
    def from_factors(cls, tables: Sequence[Sequence[ArrayLike]]) -> "TransitionModel":
        """Build the joint transition of factors that change independently, given the control.

        Parameters
        ----------
        tables : for each control, for each factor, (levels, levels)
            Row-stochastic; the joint matrix is their Kronecker product in the order of the factors.

        Raises
        ------
        InvalidDistributionError, InvalidModelError
            A table is none of transitions, the controls have other states, or it does not fit in memory.
        """
        joint = []
        for control, factor_tables in enumerate(tables):
            checked = [
                stochastic_matrix(table, name=f"transition of control {control}, factor {factor}")
                for factor, table in enumerate(factor_tables)
            ]
            if not checked or any(t.ndim != 2 or t.shape[0] != t.shape[1] for t in checked):
                raise InvalidModelError(
                    f"control {control}: expected a square table for each factor, "
                    f"got shapes {[table.shape for table in checked]}"
                )
            states = prod(len(table) for table in checked)
            check_fits(
                {
                    f"the transitions of {states} states under {len(tables)} controls": TRANSITION_COPIES
                    * transition_bytes(states, len(tables))
                },
                "take fewer levels or state factors",
            )
            product: Float = checked[0]
            for table in checked[1:]:
                product = np.asarray(np.kron(product, table), dtype=np.float64)
            joint.append(product)
        if len({matrix.shape for matrix in joint}) != 1:
            raise InvalidModelError(
                f"every control needs the same states, got shapes {[m.shape for m in joint]}"
            )
        return cls(np.stack(joint))

    @cached_property
    def sparse(self) -> SparseTransition:
        """The non-zero transitions as lists."""
        return SparseTransition.from_matrix(self.matrix)


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
        (U, S, S).
    """

    states: StateSpace
    controls: tuple[str, ...]
    prior: Float
    transition: TransitionModel

    def __post_init__(self) -> None:
        object.__setattr__(self, "controls", tuple(self.controls))
        if not self.controls or len(set(self.controls)) != len(self.controls):
            raise InvalidModelError(
                f"expected one or more controls with different names, got {self.controls}"
            )
        size = self.states.size
        object.__setattr__(self, "prior", distribution(self.prior, size=size, name="prior"))
        expected = (len(self.controls), size, size)
        if self.transition.matrix.shape != expected:
            raise InvalidModelError(
                f"transition: expected shape {expected} for {len(self.controls)} controls and {size} states, "
                f"got {self.transition.matrix.shape}"
            )

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
        InvalidModelError, InvalidDistributionError
            If a factor, a level or a row of a table is no such thing, or a table of a factor is missing.
        """
        states = StateSpace(tuple(Factor(name, tuple(values)) for name, values in levels.items()))
        given = {"prior": prior, **tables} if prior is not None else dict(tables)
        for control, rows in given.items():
            if set(rows) != set(levels):
                raise InvalidModelError(
                    f"{control}: expected one table for each of the factors {', '.join(levels)}, got "
                    f"{', '.join(rows) or 'none'}"
                )
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
        InvalidDistributionError, InvalidModelError
            If a row is no distribution, or the shape is another one.
        """
        policy = stochastic_matrix(rows, name="policy[state]")
        expected = (self.states.size, len(self.controls))
        if policy.shape != expected:
            raise InvalidModelError(
                f"policy: expected shape {expected} (states, controls), got {policy.shape}"
            )
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
    if level_count < 1 or not 0.0 <= probability <= 1.0:
        raise InvalidModelError(
            f"expected one or more levels and a probability in [0, 1], got {level_count} and {probability}"
        )
    table = np.diag(np.full(level_count, 1.0 - probability))
    table += np.diag(np.full(level_count - 1, probability), 1)
    table[-1, -1] = 1.0
    return stochastic_matrix(table, name="worsening table")


def deterministic_policy(control_index: ArrayLike, control_count: int) -> Float:
    """Return the policy (S, U) that gives each state the control of its index (S,)."""
    index = np.asarray(control_index)
    if index.ndim != 1 or index.dtype.kind not in "iu" or np.any((index < 0) | (index >= control_count)):
        raise InvalidModelError(
            f"expected one control index between 0 and {control_count - 1} for each state, got {index}"
        )
    return stochastic_matrix(np.eye(control_count)[index], name="policy[state]")
