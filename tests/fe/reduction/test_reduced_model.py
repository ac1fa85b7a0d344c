"""Reduced models: the contract of a wing's and a structure's, how they are made, their fields."""

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import meshio
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymor.models.basic import StationaryModel
from pymor.operators.constructions import LincombOperator, VectorOperator
from pymor.operators.numpy import NumpyMatrixOperator
from pymor.parameters.functionals import (
    MinThetaParameterFunctional,
    ProjectionParameterFunctional,
)
from pymor.reductors.coercive import CoerciveRBReductor

from fe.full import subspace
from fe.reduction.model_cache import reduced_model, write_modes_vtu, write_wing_vtu
from fe.reduction.reduced_basis import Reduction, reduce_structure
from fe.reduction.terms import ReductionTerms
from fe.runtime.arrays import FloatArray
from fe.runtime.errors import FiniteElementError, OutsideModelError, SolutionError
from fe.runtime.reduced import ReducedModel
from fe.structure.affine import (
    AffineStructure,
    affine_sum,
    natural_frequencies,
    static_response,
)
from fe.structure.mesh_file import read_mesh
from fe.structure.operators import load_and_assemble
from fe.structure.tables import StructureSettings
from fe.wing.operators import flapwise_bending_modes, point_masses, wing_values
from reporting.errors import FileNotWrittenError
from tests.refusals import Inputs, refused
from tests.wings import tip_stiffness

ROUGH = StructureSettings(mode_count=4, bound_tolerance=0.1)
"""Settings of a model so small that its errors are far above rounding."""

# ---------------------------------------------------------------- the contract


class Pair(NamedTuple):
    """A full model and its reduced one.

    Attributes
    ----------
    full : AffineStructure
    model : ReducedModel
    bound_tolerance : float
        What bounds are good to, relative to the response to each load alone.
    frequency_tolerance : float
        What frequencies are good to, relative.
    examples : int
        In how many states bounds are compared.
    """

    full: AffineStructure
    model: ReducedModel
    bound_tolerance: float
    frequency_tolerance: float
    examples: int


@pytest.fixture(scope="module", params=["wing", "beam", "rough"])
def pair(request: pytest.FixtureRequest) -> Pair:
    if request.param == "wing":
        wing = request.getfixturevalue("coarse_operators")
        return Pair(wing, request.getfixturevalue("model"), 1e-3, 1e-4, 15)
    beam = request.getfixturevalue("beam")
    if request.param == "beam":
        reduction = request.getfixturevalue("beam_reduction")
        return Pair(beam, reduction.model, 1e-3, 2e-5, 50)
    return Pair(beam, reduce_structure(beam, ROUGH).model, 0.2, 2e-5, 200)


def values_by_name(model: ReducedModel, vector: FloatArray) -> dict[str, float]:
    return dict(zip(model.input_names, vector.tolist(), strict=True))


def draw_vectors(model: ReducedModel, count: int) -> FloatArray:
    """Return random values (count, V) in the validity box."""
    low, high = model.validity_box.T
    return low + (high - low) * np.random.default_rng(3).random((count, len(low)))


def assert_bounds(pair: Pair, vector: FloatArray) -> None:
    """Assert that the bounds of strains and displacements hold and keep the tolerance."""
    model = pair.model
    # of all loads at once: where they nearly cancel, a sum of solutions has lost its digits
    full = static_response(pair.full, values_by_name(model, vector))
    response = model.static_response(vector)
    loads = model.load_coefficients(vector)
    responses_alone = [model.static_response(vector, load=load) for load in np.eye(len(loads))]
    for quantity, full_values in (("strain", full.strain), ("displacement", full.output)):
        bound = getattr(response, f"{quantity}_error_bound")
        assert np.abs(getattr(response, quantity) - full_values).max() <= bound

        # combined loads may nearly cancel, so the scale is that of each load alone
        scale = 0.0
        for alone, coefficient in zip(responses_alone, loads, strict=True):
            scale += np.abs(getattr(alone, quantity)).max() * abs(coefficient)
        assert bound <= pair.bound_tolerance * scale + 1e-300


def test_the_bound_holds_and_keeps_the_tolerance(pair):
    """At corners and edges of the box, which count most, and anywhere inside."""
    low, high = pair.model.validity_box.T
    fraction = st.sampled_from((0.0, 0.5, 1.0)) | st.floats(0.0, 1.0)

    @settings(max_examples=pair.examples, deadline=None)
    @given(fractions=st.lists(fraction, min_size=len(low), max_size=len(low)))
    def check_bounds(fractions: list[float]) -> None:
        assert_bounds(pair, low + (high - low) * np.array(fractions))

    check_bounds()


@pytest.fixture(scope="module")
def vectors(pair):
    """Three states of a model."""
    return draw_vectors(pair.model, 3)


def test_frequencies_are_those_of_the_full_model(pair, vectors):
    for vector in vectors:
        values = values_by_name(pair.model, vector)
        full_frequency, _ = natural_frequencies(pair.full, pair.model.mode_count, values)

        frequency = pair.model.modes(vector).frequency

        error = frequency / full_frequency - 1.0
        assert np.all(error > -3e-6)  # a projection can only be stiffer, but for rounding
        assert np.all(error < pair.frequency_tolerance)


def test_modes_are_orthonormal_in_the_mass_and_go_up_at_the_last_output(pair, vectors):
    for vector in vectors:
        modes = pair.model.modes(vector)

        products = modes.shape.T @ modes.mass @ modes.shape
        np.testing.assert_allclose(products, np.eye(len(products)), atol=1e-11)
        assert np.all(modes.output[-1] >= 0)


@pytest.fixture(scope="module")
def rotated(pair) -> ReducedModel:
    """The same model in another orthonormal basis of its modes."""
    model = pair.model
    size = len(model.modal_load.T)
    random = np.random.default_rng(4)
    rotation, _ = np.linalg.qr(random.normal(size=(size, size)))
    return replace(
        model,
        modal_load=model.modal_load @ rotation,
        modal_output=model.modal_output @ rotation,
        followed_shapes=model.followed_shapes @ rotation,
        modal_stiffness=rotation.T @ model.modal_stiffness @ rotation,
        modal_mass=rotation.T @ model.modal_mass @ rotation,
    )


@pytest.mark.parametrize("name", ["modal_stiffness", "modal_mass"])
def test_modal_matrices_are_symmetric(pair, name):
    matrices = getattr(pair.model, name)

    np.testing.assert_array_equal(matrices, matrices.transpose(0, 2, 1))


def test_low_modes_keep_their_digits_in_another_basis(pair, vectors, rotated):
    for vector in vectors:
        modes = pair.model.modes(vector)
        rotated_modes = rotated.modes(vector)

        np.testing.assert_allclose(rotated_modes.frequency, modes.frequency, rtol=2e-13)
        np.testing.assert_allclose(rotated_modes.followed_mac, modes.followed_mac, rtol=1e-11)
        assert rotated_modes.followed == modes.followed


def test_every_input_has_a_range_of_validity(pair):
    assert tuple(pair.model.validity) == pair.model.input_names


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e9, -1e9])
def test_values_outside_validity_are_refused_by_name(pair, value):
    model = pair.model
    for name in model.input_names:
        vector = model.vector({name: value})
        sentence = rf"^{name} must lie between"

        with pytest.raises(OutsideModelError, match=sentence):
            model.static_response(vector)
        with pytest.raises(OutsideModelError, match=sentence):
            model.modes(vector)
        with pytest.raises(OutsideModelError, match=sentence):
            model.static_outputs(np.stack((model.nominal, vector)))


def test_a_masked_value_is_refused_by_name(pair):
    model = pair.model
    name = model.input_names[0]
    sentence = rf"^{name} must lie between"
    is_masked = np.arange(len(model.nominal)) == 0
    column = np.ma.masked_equal([model.nominal[0], 9.0], 9.0)

    with pytest.raises(OutsideModelError, match=sentence):
        model.static_response(np.ma.masked_array(model.nominal, is_masked))
    with pytest.raises(OutsideModelError, match=sentence):
        model.static_outputs(np.ma.masked_array([model.nominal], is_masked[None]))
    with pytest.raises(OutsideModelError, match=sentence):
        model.static_outputs(model.vectors({name: column}))


def test_a_masked_whole_number_is_lost_as_a_masked_float(pair):
    whole_numbers = np.arange(len(pair.model.nominal))

    vector = pair.model.vector(np.ma.masked_equal(whole_numbers, 0))

    np.testing.assert_array_equal(vector, [np.nan, *whole_numbers[1:]])


def test_an_unknown_value_is_refused(pair):
    with pytest.raises(OutsideModelError, match="mass or control named 'z9'"):
        pair.model.static_response({"z9": 0.1})


# ---------------------------------------------------------------- modes of the wing

MODULUS_FACTOR = 0.9
LOSSES = (0.8, 0.8)
SERVO_MASS = 0.30
PITOT_MASS = 0.0


@dataclass(frozen=True)
class WingModes:
    """Modes of the full and of the reduced wing."""

    full: Any
    reduced: Any


@pytest.fixture(scope="module")
def wing_modes(coarse_operators, model) -> WingModes:
    masses = point_masses(SERVO_MASS, PITOT_MASS)
    values = wing_values(coarse_operators, MODULUS_FACTOR, LOSSES, **masses)
    reduced = model.modes(
        stiffness_loss=LOSSES,
        young_modulus_factor=MODULUS_FACTOR,
        servo_mass=SERVO_MASS,
        pitot_mass=PITOT_MASS,
    )
    return WingModes(full=natural_frequencies(coarse_operators, 6, values), reduced=reduced)


def test_the_wing_has_the_frequencies_of_the_full_one(model, wing_modes):
    full_frequency = wing_modes.full.frequency[: model.mode_count]

    np.testing.assert_allclose(wing_modes.reduced.frequency, full_frequency, rtol=1e-4)


def test_the_wing_has_the_tip_stiffness_of_the_full_one(coarse_operators, model):
    full_stiffness = tip_stiffness(coarse_operators, MODULUS_FACTOR, LOSSES)

    stiffness = model.tip_stiffness(MODULUS_FACTOR, LOSSES)

    assert stiffness == pytest.approx(full_stiffness, rel=1e-5)


def test_the_wing_follows_the_bending_modes_of_the_full_one(coarse_operators, wing_modes):
    bending = flapwise_bending_modes(coarse_operators, wing_modes.full)

    assert wing_modes.reduced.followed == tuple(bending)
    assert min(wing_modes.reduced.followed_mac) > 0.8  # far more than any other mode could have


def test_the_wing_bends_as_the_full_one(coarse_operators, wing_modes):
    reduced = wing_modes.reduced
    _, tip_participation = reduced.participation
    for mode in reduced.followed:
        shape = wing_modes.full.shape[:, mode]
        *strain, tip = reduced.output[:, mode]

        full_strain = coarse_operators.gauge_output @ shape
        full_tip = abs(coarse_operators.tip_row @ shape)  # in the reduced model it moves up
        full_participation = coarse_operators.load_tip @ shape
        strain_tolerance = 1e-2 * np.abs(full_strain).max()
        np.testing.assert_allclose(tip, full_tip, rtol=3e-3)
        np.testing.assert_allclose(tip_participation[mode], full_participation, rtol=3e-3)
        np.testing.assert_allclose(strain, full_strain, rtol=0, atol=strain_tolerance)


# ---------------------------------------------------------------- loads and rounding


def test_a_load_that_no_output_sees_is_bounded(write_beam, tmp_path):
    """A push to the side moves the tip up by nothing, by symmetry."""
    file = write_beam(tmp_path, {"force = [0, 0, 1]": "force = [0, 1, 0]"}, cells=2)
    model = reduce_structure(load_and_assemble(file)).model

    pushed = model.static_response({"load_factor": 0.0, "push": 100.0})

    lifted = model.static_response({"load_factor": 6.0, "push": 0.0})
    (displacement,) = pushed.displacement
    (upwards,) = lifted.displacement
    assert abs(displacement) <= pushed.displacement_error_bound < 1e-3 * abs(upwards)


class SprungBeams(NamedTuple):
    """The beam on a stiff and on a soft spring, which moves by metres and strains as before."""

    stiff: ReducedModel
    soft: ReducedModel


@pytest.fixture(scope="module")
def sprung_beams(write_beam, tmp_path_factory) -> SprungBeams:
    def reduce_on_spring(stiffness: float) -> ReducedModel:
        flange = 'rigid_about = [0, 10, 5], hold = ["x", "y", "rx", "ry", "rz"]'
        support = f"{flange}, springs = [0, 0, {stiffness}, 0, 0, 0]"
        folder = tmp_path_factory.mktemp("sprung")
        file = write_beam(folder, {'hold = ["x", "y", "z"]': support}, cells=2)
        return reduce_structure(load_and_assemble(file), ROUGH).model

    return SprungBeams(stiff=reduce_on_spring(2e6), soft=reduce_on_spring(0.25))


def test_rounding_that_was_measured_is_allowed_for(sprung_beams):
    """On the soft spring digits of the strains are lost."""
    least_allowance = 5e-6

    assert sprung_beams.stiff.rounding_allowance == least_allowance
    assert least_allowance < sprung_beams.soft.rounding_allowance < 2e-3


def test_bounds_contain_the_rounding_of_a_soft_spring(sprung_beams):
    stiff = sprung_beams.stiff.static_response({"load_factor": 1.0})
    soft = sprung_beams.soft.static_response({"load_factor": 1.0})

    difference = np.abs(soft.strain - stiff.strain).max()
    assert soft.displacement[0] > 1e6 * stiff.displacement[0]
    assert difference <= soft.strain_error_bound + stiff.strain_error_bound


# ---------------------------------------------------------------- pyMOR's own reductor


@dataclass(frozen=True)
class PymorReduction:
    """The beam that pyMOR's coercive reductor reduces on the same basis, and ours."""

    terms: ReductionTerms
    ours: Reduction
    reduced: Any
    reference: FloatArray


@pytest.fixture(scope="module")
def pymor_reduction(beam) -> PymorReduction:
    terms = ReductionTerms(beam)
    ours = reduce_structure(beam, ROUGH)
    count = len(terms.stiffness_terms)
    reference = np.append(ours.model.bound_reference, 1.0)
    coefficients = [ProjectionParameterFunctional("theta", count, k) for k in range(count)]
    operators = [NumpyMatrixOperator(term) for term in terms.stiffness_terms]
    load = beam.load("pushed", 1.0)[:, np.newaxis]
    full = StationaryModel(
        LincombOperator(operators, coefficients),
        VectorOperator(operators[0].range.from_numpy(load)),
    )
    reductor = CoerciveRBReductor(
        full,
        RB=full.solution_space.from_numpy(np.ascontiguousarray(ours.static_basis)),
        product=NumpyMatrixOperator(affine_sum(reference, terms.stiffness_terms)),
        coercivity_estimator=MinThetaParameterFunctional(coefficients, {"theta": reference}),
    )
    return PymorReduction(terms, ours, reductor.reduce(), reference)


def pushed_coordinates(model: ReducedModel, state: FloatArray) -> FloatArray:
    """Return the reduced solution under a push of 1 N."""
    values = dict(zip(("e", "z1", "z2"), state, strict=True))
    response = model.static_response({**values, "load_factor": 0.0, "push": 1.0})
    return np.asarray(response.coordinates)


def test_pymor_gives_the_same_solution(pymor_reduction):
    terms = pymor_reduction.terms
    for state in terms.training_states()[::17]:
        parameters = pymor_reduction.reduced.parameters.parse({"theta": terms.theta(state)})

        solution = pymor_reduction.reduced.solve(parameters).to_numpy().ravel()

        ours = pushed_coordinates(pymor_reduction.ours.model, state)
        np.testing.assert_allclose(solution, ours, rtol=1e-8)


def test_pymor_gives_the_same_energy_bound(pymor_reduction):
    terms = pymor_reduction.terms
    model = pymor_reduction.ours.model
    push_load = model.residual_load.T[-1]
    for state in terms.training_states()[::17]:
        theta = terms.theta(state)
        parameters = pymor_reduction.reduced.parameters.parse({"theta": theta})

        (bound,) = pymor_reduction.reduced.estimate_error(parameters).ravel()

        ours = pushed_coordinates(model, state)
        change = (theta - pymor_reduction.reference)[:-1]
        reaction = np.einsum("rqj,q,j->r", model.residual_stiffness, change, ours)
        coercivity = min(theta / pymor_reduction.reference)
        our_bound = np.linalg.norm(push_load - reaction) / coercivity
        assert our_bound == pytest.approx(float(bound), rel=1e-6)


def test_a_search_that_does_not_settle_is_refused(beam, monkeypatch):
    monkeypatch.setattr(subspace, "MOST_ITERATIONS", 1)

    with refused(SolutionError, "Conjugate gradients did not reach"):
        reduce_structure(beam)


def test_the_same_system_gives_the_same_bytes(beam, beam_reduction):
    assert reduce_structure(beam).model.to_bytes() == beam_reduction.model.to_bytes()


@pytest.mark.parametrize(("changes", "cells", "sentence"), Inputs(__file__).refused("beam"))
def test_a_structure_that_cannot_be_reduced_is_refused(
    changes, cells, sentence, write_beam, tmp_path
):
    with refused(FiniteElementError, sentence):
        reduced_model(write_beam(tmp_path, changes, cells=cells))


# ---------------------------------------------------------------- fields of the wing

FIELD_STATE = {
    "young_modulus_factor": 0.95,
    "stiffness_loss": (0.3, 0.6),
    "load_factor": 3.0,
    "tip_force": 5.0,
}


def write_field(folder: Path, fields: Any) -> Path:
    """Write the field of the wing in `FIELD_STATE`."""
    path = folder / "wing.vtu"
    write_wing_vtu(path, fields, fields.vector(**FIELD_STATE))
    return path


@pytest.fixture(scope="module")
def field_file(coarse_fields, tmp_path_factory) -> Path:
    return write_field(tmp_path_factory.mktemp("field"), coarse_fields)


@pytest.fixture(scope="module")
def field(field_file):
    """The file as meshio reads it."""
    return meshio.read(field_file)


@pytest.fixture(scope="module")
def cell_data(field):
    """Arrays of the cells by name."""
    return {name: values for name, (values,) in field.cell_data.items()}


@pytest.fixture(scope="module")
def full_response(coarse_operators):
    return static_response(coarse_operators, wing_values(coarse_operators, **FIELD_STATE))


@pytest.fixture(scope="module")
def full_displacement(coarse_operators, full_response):
    """Displacements (N, 3) of all nodes."""
    return coarse_operators.full_displacement(full_response.displacement)


def test_files_of_the_same_state_are_the_same_bytes(coarse_fields, field_file, tmp_path):
    again = write_field(tmp_path, coarse_fields)

    assert again.read_bytes() == field_file.read_bytes()
    assert list(tmp_path.iterdir()) == [again]


def test_the_field_is_read_as_the_mesh_of_the_wing(coarse_operators, field_file):
    mesh = read_mesh(field_file, 1.0, "m")

    assert mesh.kind is coarse_operators.wing_mesh.kind
    np.testing.assert_allclose(mesh.nodes, coarse_operators.wing_mesh.nodes, atol=1e-12)


def test_displacements_are_those_of_the_full_model(field, full_response, full_displacement):
    displacement = field.point_data["displacement"]

    _, _, upwards = displacement.T
    tolerance = 1e-3 * np.abs(full_displacement).max()
    np.testing.assert_allclose(displacement, full_displacement, atol=tolerance)
    assert upwards.max() == pytest.approx(full_response.output[0], rel=0.1)


def test_strains_are_those_of_the_full_model(coarse_operators, cell_data, full_displacement):
    in_middle = np.full((1, 3), 0.5)
    (strain,) = np.moveaxis(
        coarse_operators.wing_mesh.strains(full_displacement, local_positions=in_middle), 1, 0
    )

    _, spanwise_strain, *_ = cell_data["strain"].T
    np.testing.assert_allclose(cell_data["strain"], strain, atol=1e-2 * np.abs(strain).max())
    # compression counts as positive, as the gauges show it
    np.testing.assert_array_equal(cell_data["spanwise_strain"], -spanwise_strain)


def test_regions_and_losses_are_those_of_the_state(coarse_operators, cell_data):
    region = coarse_operators.wing_mesh.region

    losses = np.select([region == 1, region == 2], [0.3, 0.6])
    np.testing.assert_array_equal(cell_data["region"], region)
    np.testing.assert_array_equal(cell_data["stiffness_loss"], losses)


# ---------------------------------------------------------------- modes of the wing as fields


@pytest.fixture(scope="module")
def mode_fields(coarse_fields, tmp_path_factory):
    """Shapes by name, `mode_1_5.63Hz` and so on."""
    path = tmp_path_factory.mktemp("modes") / "modes.vtu"
    write_modes_vtu(path, coarse_fields, coarse_fields.nominal)
    return meshio.read(path).point_data


@pytest.fixture(scope="module")
def nominal_modes(coarse_operators):
    return natural_frequencies(coarse_operators, 6, point_masses(0.169, 0.134))


def test_all_modes_are_written_with_number_and_frequency(coarse_fields, mode_fields, nominal_modes):
    assert len(mode_fields) == coarse_fields.mode_count
    for number, name in enumerate(list(mode_fields)[:3]):
        label, frequency = name.rsplit("_", 1)
        value = float(frequency.removesuffix("Hz"))
        assert label == f"mode_{number + 1}"
        assert value == pytest.approx(nominal_modes.frequency[number], rel=1e-4)


def test_modes_are_those_of_the_full_model(coarse_operators, mode_fields, nominal_modes):
    shapes = list(mode_fields.values())[:3]
    for shape, unknowns in zip(shapes, nominal_modes.shape.T, strict=False):
        full_shape = np.abs(coarse_operators.full_displacement(unknowns))

        tolerance = 1e-2 * full_shape.max()
        np.testing.assert_allclose(np.abs(shape), full_shape, atol=tolerance)


def test_an_impossible_state_leaves_no_file(coarse_fields, tmp_path):
    with refused(OutsideModelError, "load_factor must"):
        vector = coarse_fields.vector(load_factor=np.nan)
        write_wing_vtu(tmp_path / "wing.vtu", coarse_fields, vector)

    assert list(tmp_path.iterdir()) == []


def test_a_folder_is_not_replaced_by_a_field(coarse_fields, tmp_path):
    folder = tmp_path / "folder.vtu"
    folder.mkdir()

    with refused(FileNotWrittenError, re.escape(str(folder))):
        write_wing_vtu(folder, coarse_fields, coarse_fields.vector(**FIELD_STATE))

    assert list(tmp_path.iterdir()) == [folder]
