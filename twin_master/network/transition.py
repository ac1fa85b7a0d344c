"""Transitions between states: one table, or the product of tables of factors that move independently.

A table of S states has S² entries, the tables of its factors together a few hundred. What is small is kept as
one table, whose loops are the shortest; what is not, as the tables of the factors, each applied along its own
axis. Distributions, stochastic matrices, the shapes of arrays, and whether they fit in memory, are checked
where they come in.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from math import prod

import numpy as np
from numpy.typing import ArrayLike

from reporting.arrays import Float, Index
from reporting.memory import available_memory
from twin_master.errors import InvalidModelError, TwinMasterError, said
from twin_master.network.kernels import Lists

ROW_SUM_TOLERANCE = 1e-12
"""Largest departure of the sum of a probability distribution from one."""


def stochastic_matrix(rows: ArrayLike, *, name: str) -> Float:
    """Return `rows` as a checked, read-only array of probability distributions along the last axis.

    Parameters
    ----------
    rows : (..., n) dimensionless
        Finite, non-negative, each row summing to one within `ROW_SUM_TOLERANCE`.
    name : str
        What the matrix is, for the error message.

    Raises
    ------
    InvalidModelError
        With the index of the first row that is no distribution.
    """
    matrix = np.array(rows, dtype=np.float64, order="C")
    if matrix.ndim == 0 or matrix.size == 0:
        raise InvalidModelError(said("network.no_rows", name=name, shape=matrix.shape))
    for bad, reason in (
        (~np.isfinite(matrix).all(axis=-1), "holds a value that is not finite"),
        ((matrix < 0.0).any(axis=-1), "holds a negative probability"),
        (np.abs(matrix.sum(axis=-1) - 1.0) > ROW_SUM_TOLERANCE, "does not sum to one"),
    ):
        if np.any(bad):
            where = tuple(int(i) for i in np.argwhere(np.atleast_1d(bad))[0]) if matrix.ndim > 1 else ()
            row = matrix[where]
            label = f"row {where[0] if len(where) == 1 else where}" if where else "the distribution"
            sizes, what = (row.sum(), row.min()), f"{name}: {label} {reason}"
            raise InvalidModelError(said("network.no_distribution", what=what, sizes=sizes))
    matrix.setflags(write=False)
    return matrix


def distribution(probabilities: ArrayLike, *, size: int, name: str) -> Float:
    """Return one checked, read-only probability distribution of length `size`.

    Raises
    ------
    InvalidModelError
        If it has another shape, or does not pass `stochastic_matrix`.
    """
    vector = stochastic_matrix(probabilities, name=name)
    expect_shape(name, vector.shape, size)
    return vector


def expect_shape(
    what: str, shape: Sequence[int], *wanted: int | str, error: type[TwinMasterError] = InvalidModelError
) -> None:
    """Refuse an array of another shape.

    Parameters
    ----------
    what : str
        What it is, for the sentence.
    shape : tuple of int
        That it has.
    *wanted : int or str
        Lengths of its axes; a word stands for any length.
    error : type
        What is raised.
    """
    pairs = zip(wanted, shape, strict=False)
    if len(shape) != len(wanted) or any(isinstance(length, int) and length != has for length, has in pairs):
        told = ", ".join(map(str, wanted)) + "," * (len(wanted) == 1)
        raise error(f"expected {what} of shape ({told}), got {tuple(shape)}")


def expect_controls(index: int | Index, count: int) -> None:
    """Refuse indices of controls, an array of any shape, that are none of `count`."""
    low, high = np.min(index, initial=0), np.max(index, initial=0)
    if low < 0 or high >= count:
        raise InvalidModelError(f"expected control indices between 0 and {count - 1}, got {low} to {high}")


NUMBER = 8
"""Bytes of a number."""
TRANSITION_COPIES = 3
"""The tables of the controls, the array of all of them, and the checked copy."""
JOINT_NON_ZEROS = 512
"""Non-zero transitions of a control up to which one table is used: it is applied in some microseconds."""


def check_fits(parts: Mapping[str, float], advice: str) -> None:
    """Check that arrays fit in memory together.

    Parameters
    ----------
    parts : dict of str to float
        What is to be built, in words with its numbers, and its size [bytes].
    advice : str
        What makes it smaller.

    Raises
    ------
    InvalidModelError
        They do not; the sentence has all sizes.
    """
    needed, there = sum(parts.values()), available_memory()
    if needed > there:
        listed = ", ".join(f"{size / 1e9:.3g} GB for {what}" for what, size in parts.items())
        sizes = [f"{size / 1e9:.3g} GB" for size in (needed, there)]
        raise InvalidModelError(said("network.memory", listed=listed, sizes=sizes, advice=advice))


def transition_bytes(states: int, controls: int) -> float:
    """Return the size of one table of transitions (U, S, S) [bytes]."""
    return float(NUMBER * controls * states * states)


def predecessor_lists(blocks: Sequence[Float]) -> Lists:
    """Return the predecessors of each level of blocks (U, L, L), one block after the other, for the loops.

    Unsigned indices spare the loops the test for negative ones.
    """
    rows = [block.transpose(0, 2, 1).reshape(-1, block.shape[1]) for block in blocks]
    start = np.cumsum([0, *np.concatenate([np.count_nonzero(own, axis=1) for own in rows])])
    probability = np.concatenate([own[own != 0.0] for own in rows])
    return (
        np.array([block.shape[1] for block in blocks], dtype=np.int64),
        np.cumsum([0, *map(len, rows)])[:-1],
        start.astype(np.uint64),
        np.concatenate([np.nonzero(own)[1] for own in rows]).astype(np.uint64),
        probability,
        np.log(probability),
    )


@dataclass(frozen=True)
class TransitionModel:
    """p(D_t | D_{t-1}, U_{t-1}), row-stochastic for each control: Kapteyn et al. 2021, eqs. (28)-(29).

    The joint state is that of the blocks in C order; its transition is the product of theirs.

    Attributes
    ----------
    blocks : tuple of (U, L, L), dimensionless
        ``block[u, i, j]`` is the probability to go from level i to level j of the block under control u. A
        single block is the table (U, S, S) of all states.
    """

    blocks: tuple[Float, ...]

    def __post_init__(self) -> None:
        checked = tuple(stochastic_matrix(block, name="transition[control, state]") for block in self.blocks)
        for block in checked:
            expect_shape("a transition", block.shape, "controls", block.shape[-1], block.shape[-1])
        if len({len(block) for block in checked}) != 1:
            raise InvalidModelError(said("network.blocks", counts=[len(block) for block in checked]))
        object.__setattr__(self, "blocks", checked)

    @classmethod
    def from_factors(cls, tables: Sequence[Sequence[ArrayLike]]) -> "TransitionModel":
        """Build the joint transition of factors that change independently, given the control.

        Parameters
        ----------
        tables : for each control, for each factor, (levels, levels)
            Row-stochastic; the joint matrix is their Kronecker product in the order of the factors.

        Raises
        ------
        InvalidModelError
            A table is none of transitions, or the controls have other states.
        """
        checked = [
            [
                stochastic_matrix(table, name=f"transition of control {control}, factor {factor}")
                for factor, table in enumerate(factor_tables)
            ]
            for control, factor_tables in enumerate(tables)
        ]
        shapes = {tuple(table.shape for table in row) for row in checked}
        if len(shapes) != 1 or not all(shapes) or any(s != s[:1] * 2 for row in shapes for s in row):
            raise InvalidModelError(said("network.squares", shapes=sorted(shapes)))
        factors = [np.stack(factor) for factor in zip(*checked, strict=True)]
        counts = [np.count_nonzero(factor, axis=(1, 2)) for factor in factors]
        small = np.prod(counts, axis=0, dtype=np.float64).max() <= JOINT_NON_ZEROS
        return cls((_joint(factors),) if small else tuple(factors))

    @property
    def shape(self) -> tuple[int, int, int]:
        """Numbers of controls, states and states (U, S, S)."""
        size = prod(block.shape[1] for block in self.blocks)
        return len(self.blocks[0]), size, size

    @property
    def is_product(self) -> bool:
        """Whether it is the product of several blocks."""
        return len(self.blocks) > 1

    @cached_property
    def matrix(self) -> Float:
        """The table of all states (U, S, S).

        Raises
        ------
        InvalidModelError
            It does not fit in memory.
        """
        if not self.is_product:
            return self.blocks[0]
        controls, states, _ = self.shape
        check_fits(
            {
                f"the table of {states} states under {controls} controls": TRANSITION_COPIES
                * transition_bytes(states, controls)
            },
            "take fewer levels or state factors, or apply the transition instead",
        )
        table = _joint(self.blocks)
        table.setflags(write=False)
        return table

    @cached_property
    def forward_lists(self) -> Lists:
        """The predecessors of each level of each block."""
        return predecessor_lists(self.blocks)

    @cached_property
    def backward_lists(self) -> Lists:
        """The successors of each level of each block."""
        return predecessor_lists([block.transpose(0, 2, 1) for block in self.blocks])

    def row(self, control: int, state: int) -> Float:
        """Return p(D_t | D_{t-1} = state, control): (S,)."""
        levels = np.unravel_index(state, [block.shape[1] for block in self.blocks])
        return _kronecker(block[control, level] for block, level in zip(self.blocks, levels, strict=True))

    def rows(self, control: Index, state: Index) -> Float:
        """Return p(D_t | D_{t-1} = state, control) of N pairs (N,) of control and state: (N, S)."""
        levels = np.unravel_index(state, [block.shape[1] for block in self.blocks])
        result = np.ones((len(state), 1))
        for block, level in zip(self.blocks, levels, strict=True):
            following = block[control, level]
            states = result.shape[1] * following.shape[1]
            result = (result[:, :, None] * following[:, None, :]).reshape(len(state), states)
        return result

    def forward(self, control: int, belief: Float) -> Float:
        """Return beliefs (..., S) one step later, in the linear domain."""
        if not self.is_product:
            return np.asarray(belief @ self.blocks[0][control])
        return self._applied([block[control].T for block in self.blocks], belief)

    def expected(self, control: int, value: Float) -> Float:
        """Return the mean of a function of the state one step later, from each state: (S,) -> (S,)."""
        if not self.is_product:
            return np.asarray(self.blocks[0][control] @ value)
        return self._applied([block[control] for block in self.blocks], value)

    def _applied(self, matrices: Sequence[Float], vector: Float) -> Float:
        shape, inner = vector.shape, vector.shape[-1]
        for matrix in matrices:
            inner //= len(matrix)
            vector = np.matmul(matrix, vector.reshape(-1, len(matrix), inner)).ravel()
        return vector.reshape(shape)


def _kronecker(arrays: Iterable[Float]) -> Float:
    return reduce(lambda first, second: np.asarray(np.kron(first, second)), arrays)


def _joint(factors: Sequence[Float]) -> Float:
    return np.stack([_kronecker(tables) for tables in zip(*factors, strict=True)])
