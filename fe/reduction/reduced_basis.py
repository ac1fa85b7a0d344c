"""Offline: make the `ReducedModel` of a wing from its full model.

The method and what it reaches are in `docs/reduced_model.md`.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fe.full.affine import AffineSystem, affine_sum
from fe.full.subspace import Norm
from fe.runtime.errors import ReductionError
from fe.runtime.reduced import ReducedModel
from fe.runtime.state import DigitalState
from reporting.words import counted

from .certified_basis import AffineProblem, StaticReduction, greedy
from .compression import WING_JUDGEMENT, compressed, fewest_directions
from .modal_basis import ModalData, reduce_modes
from .settings import ALONE, TOGETHER, ReductionSettings, loss_splits, training_set
from .stages import Progress, stage_of

FloatArray = npt.NDArray[np.float64]


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


def wing_problem(system: AffineSystem) -> AffineProblem:
    """Return a wing as its reduction sees it: lift and tip force, gauges and tip displacement."""
    return AffineProblem(
        stiffness_terms=system.stiffness_terms,
        mass_terms=system.mass_terms,
        loads=np.stack((system.load_lift, system.load_tip), axis=1),
        outputs=np.concatenate(
            (
                np.asarray(system.gauge_output.T.toarray()),
                np.asarray(system.tip_displacement_output)[:, np.newaxis],
            ),
            axis=1,
        ),
        groups=(slice(0, -1), slice(-1, None)),
        theta=lambda state: np.array((state[0], *(1.0 - z for z in state[1:]), 1.0)),
    )


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
    together = 1 if regions <= ALONE else TOGETHER
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
            together,
        )
    with stage_of(progress, "Reducing the statics") as stage:
        e, *losses = settings.validity_box(regions)[: len(reference)]
        ends = np.array((e, *(1.0 - z for z in losses)))
        static = StaticReduction(
            wing_problem(system),
            norm,
            reference,
            duals=lambda problem: problem.solved(
                lambda values: np.append(values, 1.0), reference, ends, settings.anchors(regions)
            ),
            farthest=np.abs(ends - reference[:, np.newaxis]).max(axis=1),
            advance=stage.advance,
            batch=together,
        )
        states = training_set(settings, regions)
        history = greedy(
            static,
            lambda: _model(static, system, settings, modal),
            WING_JUDGEMENT,
            states,
            tolerance=settings.bound_tolerance,
            most_snapshots=settings.most_snapshots,
        )
    model = _model(static, system, settings, modal)
    if history[-1] > settings.bound_tolerance:
        raise ReductionError(
            f"After {counted(len(static.snapshots), 'full solution')} the strain error bound is "
            f"{history[-1]:.2g} of the largest strain, but {settings.bound_tolerance:.2g} was asked for; "
            "allow more snapshots or a looser tolerance."
        )
    directions = fewest_directions(model, WING_JUDGEMENT, states, settings.bound_tolerance)
    return Reduction(
        compressed(model, directions),
        static.basis.vectors @ directions,
        modal.basis,
        tuple(static.snapshots),
        tuple(history),
    )


def _model(
    static: StaticReduction, system: AffineSystem, settings: ReductionSettings, modal: ModalData
) -> ReducedModel:
    """Return the reduced model of the present bases."""
    regions, counts = len(system.regions), settings.anchors(len(system.regions))
    state = DigitalState()
    return ReducedModel(
        design_hash=system.design_hash,
        name="uav_wing",
        region_names=" ".join(system.regions),
        parameter_names="young_modulus_factor",
        mass_names="servo_mass pitot_mass",
        control_names="load_factor tip_force",
        control_units="1 N",
        gauge_names=" ".join(f"gauge_{number}" for number in range(1, system.gauge_output.shape[0] + 1)),
        displacement_names="tip",
        acceleration_names="",
        nominal=np.array((1.0, *(0.0,) * regions, state.servo_mass, state.pitot_mass, 1.0, 0.0)),
        damping=np.array((state.damping_alpha, state.damping_beta)),
        stiffness_factors=np.array([(1, 0), *((0, region + 1) for region in range(regions)), (0, 0)]),
        load_factors=np.array([(1, 0), (2, 0)]),
        validity_box=settings.validity_box(regions),
        dual_counts=np.array(counts, dtype=np.int64),
        dual_split=np.concatenate([loss_splits(settings.stiffness_loss, count) for count in counts]),
        modal_stiffness=modal.stiffness,
        modal_mass=modal.mass,
        modal_load=static.problem.loads.T @ modal.basis,
        modal_output=static.problem.outputs.T @ modal.basis,
        cross_mass=static.cross_mass(modal.basis),
        followed_shapes=modal.followed_shapes,
        mode_count=modal.mode_count,
        **static.arrays(),
    )
