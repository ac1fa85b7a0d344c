"""Transitions between states: one table, or the product of tables of independent factors.

A table of S states has S² entries, while the tables of its factors have a few hundred together. If
the joint table has few non-zero entries, it is kept as one table, whose loops are the shortest.
Otherwise the tables of the factors are kept, and each is applied along its own axis.

Distributions, stochastic matrices, the shapes of arrays, and whether arrays fit in memory are
checked here.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from itertools import chain
from math import prod

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reporting.arrays import Float, Index, nan_where_masked
from reporting.system.memory import available_memory
from reporting.words import comma_list
from twin_master.errors import InvalidModelError, TwinMasterError
from twin_master.network.kernels import PredecessorLists
from twin_master.scenario.tables import ROW_SUM_TOLERANCE

BYTES_OF_NUMBER = 8
"""Size of a number in double precision [bytes]."""
TRANSITION_COPIES = 3
"""Copies of a joint table while it is built: of each control, of all of them, and the checked."""
MAX_JOINT_NON_ZEROS = 512
"""Largest number of non-zero transitions of a control for which one joint table is kept.

With so few, the loop over one table is faster than one loop for each factor: a transition takes
some microseconds."""


def stochastic_matrix(rows: ArrayLike, *, name: str) -> Float:
    """Check rows of probabilities, and return them as a read-only array.

    Parameters
    ----------
    rows : (..., n) array
        Distributions along the last axis: finite, not negative, and each with a sum of one within
        `ROW_SUM_TOLERANCE`.
    name : str
        The noun of the matrix, for the message.

    Raises
    ------
    InvalidModelError
        If a row is not a distribution; the message has the index of the first.
    """
    matrix = np.array(nan_where_masked(rows), order="C")
    if matrix.ndim == 0 or matrix.size == 0:
        raise InvalidModelError(
            f"{name} must be rows of probabilities, but it has the shape {matrix.shape}"
        )
    is_infinite = np.asarray(~np.isfinite(matrix).all(axis=-1))
    _check_rows(matrix, is_infinite, name, "holds a value that is not finite")
    is_negative = np.asarray((matrix < 0.0).any(axis=-1))
    _check_rows(matrix, is_negative, name, "holds a negative probability")
    misses_one = np.abs(matrix.sum(axis=-1) - 1.0) > ROW_SUM_TOLERANCE
    _check_rows(matrix, misses_one, name, "does not sum to one")
    matrix.setflags(write=False)
    return matrix


def _check_rows(matrix: Float, is_wrong: NDArray[np.bool_], name: str, fault: str) -> None:
    """Refuse a matrix (..., n) if `is_wrong` (...) is true for a row; name the first such row."""
    if not np.any(is_wrong):
        return
    if matrix.ndim == 1:
        row = matrix
        label = "the distribution"
    else:
        position = tuple(int(i) for i in np.argwhere(is_wrong)[0])
        row = matrix[position]
        label = f"row {position[0] if len(position) == 1 else position}"
    raise InvalidModelError(
        f"{name}: {label} {fault} (sum {row.sum():.15g}, smallest {row.min():.6g}); every row must "
        "be non-negative and sum to one within 1e-12"
    )


def distribution(probabilities: ArrayLike, *, size: int, name: str) -> Float:
    """Return one checked, read-only probability distribution of length `size`.

    Raises
    ------
    InvalidModelError
        If it has another shape, or does not pass `stochastic_matrix`.
    """
    vector = stochastic_matrix(probabilities, name=name)
    check_shape(name, vector.shape, size)
    return vector


def check_shape(
    what: str,
    shape: Sequence[int],
    *expected: int | str,
    error: type[TwinMasterError] = InvalidModelError,
) -> None:
    """Refuse an array whose shape is not the expected one.

    Parameters
    ----------
    what : str
        The noun of the array, for the message.
    shape : tuple of int
        The shape of the array.
    *expected : int or str
        The expected length of each axis; a word, such as "draws", stands for any length.
    """
    pairs = zip(expected, shape, strict=False)
    differs = any(
        isinstance(expected_length, int) and expected_length != length
        for expected_length, length in pairs
    )
    if len(shape) != len(expected) or differs:
        lengths = ", ".join(map(str, expected))
        if len(expected) == 1:
            lengths += ","  # as Python writes a tuple of one entry
        raise error(f"{what} must have the shape ({lengths}), but the shape is {tuple(shape)}")


def checked_controls(control_index: ArrayLike, count: int) -> Index:
    """Return indices of controls, of any shape, as whole numbers between 0 and count - 1.

    Raises
    ------
    InvalidModelError
        If an index is masked, is no whole number, or is out of range.
    """
    numbers = nan_where_masked(control_index)
    is_whole = numbers == np.round(numbers)  # false for NaN as well
    if not np.all(is_whole):
        raise InvalidModelError(
            "the indices of controls must be whole numbers, but one is "
            f"{numbers[~is_whole].flat[0]} (NaN stands for a masked one)"
        )
    low = np.min(numbers, initial=0)
    high = np.max(numbers, initial=0)
    if low < 0 or high >= count:
        raise InvalidModelError(
            f"the indices of controls must be from 0 to {count - 1}, but they are from {low:.0f} "
            f"to {high:.0f}"
        )
    return np.array(numbers, dtype=np.int64, order="C")


def checked_beliefs(beliefs: ArrayLike) -> Float:
    """Return beliefs (..., S) as an array of floats whose probabilities are all finite.

    Raises
    ------
    InvalidModelError
        If a probability is masked or not finite.
    """
    probabilities = nan_where_masked(beliefs)
    is_finite = np.isfinite(probabilities)
    if not np.all(is_finite):
        raise InvalidModelError(
            "a belief must have the probability of each state, but one is "
            f"{probabilities[~is_finite].flat[0]} (NaN stands for a masked one)"
        )
    return probabilities


def check_fits(parts: Mapping[str, float], advice: str) -> None:
    """Refuse arrays that together need more memory than is available.

    Parameters
    ----------
    parts : dict of str to float
        The size of each array [bytes], by a description in words.
    advice : str
        The advice on how to make the arrays smaller, for the message.

    Raises
    ------
    InvalidModelError
        If the arrays do not fit in memory; the message lists their sizes.
    """
    needed_memory = sum(parts.values())
    available = available_memory()
    if needed_memory > available:
        list_of_sizes = ", ".join(f"{size / 1e9:.3g} GB for {what}" for what, size in parts.items())
        raise InvalidModelError(
            f"this does not fit in memory: {list_of_sizes}, together {needed_memory / 1e9:.3g} GB, "
            f"and {available / 1e9:.3g} GB are left: {advice}."
        )


def transition_bytes(states: int, controls: int) -> float:
    """Return the size of a table of transitions of S states under U controls, (U, S, S) [bytes]."""
    return float(BYTES_OF_NUMBER * controls * states * states)


def predecessor_lists(blocks: Sequence[Float]) -> PredecessorLists:
    """Return the non-zero transitions of several blocks in one sparse matrix (format CSR).

    The matrix has a row for each block, control and next level, in this order. The row lists the
    levels from which the next level is reached in one step. `first_row` is the index of the first
    row of each block, and `start` that of the first entry of each row.

    Parameters
    ----------
    blocks : sequence of (U, L, L) array
        For each block p(next level | level) under each of U controls; the number L of levels may
        differ from block to block.
    """
    level_counts = [block.shape[1] for block in blocks]
    rows_per_block = []
    entries_per_row = []  # for each block (U L,)
    predecessors_by_block = []  # for each block one per non-zero entry, as the probabilities
    probabilities_by_block = []
    for block, level_count in zip(blocks, level_counts, strict=True):
        # (U L, L): a row for each control and next level, a column for each level before
        table = block.transpose(0, 2, 1).reshape(-1, level_count)
        row, predecessor_level = np.nonzero(table)
        rows_per_block.append(len(table))
        entries_per_row.append(np.count_nonzero(table, axis=1))
        predecessors_by_block.append(predecessor_level)
        probabilities_by_block.append(table[row, predecessor_level])
    first_row = np.cumsum([0, *rows_per_block])[:-1]
    start = np.cumsum([0, *np.concatenate(entries_per_row)])
    predecessor = np.concatenate(predecessors_by_block)
    probability = np.concatenate(probabilities_by_block)
    # Indices are unsigned, so that the compiled loops need not test for negative ones.
    return PredecessorLists(
        levels=np.array(level_counts, dtype=np.int64),
        first_row=first_row,
        start=start.astype(np.uint64),
        predecessor=predecessor.astype(np.uint64),
        probability=probability,
        log_probability=np.log(probability),
    )


@dataclass(frozen=True)
class TransitionModel:
    """p(D_t | D_{t-1}, U_{t-1}), row-stochastic for each control: Kapteyn et al. 2021, (28)-(29).

    The joint state is that of the blocks in C order; its transition is the product of theirs.

    Attributes
    ----------
    blocks : tuple of (U, L, L) array
        ``block[u, i, j]`` is the probability to go from level i to level j of the block under
        control u. A single block is the table (U, S, S) of all states.
    """

    blocks: tuple[Float, ...]

    def __post_init__(self) -> None:
        checked = tuple(
            stochastic_matrix(block, name="transition[control, state]") for block in self.blocks
        )
        for block in checked:
            levels = block.shape[-1]
            check_shape("a transition", block.shape, "controls", levels, levels)
        control_counts = [len(block) for block in checked]
        if len(set(control_counts)) != 1:
            raise InvalidModelError(
                "the blocks of a transition must have the same controls, but their numbers of "
                f"controls are {comma_list(control_counts)}"
            )
        object.__setattr__(self, "blocks", checked)

    @classmethod
    def from_factors(cls, tables: Sequence[Sequence[ArrayLike]]) -> "TransitionModel":
        """Build the joint transition of factors that change independently, given the control.

        Parameters
        ----------
        tables : sequence of sequence of (L, L) array
            For each control and each factor its row-stochastic table. The joint matrix is their
            Kronecker product in the order of the factors.

        Raises
        ------
        InvalidModelError
            If a table is not a square, row-stochastic matrix, if there are no factors, or if the
            factors differ in number or size between controls.
        """
        tables_by_control = []
        for control, factor_tables in enumerate(tables):
            checked_tables = [
                stochastic_matrix(table, name=f"transition of control {control}, factor {index}")
                for index, table in enumerate(factor_tables)
            ]
            tables_by_control.append(checked_tables)

        # All controls need the same shapes: one tuple of shapes, with an entry for each factor.
        distinct_shapes = {
            tuple(table.shape for table in control_tables) for control_tables in tables_by_control
        }
        have_same_shapes = len(distinct_shapes) == 1
        have_factors = all(len(shapes) > 0 for shapes in distinct_shapes)
        are_square = all(
            len(shape) == 2 and shape[0] == shape[1]
            for shape in chain.from_iterable(distinct_shapes)
        )
        if not (have_same_shapes and have_factors and are_square):
            raise InvalidModelError(
                "every control needs one square table for each factor, of the same size under all "
                f"controls, but the tables have the shapes {sorted(distinct_shapes)}"
            )

        tables_by_factor = zip(*tables_by_control, strict=True)
        blocks = [np.stack(control_tables) for control_tables in tables_by_factor]  # (U, L, L)
        # The non-zeros of a Kronecker product are the product of those of its factors.
        non_zeros = [np.count_nonzero(block, axis=(1, 2)) for block in blocks]  # (U,) of each
        joint_non_zeros = np.prod(non_zeros, axis=0, dtype=np.float64)  # (U,)
        # A joint table with few non-zeros has the shortest loops. A larger one takes much more
        # memory and time than the factors, each of which is applied along its own axis.
        if joint_non_zeros.max() <= MAX_JOINT_NON_ZEROS:
            return cls((_joint_table(blocks),))
        return cls(tuple(blocks))

    @property
    def shape(self) -> tuple[int, int, int]:
        """Numbers of controls, states before and states after a transition (U, S, S)."""
        size = prod(block.shape[1] for block in self.blocks)
        return len(self.blocks[0]), size, size

    @property
    def is_product(self) -> bool:
        """Whether the transition is the product of several blocks."""
        return len(self.blocks) > 1

    @cached_property
    def matrix(self) -> Float:
        """The table of all transitions: control, state before, state after (U, S, S).

        Raises
        ------
        InvalidModelError
            If it does not fit in memory.
        """
        if not self.is_product:
            return self.blocks[0]
        controls, states, _ = self.shape
        size = TRANSITION_COPIES * transition_bytes(states, controls)
        check_fits(
            {f"the table of {states} states under {controls} controls": size},
            "take fewer levels or state factors, or apply the transition instead",
        )
        table = _joint_table(self.blocks)
        table.setflags(write=False)
        return table

    @cached_property
    def forward_lists(self) -> PredecessorLists:
        """The predecessors of each level of each block, to move a belief forward in time."""
        return predecessor_lists(self.blocks)

    @cached_property
    def backward_lists(self) -> PredecessorLists:
        """The successors of each level of each block, to move a value backward in time."""
        return predecessor_lists([block.transpose(0, 2, 1) for block in self.blocks])

    def row(self, control: int, state: int) -> Float:
        """Return the distribution p(D_t | D_{t-1} = state, control) of the next state: (S,)."""
        levels = np.unravel_index(state, [block.shape[1] for block in self.blocks])
        return kronecker_product(
            block[control, level] for block, level in zip(self.blocks, levels, strict=True)
        )

    def rows(self, control: Index, state: Index) -> Float:
        """Return the distribution of the next state for N pairs of control and state: (N, S)."""
        levels = np.unravel_index(state, [block.shape[1] for block in self.blocks])
        # Kronecker product over the blocks, for all N pairs at once.
        probability = np.ones((len(state), 1))
        for block, level in zip(self.blocks, levels, strict=True):
            block_probability = block[control, level]
            states = probability.shape[1] * block_probability.shape[1]
            products = probability[:, :, None] * block_probability[:, None, :]
            probability = products.reshape(len(state), states)
        return probability

    def forward(self, control: int, belief: Float) -> Float:
        """Return beliefs (..., S) over the S states one step later, without logarithms."""
        if not self.is_product:
            return np.asarray(belief @ self.blocks[0][control])
        return _apply_along_axes([block[control].T for block in self.blocks], belief)

    def expected_value(self, control: int, value: Float) -> Float:
        """Return the mean of a function (S,) of the state one step later, from each state: (S,)."""
        if not self.is_product:
            return np.asarray(self.blocks[0][control] @ value)
        return _apply_along_axes([block[control] for block in self.blocks], value)


def _apply_along_axes(matrices: Sequence[Float], vectors: Float) -> Float:
    """Return vectors (..., S) with a matrix (L, L) applied along each axis of the joint state.

    The joint state is in C order: the last axis varies fastest.
    """
    shape = vectors.shape
    inner_count = shape[-1]
    for matrix in matrices:
        inner_count //= len(matrix)  # joint levels of the axes after this one
        vectors = np.matmul(matrix, vectors.reshape(-1, len(matrix), inner_count)).ravel()
    return vectors.reshape(shape)


def kronecker_product(arrays: Iterable[Float]) -> Float:
    """Return the Kronecker product of arrays, from the first to the last."""
    return reduce(lambda product, array: np.asarray(np.kron(product, array)), arrays)


def _joint_table(factors: Sequence[Float]) -> Float:
    """Return the joint table (U, S, S) of factors (U, L, L)."""
    return np.stack([kronecker_product(tables) for tables in zip(*factors, strict=True)])
