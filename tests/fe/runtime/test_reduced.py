"""The reduced model against the full one, on a coarse mesh of the shipped wing."""

import ast
import io
import shutil
import subprocess
import sys
import zipfile
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import fe.runtime.kept_arrays
from fe.full.statics import Factorisation
from fe.reduction.reduced_basis import Reduction
from fe.runtime.errors import OutsideModelError, ReducedModelFileError
from fe.runtime.kept_arrays import arrays_from_bytes, arrays_to_bytes
from fe.runtime.reduced import ReducedModel
from fe.wing.operators import AffineOperators
from fe.wing.responses import eigenmodes, static_outputs, tip_stiffness

PACKAGE = Path(fe.runtime.kept_arrays.__file__).parent

# The corners and edges of the box count most; the rest is anywhere inside.
young_modulus_factors = st.sampled_from((0.9, 1.0, 1.1)) | st.floats(0.9, 1.1)
losses = st.sampled_from((0.0, 0.8)) | st.floats(0.0, 0.8)
# Loads so small that their squares underflow are left out.
load_factors = st.sampled_from((-4.0, 0.0, 3.0, 6.0)) | st.floats(1e-9, 6.0)
tip_forces = st.sampled_from((-100.0, 0.0, 100.0)) | st.floats(-100.0, -1e-9)


@pytest.fixture(scope="module")
def model(coarse_reduction: Reduction) -> ReducedModel:
    return coarse_reduction.model


def test_bound_holds_and_error_is_small(coarse_operators: AffineOperators, model: ReducedModel) -> None:
    @settings(max_examples=15, deadline=None)
    @given(e=young_modulus_factors, z1=losses, z2=losses, load_factor=load_factors, tip_force=tip_forces)
    def holds(e: float, z1: float, z2: float, load_factor: float, tip_force: float) -> None:
        factors = Factorisation(coarse_operators.stiffness({"young_modulus_factor": e}, (z1, z2)))
        loads = np.stack((coarse_operators.load_lift, coarse_operators.load_tip), axis=1)
        unit_solutions = factors.solve(loads)
        full = static_outputs(coarse_operators, unit_solutions @ np.array((load_factor, tip_force)))
        reduced = model.static_response(
            young_modulus_factor=e, stiffness_loss=(z1, z2), load_factor=load_factor, tip_force=tip_force
        )

        assert np.abs(reduced.strain - full.strain).max() <= reduced.strain_error_bound
        tip_error = abs(reduced.displacement[0] - full.tip_displacement)
        assert tip_error <= reduced.displacement_error_bound

        # combined loads may nearly cancel, so the scale is that of each load alone
        strains = np.abs(coarse_operators.gauge_output @ unit_solutions).max(axis=0)
        scale = abs(load_factor) * strains[0] + abs(tip_force) * strains[1]
        assert reduced.strain_error_bound <= 1e-3 * scale + 1e-300
        tips = np.abs(coarse_operators.tip_row @ unit_solutions)
        assert reduced.displacement_error_bound <= 1e-3 * (
            abs(load_factor) * tips[0] + abs(tip_force) * tips[1] + 1e-300
        )

    holds()


@pytest.mark.parametrize(("e", "z"), [(0.9, (0.8, 0.8)), (1.1, (0.0, 0.0)), (1.0, (0.1, 0.7))])
def test_tip_stiffness_is_that_of_the_full_model(
    coarse_operators: AffineOperators, model: ReducedModel, e: float, z: tuple[float, float]
) -> None:
    assert model.tip_stiffness(e, z) == pytest.approx(tip_stiffness(coarse_operators, e, z), rel=1e-5)


@given(e=young_modulus_factors, z1=st.floats(0.0, 0.7), z2=st.floats(0.0, 0.7), more=st.floats(0.02, 0.1))
def test_wing_is_softer_with_more_damage_and_less_skin(
    model: ReducedModel, e: float, z1: float, z2: float, more: float
) -> None:
    stiffness = model.tip_stiffness(e, (z1, z2))
    assert model.tip_stiffness(e, (z1 + more, z2)) < stiffness
    assert model.tip_stiffness(e, (z1, z2 + more)) < stiffness
    assert model.tip_stiffness(max(e - more, 0.9), (z1, z2)) <= stiffness


@given(e=young_modulus_factors, z1=losses, z2=losses, load_factor=load_factors, tip_force=tip_forces)
def test_response_is_linear_in_the_loads(
    model: ReducedModel, e: float, z1: float, z2: float, load_factor: float, tip_force: float
) -> None:
    lift = model.static_response(young_modulus_factor=e, stiffness_loss=(z1, z2), load_factor=1.0).strain
    tip = model.static_response(
        young_modulus_factor=e, stiffness_loss=(z1, z2), load_factor=0.0, tip_force=1.0
    ).strain
    both = model.static_response(
        young_modulus_factor=e, stiffness_loss=(z1, z2), load_factor=load_factor, tip_force=tip_force
    ).strain
    np.testing.assert_allclose(both, load_factor * lift + tip_force * tip, rtol=0.0, atol=1e-14)


def test_no_load_gives_no_strain_and_no_bound(model: ReducedModel) -> None:
    response = model.static_response(young_modulus_factor=1.0, stiffness_loss=(0.2, 0.3), load_factor=0.0)
    assert not response.strain.any()
    assert response.strain_error_bound == 0.0
    assert response.displacement[0] == 0.0


def test_many_states_at_once_equal_one_by_one(model: ReducedModel) -> None:
    random = np.random.default_rng(3)
    e, z, n, f = (
        random.uniform(0.9, 1.1, 40),
        random.uniform(0, 0.8, (40, 2)),
        np.full(40, 3.0),
        np.arange(40.0),
    )
    one_by_one = [
        model.static_response(young_modulus_factor=a, stiffness_loss=b, load_factor=c, tip_force=d).strain
        for a, b, c, d in zip(e, z, n, f, strict=True)
    ]
    columns = {"young_modulus_factor": e, "z1": z[:, 0], "z2": z[:, 1], "load_factor": n, "tip_force": f}
    outputs = model.static_outputs(model.vectors(columns))
    np.testing.assert_allclose(outputs[:, :-1], one_by_one, rtol=1e-11, atol=1e-16)
    np.testing.assert_array_equal(
        model.static_outputs(model.vectors({"z1": z[:, 0], "z2": z[:, 1], "load_factor": 3.0})),
        model.static_outputs(
            model.vectors({**columns, "young_modulus_factor": np.ones(40), "tip_force": np.zeros(40)})
        ),
    )
    assert model.static_outputs(model.vectors({"z1": 0.1})).shape == (1, model.gauge_count + 1)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf"), 1e9, -1e9])
@pytest.mark.parametrize("name", ["young_modulus_factor", "z1", "z2", "load_factor", "tip_force"])
def test_statics_outside_validity_are_refused_by_name(model: ReducedModel, name: str, bad: float) -> None:
    values = {
        "young_modulus_factor": 1.0,
        "z1": 0.1,
        "z2": 0.1,
        "load_factor": 3.0,
        "tip_force": 0.0,
        name: bad,
    }
    with pytest.raises(OutsideModelError, match=rf"^{name} must lie between"):
        model.static_response(values)
    with pytest.raises(OutsideModelError, match=rf"^{name} must lie between"):
        model.static_outputs(np.stack((model.nominal, model.vector(values))))


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -1.0])
@pytest.mark.parametrize("name", ["young_modulus_factor", "z1", "z2", "servo_mass", "pitot_mass"])
def test_modes_outside_validity_are_refused_by_name(model: ReducedModel, name: str, bad: float) -> None:
    values = {
        "young_modulus_factor": 1.0,
        "z1": 0.1,
        "z2": 0.1,
        "servo_mass": 0.17,
        "pitot_mass": 0.13,
        name: bad,
    }
    with pytest.raises(OutsideModelError, match=rf"^{name} must lie between"):
        model.modes(values)


def test_all_corners_of_the_box_are_inside(model: ReducedModel) -> None:
    box = model.validity
    assert set(box) == {
        "young_modulus_factor", "z1", "z2", "load_factor", "tip_force", "servo_mass", "pitot_mass",
    }  # fmt: skip
    for end in (0, 1):
        corner = {name: limits[end] for name, limits in box.items()}
        model.static_response(corner)
        model.modes(corner)


@pytest.mark.parametrize("state", [(1.0, (0.0, 0.0)), (0.95, (0.3, 0.7)), (1.1, (0.8, 0.8))])
def test_the_bound_allows_for_rounding(model: ReducedModel, state: tuple[float, tuple[float, float]]) -> None:
    # Residuals do not show what rounding does to the solution itself, of which 5e-6 is the least allowed for.
    assert model.rounding_allowance >= 5e-6
    e, loss = state
    chosen = model.vector({"load_factor": 3.0, "tip_force": 5.0}, loss, young_modulus_factor=e)
    response = model.static_response(chosen)
    without = replace(model, rounding_allowance=0.0).static_response(chosen)
    strain, tip = np.linalg.norm(response.strain), abs(response.displacement[0])
    assert response.strain_error_bound >= 5e-6 * strain
    assert response.displacement_error_bound >= 5e-6 * tip
    assert response.strain_error_bound - without.strain_error_bound == pytest.approx(
        model.rounding_allowance * strain, rel=1e-9
    )
    assert response.displacement_error_bound - without.displacement_error_bound == pytest.approx(
        model.rounding_allowance * tip, rel=1e-9
    )


STATES = [
    (1.0, (0.0, 0.0), 0.169, 0.134),
    (0.9, (0.8, 0.8), 0.30, 0.0),
    (1.1, (0.0, 0.8), 0.05, 0.30),
    (0.97, (0.35, 0.6), 0.21, 0.07),
    (1.04, (0.8, 0.15), 0.05, 0.0),
]


def _masses(
    model: ReducedModel, e: float, loss: tuple[float, float], servo: float, pitot: float
) -> np.ndarray:
    return model.vector(
        {"young_modulus_factor": e, "servo_mass": servo, "pitot_mass": pitot}, stiffness_loss=loss
    )


@pytest.mark.parametrize("state", STATES)
def test_modes_are_those_of_the_full_model(
    coarse_operators: AffineOperators,
    model: ReducedModel,
    state: tuple[float, tuple[float, float], float, float],
) -> None:
    full = eigenmodes(coarse_operators, *state)
    reduced = model.modes(_masses(model, *state))
    relative = reduced.frequency / full.frequency[: model.mode_count] - 1.0
    assert np.all(relative > -1e-6)  # a projection can only be stiffer
    assert np.all(relative < 1e-4)
    assert reduced.followed == tuple(full.flapwise_bending)
    assert min(reduced.followed_mac) > 0.8  # far more than any other mode could have
    for index in reduced.followed:
        np.testing.assert_allclose(reduced.output[-1, index], full.tip_displacement[index], rtol=3e-3)
        np.testing.assert_allclose(
            reduced.output[:-1, index],
            full.strain[:, index],
            rtol=0,
            atol=1e-2 * np.abs(full.strain[:, index]).max(),
        )
        np.testing.assert_allclose(
            reduced.participation[1, index], full.load_point_displacement[index], rtol=3e-3
        )


def test_modes_are_orthonormal_in_the_mass(model: ReducedModel) -> None:
    modes = model.modes(young_modulus_factor=0.95, stiffness_loss=(0.3, 0.6), servo_mass=0.2, pitot_mass=0.1)
    np.testing.assert_allclose(modes.shape.T @ modes.mass @ modes.shape, np.eye(model.mode_count), atol=1e-11)
    assert np.all(np.diff(modes.frequency) > 0)
    assert np.all(modes.output[-1] >= 0)


def test_low_modes_keep_their_digits(model: ReducedModel) -> None:
    """Another orthonormal basis of the same space gives the same frequencies, to rounding."""
    size = model.modal_load.shape[1]
    turn = np.linalg.qr(np.random.default_rng(4).normal(size=(size, size)))[0]
    turned = replace(
        model,
        modal_stiffness=turn.T @ model.modal_stiffness @ turn,
        modal_mass=turn.T @ model.modal_mass @ turn,
        modal_load=model.modal_load @ turn,
        modal_output=model.modal_output @ turn,
        followed_shapes=model.followed_shapes @ turn,
    )
    for name in ("modal_stiffness", "modal_mass"):
        terms = getattr(model, name)
        np.testing.assert_array_equal(terms, terms.transpose(0, 2, 1))
    for state in ((1.0, (0.0, 0.0), 0.169, 0.134), (0.9, (0.8, 0.3), 0.05, 0.0), (1.1, (0.5, 0.8), 0.3, 0.3)):
        one, other = model.modes(_masses(model, *state)), turned.modes(_masses(model, *state))
        np.testing.assert_allclose(other.frequency, one.frequency, rtol=2e-13)
        np.testing.assert_allclose(other.followed_mac, one.followed_mac, rtol=1e-11)
        assert other.followed == one.followed


def test_modal_compliance_adds_up_to_the_static_one(model: ReducedModel) -> None:
    modes = model.modes(
        young_modulus_factor=1.0, stiffness_loss=(0.2, 0.2), servo_mass=0.169, pitot_mass=0.134
    )
    terms = modes.participation[1] ** 2 / (2 * np.pi * modes.frequency) ** 2
    assert 0.97 < terms.sum() * model.tip_stiffness(1.0, (0.2, 0.2)) < 1.0


def test_saved_model_comes_back_to_the_last_bit(model: ReducedModel, tmp_path: Path) -> None:
    path = tmp_path / "wing.npz"
    model.save(path)
    again = ReducedModel.load(path)
    for item in fields(model):
        if item.init:
            np.testing.assert_array_equal(getattr(again, item.name), getattr(model, item.name))
    assert again.to_bytes() == model.to_bytes() == path.read_bytes()
    assert [p.name for p in tmp_path.iterdir()] == ["wing.npz"]
    one, two = (
        model.static_response(young_modulus_factor=1.0, stiffness_loss=(0.1, 0.2), load_factor=3.0),
        again.static_response(young_modulus_factor=1.0, stiffness_loss=(0.1, 0.2), load_factor=3.0),
    )
    np.testing.assert_array_equal(one.strain, two.strain)
    assert one.strain_error_bound == two.strain_error_bound


def test_file_is_plain_and_bears_no_date(model: ReducedModel) -> None:
    with zipfile.ZipFile(io.BytesIO(model.to_bytes())) as archive:
        assert {entry.date_time for entry in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}
    with np.load(io.BytesIO(model.to_bytes()), allow_pickle=False) as arrays:
        assert str(arrays["design_hash"]) == model.design_hash


def test_damaged_files_are_refused_with_one_sentence(model: ReducedModel, tmp_path: Path) -> None:
    good = model.to_bytes()
    path = tmp_path / "wing.npz"
    spoilt = bytearray(good)
    spoilt[len(good) // 2] ^= 0xFF
    for content in (b"", b"not a zip", good[: len(good) // 2], bytes(spoilt), good[100:]):
        path.write_bytes(content)
        with pytest.raises(ReducedModelFileError, match=r"wing\.npz is not a sound archive"):
            ReducedModel.load(path)
    with pytest.raises(FileNotFoundError):
        ReducedModel.load(tmp_path / "absent.npz")


def test_incomplete_or_foreign_files_are_refused(model: ReducedModel) -> None:
    arrays = arrays_from_bytes(model.to_bytes(), "the model")
    with pytest.raises(ReducedModelFileError, match="lacks cross_mass"):
        ReducedModel.from_bytes(
            arrays_to_bytes({name: array for name, array in arrays.items() if name != "cross_mass"})
        )
    with pytest.raises(ReducedModelFileError, match=r"has the format 99"):
        ReducedModel.from_bytes(arrays_to_bytes({**arrays, "format": np.array(99)}))
    with pytest.raises(ReducedModelFileError, match="static_load"):
        ReducedModel.from_bytes(arrays_to_bytes({**arrays, "static_load": np.zeros((2, 1))}))
    with pytest.raises(ReducedModelFileError, match="finite"):
        ReducedModel.from_bytes(arrays_to_bytes({**arrays, "static_load": arrays["static_load"] * np.nan}))
    with pytest.raises(ReducedModelFileError, match="modes"):
        replace(model, mode_count=0)
    with pytest.raises(ReducedModelFileError, match="rounding_allowance"):
        replace(model, rounding_allowance=-1.0)


@pytest.mark.parametrize(
    "value", [np.array(1.0), np.array("a"), np.zeros(5), np.zeros(0), np.zeros((0, 0, 0)), np.array(1j)]
)
def test_arrays_of_a_wrong_kind_are_refused(model: ReducedModel, value: np.ndarray) -> None:
    arrays = arrays_from_bytes(model.to_bytes(), "the model")
    numbers = {"format", "mode_count", "residual_allowance", "rounding_allowance"}
    for name in set(arrays) - {item.name for item in fields(model) if item.type is str}:
        if name in numbers and value.shape == () and value.dtype.kind == "f":
            continue
        with pytest.raises(ReducedModelFileError):
            ReducedModel.from_bytes(arrays_to_bytes({**arrays, name: value}))


def test_pickles_are_never_read() -> None:
    buffer = io.BytesIO()
    np.savez(buffer, format=np.array([{"a": 1}], dtype=object))
    with pytest.raises(ReducedModelFileError):
        ReducedModel.from_bytes(buffer.getvalue())
    with pytest.raises(ValueError, match=r"[Oo]bject"):
        arrays_to_bytes({"a": np.array([{"a": 1}], dtype=object)})


def test_failed_write_leaves_the_old_file(
    model: ReducedModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "wing.npz"
    path.write_bytes(b"old")

    def full_disk(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(fe.runtime.kept_arrays.os, "fsync", full_disk)
    with pytest.raises(OSError, match="No space left"):
        model.save(path)
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["wing.npz"]


def test_runtime_files_import_only_numpy_the_standard_library_and_each_other() -> None:
    files = sorted(PACKAGE.rglob("*.py"))
    assert len(files) > 15
    for name in files:
        for node in ast.walk(ast.parse(name.read_text(encoding="utf-8"))):
            if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
                continue
            if isinstance(node, ast.Import):
                modules = [alias.name.split(".")[0] for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                modules = [str(node.module).split(".")[0]]
            elif isinstance(node, ast.ImportFrom):
                assert node.level <= len(name.relative_to(PACKAGE).parts), name
                continue
            else:
                continue
            assert set(modules) <= {"numpy", *sys.stdlib_module_names}, name


def test_copied_runtime_evaluates_the_same_without_this_package(model: ReducedModel, tmp_path: Path) -> None:
    folder = tmp_path / "copy_of_the_runtime"
    shutil.copytree(PACKAGE, folder, ignore=shutil.ignore_patterns("__pycache__"))
    model.save(tmp_path / "wing.npz")
    code = (
        "import sys; sys.path.insert(0, '.')\n"
        "from copy_of_the_runtime import transient, reduced\n"
        "model = reduced.ReducedModel.load('wing.npz')\n"
        "response = model.static_response({'z1': 0.1, 'z2': 0.2, 'load_factor': 3.0})\n"
        "assert not {'scipy', 'pymor', 'skfem', 'fe'} & set(sys.modules)\n"
        "print(*(x.hex() for x in response.strain.tolist()))\n"
    )
    result = subprocess.run(
        [sys.executable, "-I", "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    strain = [float.fromhex(word) for word in result.stdout.split()]
    np.testing.assert_allclose(
        strain,
        model.static_response(young_modulus_factor=1.0, stiffness_loss=(0.1, 0.2), load_factor=3.0).strain,
        rtol=1e-12,
    )
