"""Offline: make a `ReducedModel` from the full model, static part by a certified greedy search (pyMOR).

The method and what it reaches are in `docs/reduced_model.md`.
"""

import itertools
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
from pymor.algorithms.greedy import WeakGreedySurrogate, weak_greedy
from pymor.core.exceptions import ExtensionError
from pymor.core.logger import set_log_levels

from fe.full.affine import AffineSystem, affine_sum
from fe.full.subspace import (
    Norm,
    OrthonormalBasis,
    conjugate_gradients,
    triangular_factors,
)
from fe.runtime.errors import ReductionError
from fe.runtime.reduced import ReducedModel

from .compression import compressed, fewest_directions, relative_bound
from .modal_basis import ModalData, reduce_modes
from .settings import ReductionSettings, loss_splits, remaining_levels, training_set

FloatArray = npt.NDArray[np.float64]

SEARCH_MARGIN = 0.5
"""The search goes on to this fraction of the tolerance, so that its basis can be compressed after."""
DUAL_TOLERANCE = 0.05
"""Relative residual of the approximate dual solutions at their own anchors."""
FIRST_TOLERANCE, SNAPSHOT_TOLERANCE = 1e-10, 1e-6
"""Relative residual of the first full solutions and of the others."""
ROUNDING_FACTOR, LEAST_ROUNDING = 8.0, 5e-6
"""Rounding allowance as a multiple of the difference seen at the first full solutions, and its least value:
with condition numbers of 1e10, full solutions differ by 1e-6 among themselves."""


class Stage(Protocol):
    """One stretch of work under way."""

    def advance(self, amount: int = 1, detail: str | None = None) -> None:
        """Report `amount` more parts done."""


class Progress(Protocol):
    """Where the build reports how far it is; `reporting.progress` has implementations."""

    def stage(
        self, description: str, total: int | None = None, unit: str = ""
    ) -> AbstractContextManager[Stage]:
        """Open a stretch of work of `total` parts."""


@contextmanager
def stage_of(progress: Progress | None, description: str, total: int | None = None) -> Iterator[Stage]:
    """Open a stretch of work, silent without `progress`."""
    if progress is None:
        yield _Silent()
    else:
        with progress.stage(description, total) as stage:
            yield stage


class _Silent:
    def advance(self, amount: int = 1, detail: str | None = None) -> None:
        """Do nothing."""


@dataclass(frozen=True)
class Reduction:
    """A reduced model with the bases that made it.

    Attributes
    ----------
    model : ReducedModel
        What is evaluated online.
    static_basis : (n, N) ndarray
        Static basis vectors, on the unknowns of the full model.
    modal_basis : (n, Nm) ndarray
        Modal basis vectors.
    snapshots : tuple of tuple
        Parameters (e, z1, ...) of the full solutions, in the order of the search.
    bound_history : tuple of float
        Largest relative bound on the training set before each of them and at the end.
    """

    model: ReducedModel
    static_basis: FloatArray
    modal_basis: FloatArray
    snapshots: tuple[tuple[float, ...], ...]
    bound_history: tuple[float, ...]


@dataclass(frozen=True)
class _DualData:
    """Approximate dual solutions: products with X (A, n, G + 1) and factors of their residuals."""

    products: FloatArray
    factors: FloatArray


class _StaticReduction:
    """State of the greedy search; hands `ReducedModel`s to the bound and snapshots to the basis."""

    def __init__(
        self,
        system: AffineSystem,
        settings: ReductionSettings,
        norm: Norm,
        reference: FloatArray,
        advance: Callable[[int, str], object],
    ) -> None:
        self.advance = advance
        self.system, self.settings, self.norm, self.reference = system, settings, norm, reference
        self.counts = settings.anchors(len(system.regions))
        self.loads = np.stack((system.load_lift, system.load_tip), axis=1)
        self.outputs = np.concatenate(
            (
                np.asarray(system.gauge_output.T.toarray()),
                np.asarray(system.tip_displacement_output)[:, np.newaxis],
            ),
            axis=1,
        )
        n = len(system.load_lift)
        self.basis = OrthonormalBasis(n, norm, drop=1e-7)
        self.images = [
            np.empty((n, 0)) for _ in system.stiffness_terms
        ]  # stiffness terms times basis vectors
        self.rounding = 0.0
        self.residual_basis = OrthonormalBasis(n, norm, drop=1e-8, functionals=True)
        self.residual_basis.extend(norm.riesz(self.loads), self.loads)
        self.dual = self._approximate_duals()
        self.snapshots: list[tuple[float, ...]] = []

    def _approximate_duals(self) -> _DualData:
        """Solve the dual problems at the anchors, and prepare the norms of their residuals elsewhere."""
        system, settings = self.system, self.settings
        anchors = list(
            itertools.product(*(remaining_levels(settings.stiffness_loss, count) for count in self.counts))
        )
        terms, (n, count) = len(system.stiffness_terms), self.outputs.shape
        products = np.empty((len(anchors), n, count))
        factors = np.empty((len(anchors), count, terms, terms))
        at_reference = self.norm.riesz(self.outputs)
        for number, levels in enumerate(anchors):
            theta = np.array((self.reference[0], *levels, 1.0))
            # a rough solution will do: the norm of what it leaves is computed, not assumed
            dual = conjugate_gradients(
                affine_sum(theta, system.stiffness_terms),
                self.norm,
                self.outputs,
                at_reference,
                tolerance=DUAL_TOLERANCE,
            )
            images = [np.asarray(term @ dual) for term in system.stiffness_terms]
            lifted = [self.norm.riesz(image) for image in images[:-1]]
            # X^-1 K_base dual, since X is the sum of all terms at the reference
            base = dual - sum(t * part for t, part in zip(self.reference, lifted, strict=True))
            factors[number] = triangular_factors(
                np.stack((at_reference - base, *lifted), axis=2),
                np.stack((self.outputs - images[-1], *images[:-1]), axis=2),
            )
            products[number] = self.norm.product(dual)
            self.advance(1, "dual solutions")
        return _DualData(products, factors)

    def add_snapshot(self, parameters: tuple[float, ...]) -> None:
        """Solve the full model for both loads and extend the bases."""
        e, *losses = parameters
        theta = np.array((e, *(1.0 - z for z in losses), 1.0))
        matrix = affine_sum(theta, self.system.stiffness_terms)
        start = np.zeros_like(self.loads)
        if self.basis.size:
            image = sum(t * k for t, k in zip(theta, self.images, strict=True))
            start = self.basis.vectors @ np.linalg.solve(
                self.basis.vectors.T @ image, self.basis.vectors.T @ self.loads
            )
        # a basis vector may be rough, since errors are bounded by residuals; the first one measures rounding
        tolerance = SNAPSHOT_TOLERANCE if self.snapshots else FIRST_TOLERANCE
        solution = conjugate_gradients(matrix, self.norm, self.loads, start, tolerance=tolerance)
        before = self.basis.size
        self.basis.extend(solution, self.norm.product(solution))
        new = self.basis.vectors[:, before:]
        if not new.shape[1]:
            raise ExtensionError  # rounding is reached; what the search reached is judged after it
        images = [np.asarray(term @ new) for term in self.system.stiffness_terms]
        self.images = [np.concatenate(pair, axis=1) for pair in zip(self.images, images, strict=True)]
        varying = np.concatenate(images[:-1], axis=1)
        self.residual_basis.extend(
            np.concatenate((new, self.norm.riesz(varying)), axis=1),
            np.concatenate((self.basis.products[:, before:], varying), axis=1),
        )
        if not self.snapshots:
            self.rounding = self._rounding(theta, self.outputs.T @ solution)
        self.snapshots.append(parameters)

    def _rounding(self, theta: FloatArray, wanted: FloatArray) -> float:
        """Return the relative difference of outputs between full solutions and the basis that holds them."""
        basis = self.basis.vectors
        image = sum(t * k for t, k in zip(theta, self.images, strict=True))
        coordinates = np.linalg.solve(basis.T @ image, basis.T @ self.loads)
        difference = np.abs(self.outputs.T @ (basis @ coordinates) - wanted)
        return max(
            float((difference[rows].max(axis=0) / np.abs(wanted[rows]).max(axis=0)).max())
            for rows in (slice(0, -1), slice(-1, None))
        )

    def model(self, modal: ModalData) -> ReducedModel:
        """Return the reduced model of the present bases."""
        basis, residual, settings = self.basis.vectors, self.residual_basis.vectors, self.settings
        stiffness = np.stack([basis.T @ image for image in self.images])
        return ReducedModel(
            design_hash=self.system.design_hash,
            region_names=" ".join(self.system.regions),
            validity_box=settings.validity_box(len(self.system.regions)),
            static_stiffness=0.5 * (stiffness + stiffness.transpose(0, 2, 1)),
            static_load=self.loads.T @ basis,
            static_output=self.outputs.T @ basis,
            bound_reference=self.reference,
            residual_load=residual.T @ self.loads,
            residual_stiffness=np.stack([residual.T @ image for image in self.images], axis=1),
            # |sum c_q a_j d_qj| <= |c| |a| |d|; plus rounding
            residual_allowance=self._largest_coefficients()
            * float(np.sqrt(self.residual_basis.dropped_square))
            + 1e-7,
            rounding_allowance=max(ROUNDING_FACTOR * self.rounding, LEAST_ROUNDING),
            dual_counts=np.array(self.counts, dtype=np.int64),
            dual_split=np.concatenate([loss_splits(settings.stiffness_loss, count) for count in self.counts]),
            dual_correction=np.swapaxes(self.dual.products, 1, 2) @ residual,
            dual_residual=self.dual.factors,
            modal_stiffness=modal.stiffness,
            modal_mass=modal.mass,
            modal_load=self.loads.T @ modal.basis,
            modal_output=self.outputs.T @ modal.basis,
            cross_mass=np.stack([(modal.basis.T @ image) for image in self._mass_images()]),
            flapwise_reference=modal.flapwise_reference,
            mode_count=modal.mode_count,
        )

    def _largest_coefficients(self) -> float:
        """Return the largest length of (1, theta - reference), by which parts of a residual are multiplied.

        The residual is f - X u - sum (theta_q - reference_q) K_q u, and the basis was offered X u and K_q u.
        """
        e, *losses = self.settings.validity_box(len(self.system.regions))[: len(self.reference)]
        ends = np.array((e, *(1.0 - z for z in losses)))
        farthest = np.abs(ends - self.reference[:, np.newaxis]).max(axis=1)
        return float(np.sqrt(1.0 + farthest @ farthest))

    def _mass_images(self) -> list[FloatArray]:
        return [np.asarray(term @ self.basis.vectors) for term in self.system.mass_terms]


def reduce_model(
    system: AffineSystem, settings: ReductionSettings | None = None, progress: Progress | None = None
) -> Reduction:
    """Make the reduced model of a full model.

    Parameters
    ----------
    system : AffineSystem
        The full model, `fe.full.operators.AffineOperators`.
    settings : ReductionSettings, optional
        Where and how well it is to hold.
    progress : Progress, optional
        Where to report.

    Raises
    ------
    ReductionError
        If the accuracy asked for is not reached.
    SolutionError
        If the full model cannot be solved.
    """
    settings = settings or ReductionSettings()
    regions = len(system.regions)
    reference = settings.reference(regions)
    with stage_of(progress, "Factorising the wing"):
        norm = Norm(affine_sum((*reference, 1.0), system.stiffness_terms))
    with stage_of(progress, "Reducing the modes") as stage:
        modal = reduce_modes(
            system,
            norm,
            reference,
            settings.validity_box(regions),
            settings.nominal_masses,
            settings.modal,
            stage.advance,
        )
    with stage_of(progress, "Reducing the statics") as stage:
        static = _StaticReduction(system, settings, norm, reference, stage.advance)
        history = _greedy(static, modal)
    model = static.model(modal)
    if history[-1] > settings.bound_tolerance:
        raise ReductionError(
            f"After {len(static.snapshots)} full solutions the strain error bound is {history[-1]:.2g} of "
            f"the largest strain, but {settings.bound_tolerance:.2g} was asked for; "
            "allow more snapshots or a looser tolerance."
        )
    directions = fewest_directions(model, training_set(settings, regions), settings.bound_tolerance)
    return Reduction(
        compressed(model, directions),
        static.basis.vectors @ directions,
        modal.basis,
        tuple(static.snapshots),
        tuple(history),
    )


def _greedy(static: _StaticReduction, modal: ModalData) -> list[float]:
    """Run pyMOR's weak greedy search with the certified bound as its surrogate; return the bounds it met."""
    set_log_levels({"pymor.algorithms.greedy": "WARN"})

    class Surrogate(WeakGreedySurrogate):  # type: ignore[misc]
        """The reduced model's own bound, as pyMOR's search wants it."""

        def evaluate(self, mus: list[Any], return_all_values: bool = False) -> Any:
            """Return the largest bound and where it is, or all bounds."""
            if not static.basis.size:  # nothing to bound yet: begin in the middle
                bounds = np.array([-sum((np.array(mu) - np.mean(mus, axis=0)) ** 2) for mu in mus]) + 1e3
            else:
                model = static.model(modal)
                bounds = np.array([relative_bound(model, mu) for mu in mus])
            if return_all_values:
                return bounds
            worst = int(bounds.argmax())
            return float(bounds[worst]), mus[worst]

        def extend(self, mu: tuple[float, ...]) -> None:
            """Add the full solutions at the worst state."""
            static.add_snapshot(mu)
            static.advance(1, f"full solution {len(static.snapshots)}")

    settings, regions = static.settings, len(static.system.regions)
    result = weak_greedy(
        Surrogate(),
        training_set(settings, regions),
        atol=SEARCH_MARGIN * settings.bound_tolerance,
        max_extensions=settings.most_snapshots,
    )
    bounds = [float(value) for value in result["max_errs"][1:]]
    if len(bounds) < len(static.snapshots):  # stopped by the limit: the last bound was not evaluated
        model = static.model(modal)
        bounds.append(max(relative_bound(model, mu) for mu in training_set(settings, regions)))
    return bounds
