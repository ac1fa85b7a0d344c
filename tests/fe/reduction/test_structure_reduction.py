"""Reduced structures against their full models: statics, modes, motion, what is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm

from fe.full.modes import lowest_eigenpairs
from fe.full.statics import Factorisation
from fe.reduction.model_cache import reduced_structure
from fe.reduction.reduced_basis import Reduction, reduce_structure
from fe.reduction.structure_errors import measured_errors
from fe.runtime.errors import MeshError, OutsideModelError, ReductionError
from fe.runtime.transient import ModalIntegrator, TransientState
from fe.structure.operators import Structure, load_and_assemble

HURT = {"e": 1.05, "z1": 0.6, "z2": 0.3, "pump": 0.07, "load_factor": 3.0, "push": -120.0}


def test_random_states_against_the_full_model(beam: Structure, beam_reduction: Reduction) -> None:
    """Strains and displacements err by less than their bound, which keeps its tolerance; modes by 2e-5."""
    errors = measured_errors(beam, beam_reduction.model, 6, seed=7)
    assert max(errors.strain, errors.displacement) < errors.bound < 1e-3
    assert errors.frequency < 2e-5


def test_a_state_in_all_its_parts(beam: Structure, beam_reduction: Reduction) -> None:
    """Parameter times loss, controls, and the weight of a free mass are those of the full sums."""
    model = beam_reduction.model
    stiffness = beam.stiffness({"e": 1.05}, {"z1": 0.6, "z2": 0.3})
    load = beam.load("weight", 3.0, {"pump": 0.07}) + beam.load("pushed", -120.0)
    full = Factorisation(stiffness).solve(load)
    found = model.static_response(HURT)
    np.testing.assert_allclose(found.strain, beam.gauge_output @ full, atol=found.strain_error_bound, rtol=0)
    tip = beam.displacement_output @ full
    np.testing.assert_allclose(found.displacement, tip, atol=found.displacement_error_bound, rtol=0)
    squares, shapes = lowest_eigenpairs(stiffness, beam.mass({"pump": 0.07}), 6)
    shapes = shapes / np.sqrt(np.einsum("im,im->m", shapes, beam.mass({"pump": 0.07}) @ shapes))
    modes = model.modes(HURT)
    np.testing.assert_allclose(modes.frequency, np.sqrt(squares) / (2 * np.pi), rtol=2e-5)
    wanted = np.abs(np.vstack((beam.gauge_output @ shapes, beam.displacement_output @ shapes)))
    np.testing.assert_allclose(np.abs(modes.output[:4]), wanted, atol=2e-3 * wanted.max())


def test_a_released_beam_moves_as_the_full_model(beam: Structure, beam_reduction: Reduction) -> None:
    """Ring-down after a push: once the high modes have died away, strain, position and acceleration agree."""
    model = beam_reduction.model
    vector = model.vector({**HURT, "load_factor": 0.0, "push": 100.0})
    let_go = model.vector({**HURT, "load_factor": 0.0, "push": 0.0})
    motion = ModalIntegrator(model, vector, beam.damping_alpha, beam.damping_beta)
    state = motion.at_rest(model.load_coefficients(vector))
    time, steps = 6e-3, 3
    for _ in range(steps):
        state = motion.advance(state, time / steps, model.load_coefficients(let_go))
    stiffness = beam.stiffness({"e": 1.05}, {"z1": 0.6, "z2": 0.3}).toarray()
    mass = beam.mass({"pump": 0.07}).toarray()
    start = np.linalg.solve(stiffness, beam.load("pushed", 100.0))
    damping = beam.damping_alpha * mass + beam.damping_beta * stiffness
    n = len(start)
    inverse = np.linalg.inv(mass)
    generator = np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ stiffness, -inverse @ damping]])
    moved = expm(generator * time) @ np.concatenate((start, np.zeros(n)))
    position, acceleration = moved[:n], (generator @ moved)[n:]
    wanted = np.concatenate(
        (
            beam.gauge_output @ position,
            beam.displacement_output @ position,
            beam.acceleration_output @ acceleration,
        )
    )
    at_start = np.abs(np.concatenate((beam.gauge_output @ start, beam.displacement_output @ start, [np.inf])))
    size = np.where(np.isinf(at_start), np.abs(wanted[-1]), at_start)
    assert np.all(np.abs(motion.outputs(state) - wanted) < 5e-3 * size)
    kept = TransientState.from_list(state.to_list(), model.mode_count)
    assert np.array_equal(motion.outputs(kept), motion.outputs(state))
    same = ModalIntegrator(model, vector, beam.damping_alpha, beam.damping_beta)
    taken = motion.outputs(same.take_over(state, motion))
    np.testing.assert_allclose(taken, motion.outputs(state), rtol=1e-6, atol=1e-9 * float(size.max()))


def test_a_load_that_no_output_sees(write_beam: Callable[..., Path], tmp_path: Path) -> None:
    """A push to the side moves the tip up by nothing, by symmetry: it is bounded all the same."""
    file = write_beam(tmp_path, {"force = [0, 0, 1]": "force = [0, 1, 0]"}, cells=2)
    model = reduce_structure(load_and_assemble(file), "beam").model
    found = model.static_response({"load_factor": 0.0, "push": 100.0})
    upwards = model.static_response({"load_factor": 6.0, "push": 0.0}).displacement[0]
    assert abs(found.displacement[0]) <= found.displacement_error_bound < 1e-3 * abs(upwards)


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"z1": 0.9}, "z1 must lie between 0 and 0.8"),
        ({"push": float("nan")}, "push must lie between -500 and 500"),
        ({"z3": 0.1}, "nothing named 'z3'"),
    ],
)
def test_values_outside_are_refused(
    beam_reduction: Reduction, values: dict[str, float], sentence: str
) -> None:
    with pytest.raises(OutsideModelError, match=sentence):
        beam_reduction.model.static_response(values)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"damage = [": "# "}, r"no \[\[damage"),
        ({"density = 2700": "density = 0", "mass = 0.05, free = true": "mass = 0.0"}, "no mass"),
        ({"density = 2700": "density = 0"}, "move in fewer ways than the 8 modes"),
    ],
)
def test_what_cannot_be_reduced_is_refused(
    write_beam: Callable[..., Path], tmp_path: Path, changes: dict[str, str], sentence: str
) -> None:
    with pytest.raises(ReductionError, match=sentence):
        reduced_structure(write_beam(tmp_path, changes, cells=2))


def test_a_structure_without_its_mesh(write_beam: Callable[..., Path], tmp_path: Path) -> None:
    file = write_beam(tmp_path)
    (tmp_path / "beam.vtu").unlink()
    with pytest.raises(MeshError, match=r"beam\.vtu"):
        reduced_structure(file)
