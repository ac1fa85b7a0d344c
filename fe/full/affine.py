"""A wing as affine operators: matrices that are sums of a few, with coefficients of health and masses."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from fe.runtime.state import Losses, losses_of

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class AffineSystem:
    """Affine model of a wing on its n free unknowns; `operators` makes that of the finite elements.

    Attributes
    ----------
    regions : tuple of str
        Names of the K damage regions.
    stiffness_terms : tuple of csr (n, n)
        Skin without the damage regions, each of these, and the rest with the root springs [N/m].
    mass_terms : tuple of csr (n, n)
        Structure [kg]; 1 kg in each servo; 1 kg in the pitot [1].
    load_lift : (n,) N
        Load of a turn at load factor 1.
    load_tip : (n,) 1
        Upward load of 1 N at the place of the static test; as a row, the displacement there.
    gauge_output : csr (gauges, n) 1/m
        Strain of each gauge, positive in compression (upper skin under positive lift), dimensionless.
    tip_displacement_output : (n,) 1
        Upward displacement at the tip, on the chord line of the static test.
    expansion : csr (full, n)
        Free unknowns to the displacements of all nodes.
    design_hash : str
        Hash of the design.
    """

    regions: tuple[str, ...]
    stiffness_terms: tuple[sparse.csr_array, ...]
    mass_terms: tuple[sparse.csr_array, ...]
    load_lift: FloatArray
    load_tip: FloatArray
    gauge_output: sparse.csr_array
    tip_displacement_output: FloatArray
    expansion: sparse.csr_array
    design_hash: str

    @property
    def unknowns(self) -> int:
        """Number n of free unknowns."""
        return len(self.load_lift)

    @property
    def displacement_output(self) -> FloatArray:
        """Upward displacement (n,) at the place of the static test [1]."""
        return self.load_tip

    def theta(self, young_modulus_factor: float, stiffness_loss: Losses) -> FloatArray:
        """Coefficients (K + 2,) of the stiffness terms at e and the losses z."""
        loss = losses_of(stiffness_loss, self.regions)
        return np.array([young_modulus_factor, *(1.0 - z for z in loss), 1.0])

    @staticmethod
    def mass_theta(servo_mass: float, pitot_mass: float) -> FloatArray:
        """Coefficients (3,) of the mass terms at masses [kg] of one servo and of the pitot."""
        return np.array([1.0, servo_mass, pitot_mass])

    def stiffness(self, young_modulus_factor: float = 1.0, stiffness_loss: Losses = ()) -> sparse.csr_array:
        """Stiffness (n, n) [N/m] at e and the losses z."""
        return affine_sum(self.theta(young_modulus_factor, stiffness_loss), self.stiffness_terms)

    def mass(self, servo_mass: float, pitot_mass: float) -> sparse.csr_array:
        """Mass (n, n) [kg] at the masses [kg] of one servo and of the pitot."""
        return affine_sum(self.mass_theta(servo_mass, pitot_mass), self.mass_terms)


def affine_sum(coefficients: ArrayLike, terms: tuple[Any, ...]) -> Any:
    """Return the sparse matrix sum of `coefficients` times `terms`."""
    factors = np.asarray(coefficients, dtype=np.float64)
    total = factors[0] * terms[0]
    for factor, term in zip(factors[1:], terms[1:], strict=True):
        total = total + factor * term
    return total.tocsr()


class AffineSum:
    """The sums of coefficients times the same sparse terms, the places of their entries found once.

    Five times faster than `affine_sum`; the entries of a row may stand in another order.

    Parameters
    ----------
    terms : tuple of csr (n, n)
        The terms.
    """

    def __init__(self, terms: tuple[Any, ...]) -> None:
        self._shape = terms[0].shape
        union = sum((abs(term) for term in terms[1:]), abs(terms[0])).tocsr()
        union.sort_indices()
        self._indptr, self._indices = union.indptr, union.indices
        keys = self._keys(union)
        self._parts = [
            (np.searchsorted(keys, self._keys(term)).astype(np.int32), term.data)
            for term in map(_without_doubles, terms)
        ]

    def matrix(self, coefficients: ArrayLike) -> sparse.csr_array:
        """Return the sum; its arrays of places are shared with all others."""
        data = np.zeros(len(self._indices))
        for factor, (places, values) in zip(np.asarray(coefficients), self._parts, strict=True):
            data[places] += factor * values
        return sparse.csr_array((data, self._indices, self._indptr), shape=self._shape)

    @staticmethod
    def _keys(term: sparse.csr_array) -> NDArray[np.int64]:
        """Return the number of each entry, row by row."""
        rows = np.repeat(np.arange(term.shape[0], dtype=np.int64), np.diff(term.indptr))
        return np.asarray(rows * term.shape[1] + term.indices)


def _without_doubles(term: Any) -> sparse.csr_array:
    """Return a matrix whose entries stand once each."""
    found = term.tocsr()
    if not found.has_canonical_format:
        found = found.copy()
        found.sum_duplicates()
    return found
