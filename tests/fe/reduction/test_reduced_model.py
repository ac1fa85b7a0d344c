"""Reduced models: the contract of a wing's and a structure's, how they are made, their fields."""

import re
from dataclasses import replace
from typing import NamedTuple

import meshio
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymor.models.basic import StationaryModel
from pymor.operators.constructions import LincombOperator, VectorOperator
from pymor.operators.numpy import NumpyMatrixOperator
from pymor.parameters.functionals import MinThetaParameterFunctional, ProjectionParameterFunctional
from pymor.reductors.coercive import CoerciveRBReductor

from fe.full import subspace
from fe.reduction.model_cache import reduced_model, write_modes_vtu, write_wing_vtu
from fe.reduction.reduced_basis import reduce_structure
from fe.reduction.terms import ReductionTerms
from fe.runtime.errors import FiniteElementError, OutsideModelError, SolutionError
from fe.runtime.reduced import ReducedModel
from fe.structure.affine import AffineStructure, affine_sum, natural_frequencies, static_response
from fe.structure.mesh_file import read_mesh
from fe.structure.operators import load_and_assemble
from fe.structure.tables import StructureSettings
from fe.wing.operators import flapwise_bending_modes, point_masses, wing_values
from reporting.errors import FileNotWrittenError
from tests.refusals import Inputs, refused
from tests.wings import tip_stiffness

ROUGH = StructureSettings(mode_count=4, bound_tolerance=0.1)

# ---------------------------------------------------------------- the contract


class Pair(NamedTuple):
    """A full model and its reduced one, what bounds and frequencies are good to, how often to look."""

    full: AffineStructure
    model: ReducedModel
    tolerance: float
    frequency: float
    examples: int


@pytest.fixture(scope="module", params=["wing", "beam", "rough"])
def pair(request: pytest.FixtureRequest) -> Pair:
    kind, get = request.param, request.getfixturevalue
    if kind == "wing":
        return Pair(get("coarse_operators"), get("model"), 1e-3, 1e-4, 15)
    if kind == "beam":
        return Pair(get("beam"), get("beam_reduction").model, 1e-3, 2e-5, 50)
    # so small that its errors are far above rounding
    return Pair(get("beam"), reduce_structure(get("beam"), ROUGH).model, 0.2, 2e-5, 200)


def named(model: ReducedModel, vector: np.ndarray) -> dict[str, float]:
    return dict(zip(model.input_names, vector.tolist(), strict=True))


def states(model: ReducedModel, count: int) -> np.ndarray:
    """Random values (count, V) in the validity box."""
    low, high = model.validity_box.T
    return low + (high - low) * np.random.default_rng(3).random((count, len(low)))


def test_the_bound_holds_and_keeps_the_tolerance(pair):
    """At corners and edges of the box, which count most, and anywhere inside."""
    model, (low, high) = pair.model, pair.model.validity_box.T
    share = st.sampled_from((0.0, 0.5, 1.0)) | st.floats(0.0, 1.0)

    @settings(max_examples=pair.examples, deadline=None)
    @given(shares=st.lists(share, min_size=len(low), max_size=len(low)))
    def holds(shares: list[float]) -> None:
        vector = low + (high - low) * np.array(shares)
        # of all loads at once: where they nearly cancel, a sum of solutions has lost its digits
        full, found = (
            static_response(pair.full, named(model, vector)),
            model.static_response(vector),
        )
        loads = model.load_coefficients(vector)
        alone = [model.static_response(vector, load=unit) for unit in np.eye(len(loads))]
        for what, wanted in (("strain", full.strain), ("displacement", full.output)):
            bound = getattr(found, f"{what}_error_bound")
            assert np.abs(getattr(found, what) - wanted).max() <= bound
            # combined loads may nearly cancel, so the scale is that of each load alone
            scale = sum(
                np.abs(getattr(one, what)).max() * abs(part)
                for one, part in zip(alone, loads, strict=True)
            )
            assert bound <= pair.tolerance * scale + 1e-300

    holds()


def test_frequencies_are_those_of_the_full_model(pair):
    """Their modes are orthonormal in the mass, and the last output of each goes up."""
    model = pair.model
    for vector in states(model, 3):
        wanted, _ = natural_frequencies(pair.full, model.mode_count, named(model, vector))
        modes = model.modes(vector)
        np.testing.assert_allclose(
            modes.shape.T @ modes.mass @ modes.shape, np.eye(len(wanted)), atol=1e-11
        )
        assert np.all(modes.output[-1] >= 0)
        relative = modes.frequency / wanted - 1.0
        assert np.all(relative > -3e-6)  # a projection can only be stiffer, but for rounding
        assert np.all(relative < pair.frequency)


def test_low_modes_keep_their_digits(pair):
    """Another orthonormal basis of the same space gives the same frequencies, to rounding."""
    model, size = pair.model, len(pair.model.modal_load.T)
    turn = np.linalg.qr(np.random.default_rng(4).normal(size=(size, size)))[0]
    sides = {
        name: getattr(model, name) @ turn
        for name in ("modal_load", "modal_output", "followed_shapes")
    }
    both = {
        name: turn.T @ getattr(model, name) @ turn for name in ("modal_stiffness", "modal_mass")
    }
    turned = replace(model, **sides, **both)
    for name in both:
        np.testing.assert_array_equal(getattr(model, name), getattr(model, name).transpose(0, 2, 1))
    for vector in states(model, 3):
        one, other = (which.modes(vector) for which in (model, turned))
        np.testing.assert_allclose(other.frequency, one.frequency, rtol=2e-13)
        np.testing.assert_allclose(other.followed_mac, one.followed_mac, rtol=1e-11)
        assert other.followed == one.followed


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e9, -1e9])
def test_values_outside_validity_are_refused_by_name(pair, bad):
    model = pair.model
    assert tuple(model.validity) == model.input_names
    for name in model.input_names:
        vector = model.vector({name: bad})
        asked = [(ask, vector) for ask in (model.static_response, model.modes)]
        for ask, values in (*asked, (model.static_outputs, np.stack((model.nominal, vector)))):
            with pytest.raises(OutsideModelError, match=rf"^{name} must lie between"):
                ask(values)
    with pytest.raises(OutsideModelError, match="nothing named 'z9'"):
        model.static_response({"z9": 0.1})


# ---------------------------------------------------------------- what one kind alone shows


def test_the_wing_bends_in_the_modes_of_the_full_one(coarse_operators, model):
    e, loss, servo, pitot = 0.9, (0.8, 0.8), 0.30, 0.0
    values = wing_values(coarse_operators, e, loss, **point_masses(servo, pitot))
    full = natural_frequencies(coarse_operators, 6, values)
    reduced = model.modes(
        stiffness_loss=loss, young_modulus_factor=e, servo_mass=servo, pitot_mass=pitot
    )
    np.testing.assert_allclose(reduced.frequency, full.frequency[: model.mode_count], rtol=1e-4)
    assert reduced.followed == tuple(flapwise_bending_modes(coarse_operators, full))
    assert min(reduced.followed_mac) > 0.8  # far more than any other mode could have
    assert model.tip_stiffness(e, loss) == pytest.approx(
        tip_stiffness(coarse_operators, e, loss), rel=1e-5
    )
    for index in reduced.followed:
        shape, output = full.shape[:, index], reduced.output[:, index]
        tip = abs(coarse_operators.tip_row @ shape)  # in the reduced model it moves up
        np.testing.assert_allclose(output[-1], tip, rtol=3e-3)
        np.testing.assert_allclose(
            reduced.participation[1, index], coarse_operators.load_tip @ shape, rtol=3e-3
        )
        strain = coarse_operators.gauge_output @ shape
        np.testing.assert_allclose(output[:-1], strain, rtol=0, atol=1e-2 * np.abs(strain).max())


def test_a_load_that_no_output_sees(write_beam, tmp_path):
    """A push to the side moves the tip up by nothing, by symmetry: it is bounded all the same."""
    file = write_beam(tmp_path, {"force = [0, 0, 1]": "force = [0, 1, 0]"}, cells=2)
    model = reduce_structure(load_and_assemble(file)).model
    found = model.static_response({"load_factor": 0.0, "push": 100.0})
    upwards = model.static_response({"load_factor": 6.0, "push": 0.0}).displacement[0]
    assert abs(found.displacement[0]) <= found.displacement_error_bound < 1e-3 * abs(upwards)


# ---------------------------------------------------------------- the search, against pyMOR's own reductor


def test_the_rounding_that_was_measured_is_allowed_for(write_beam, tmp_path):
    """On a soft spring the beam moves by metres and strains as before: digits of the strains are lost."""
    models, flange = [], 'rigid_about = [0, 10, 5], hold = ["x", "y", "rx", "ry", "rz"]'
    for spring in (2e6, 0.25):
        held = f"{flange}, springs = [0, 0, {spring}, 0, 0, 0]"
        file = write_beam(tmp_path, {'hold = ["x", "y", "z"]': held}, cells=2)
        models.append(reduce_structure(load_and_assemble(file), ROUGH).model)
    stiff, soft = (model.static_response({"load_factor": 1.0}) for model in models)
    assert soft.displacement[0] > 1e6 * stiff.displacement[0]
    assert models[0].rounding_allowance == 5e-6  # the least
    assert 5e-6 < models[1].rounding_allowance < 2e-3
    apart = np.abs(soft.strain - stiff.strain).max()
    assert apart <= soft.strain_error_bound + stiff.strain_error_bound


def test_pymor_reduces_and_bounds_alike(beam):
    """On the same basis pyMOR's coercive reductor must give the same solution and the same energy bound."""
    terms, reduction = ReductionTerms(beam), reduce_structure(beam, ROUGH)
    model, count = reduction.model, len(terms.stiffness_terms)
    coefficients = [ProjectionParameterFunctional("theta", count, k) for k in range(count)]
    operators = [NumpyMatrixOperator(term) for term in terms.stiffness_terms]
    reference = {"theta": np.append(model.bound_reference, 1.0)}
    load = VectorOperator(operators[0].range.from_numpy(beam.load("pushed", 1.0)[:, np.newaxis]))
    full = StationaryModel(LincombOperator(operators, coefficients), load)
    reduced = CoerciveRBReductor(
        full,
        RB=full.solution_space.from_numpy(np.ascontiguousarray(reduction.static_basis)),
        product=NumpyMatrixOperator(affine_sum(reference["theta"], terms.stiffness_terms)),
        coercivity_estimator=MinThetaParameterFunctional(coefficients, reference),
    ).reduce()
    for state in terms.training_states()[::17]:
        theta = terms.theta(state)
        mu = reduced.parameters.parse({"theta": theta})
        given = dict(zip(("e", "z1", "z2"), state, strict=True))
        ours = model.static_response({**given, "load_factor": 0.0, "push": 1.0}).coordinates
        np.testing.assert_allclose(reduced.solve(mu).to_numpy().ravel(), ours, rtol=1e-8)
        change = (theta - reference["theta"])[:-1]
        residual = model.residual_load[:, -1] - np.einsum(
            "rqj,q,j->r", model.residual_stiffness, change, ours
        )
        energy_bound = float(reduced.estimate_error(mu).ravel()[0])
        coercivity = min(theta / reference["theta"])
        assert np.linalg.norm(residual) / coercivity == pytest.approx(energy_bound, rel=1e-6)


def test_a_search_that_does_not_settle_is_refused(beam, monkeypatch):
    monkeypatch.setattr(subspace, "MOST_ITERATIONS", 1)
    with refused(SolutionError, "Conjugate gradients did not reach"):
        reduce_structure(beam)


def test_same_system_gives_the_same_bytes(beam, beam_reduction):
    assert reduce_structure(beam).model.to_bytes() == beam_reduction.model.to_bytes()


# ---------------------------------------------------------------- of a structure file


@pytest.mark.parametrize(("changes", "cells", "sentence"), Inputs(__file__).refused("beam"))
def test_what_cannot_be_reduced_is_refused(changes, cells, sentence, write_beam, tmp_path):
    with refused(FiniteElementError, sentence):
        reduced_model(write_beam(tmp_path, changes, cells=cells))


# ---------------------------------------------------------------- fields of the wing

STATE = {
    "young_modulus_factor": 0.95,
    "stiffness_loss": (0.3, 0.6),
    "load_factor": 3.0,
    "tip_force": 5.0,
}


def test_displacement_strain_and_damage_are_those_of_the_full_one(
    coarse_fields, coarse_operators, tmp_path
):
    """Files of the same state are the same bytes, and are read as the wing's mesh."""
    first, again = (tmp_path / folder / "wing.vtu" for folder in "ab")
    for path in (first, again):
        path.parent.mkdir()
        write_wing_vtu(path, coarse_fields, coarse_fields.vector(**STATE))
        assert list(path.parent.iterdir()) == [path]
    assert first.read_bytes() == again.read_bytes()
    found, mesh = read_mesh(first, 1.0, "m"), coarse_operators.wing_mesh
    assert found.kind is mesh.kind
    np.testing.assert_allclose(found.nodes, mesh.nodes, atol=1e-12)
    written, full = (
        meshio.read(first),
        static_response(coarse_operators, wing_values(coarse_operators, **STATE)),
    )
    wanted, moved = (
        coarse_operators.full_displacement(full.displacement),
        written.point_data["displacement"],
    )
    np.testing.assert_allclose(moved, wanted, atol=1e-3 * np.abs(wanted).max())
    assert moved[:, 2].max() == pytest.approx(full.output[0], rel=0.1)
    strain = mesh.strains(wanted, local=np.full((1, 3), 0.5))[:, 0]
    data = {name: own for name, (own,) in written.cell_data.items()}
    np.testing.assert_allclose(data["strain"], strain, atol=1e-2 * np.abs(strain).max())
    np.testing.assert_array_equal(data["spanwise_strain"], -data["strain"][:, 1])
    np.testing.assert_array_equal(data["region"], mesh.region)
    lost = np.select([mesh.region == 1, mesh.region == 2], [0.3, 0.6])
    np.testing.assert_array_equal(data["stiffness_loss"], lost)


def test_modes_are_those_of_the_full_model(coarse_fields, coarse_operators, tmp_path):
    write_modes_vtu(tmp_path / "modes.vtu", coarse_fields, coarse_fields.nominal)
    written = meshio.read(tmp_path / "modes.vtu").point_data
    full = natural_frequencies(coarse_operators, 6, point_masses(0.169, 0.134))
    assert len(written) == coarse_fields.mode_count
    for number, name in enumerate(list(written)[:3]):
        label, frequency = name.rsplit("_", 1)
        assert label == f"mode_{number + 1}"
        assert float(frequency.removesuffix("Hz")) == pytest.approx(
            full.frequency[number], rel=1e-4
        )
        wanted = np.abs(coarse_operators.full_displacement(full.shape[:, number]))
        np.testing.assert_allclose(np.abs(written[name]), wanted, atol=1e-2 * wanted.max())


def test_bad_states_and_places_leave_no_file(coarse_fields, tmp_path):
    place = tmp_path / "folder.vtu"
    place.mkdir()
    with refused(OutsideModelError, "load_factor must"):
        write_wing_vtu(
            tmp_path / "wing.vtu", coarse_fields, coarse_fields.vector(load_factor=np.nan)
        )
    with refused(FileNotWrittenError, re.escape(str(place))):
        write_wing_vtu(place, coarse_fields, coarse_fields.vector(**STATE))
    assert list(tmp_path.iterdir()) == [place]
