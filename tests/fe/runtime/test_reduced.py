"""The reduced model against the full one, on a coarse mesh of the shipped wing."""

import ast
import shutil
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import fe.runtime.kept_arrays
from fe.full.statics import Factorisation
from fe.runtime.errors import OutsideModelError, ReducedModelFileError
from fe.runtime.kept_arrays import arrays_from_bytes, arrays_to_bytes
from fe.runtime.reduced import ReducedModel
from fe.wing.operators import AffineOperators
from fe.wing.responses import eigenmodes
from tests.wings import tip_stiffness

PACKAGE = Path(fe.runtime.kept_arrays.__file__).parent

Losses = tuple[float, float]

# The corners and edges of the box count most; the rest is anywhere inside.
young_modulus_factors = st.sampled_from((0.9, 1.0, 1.1)) | st.floats(0.9, 1.1)
losses = st.sampled_from((0.0, 0.8)) | st.floats(0.0, 0.8)
# Loads so small that their squares underflow are left out.
load_factors = st.sampled_from((-4.0, 0.0, 3.0, 6.0)) | st.floats(1e-9, 6.0)
tip_forces = st.sampled_from((-100.0, 0.0, 100.0)) | st.floats(-100.0, -1e-9)


def test_bound_holds_and_error_is_small(coarse_operators: AffineOperators, model: ReducedModel) -> None:
    @settings(max_examples=15, deadline=None)
    @given(e=young_modulus_factors, z1=losses, z2=losses, load_factor=load_factors, tip_force=tip_forces)
    def holds(e: float, z1: float, z2: float, load_factor: float, tip_force: float) -> None:
        factors = Factorisation(coarse_operators.stiffness({"young_modulus_factor": e}, (z1, z2)))
        loads = np.stack((coarse_operators.load_lift, coarse_operators.load_tip), axis=1)
        unit_solutions = factors.solve(loads)
        # of both loads at once: where they nearly cancel, a sum of two solutions has lost its digits
        full = factors.solve(loads @ np.array((load_factor, tip_force)))
        reduced = model.static_response(
            young_modulus_factor=e, stiffness_loss=(z1, z2), load_factor=load_factor, tip_force=tip_force
        )

        assert (
            np.abs(reduced.strain - coarse_operators.gauge_output @ full).max() <= reduced.strain_error_bound
        )
        assert (
            abs(reduced.displacement[0] - coarse_operators.tip_row @ full) <= reduced.displacement_error_bound
        )

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


def test_no_load_gives_no_strain_and_no_bound(model: ReducedModel) -> None:
    response = model.static_response(young_modulus_factor=1.0, stiffness_loss=(0.2, 0.3), load_factor=0.0)
    assert not response.strain.any()
    assert response.strain_error_bound == 0.0
    assert response.displacement[0] == 0.0


def test_many_states_at_once_equal_one_by_one(model: ReducedModel) -> None:
    random = np.random.default_rng(3)
    e, z = random.uniform(0.9, 1.1, 40), random.uniform(0, 0.8, (40, 2))
    losses = {"z1": z[:, 0], "z2": z[:, 1]}
    columns = {
        "young_modulus_factor": e,
        **losses,
        "load_factor": np.full(40, 3.0),
        "tip_force": np.arange(40.0),
    }
    rows = (dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True))
    outputs = model.static_outputs(model.vectors(columns))
    one_by_one = [model.static_response(row).strain for row in rows]
    np.testing.assert_allclose(outputs[:, :-1], one_by_one, rtol=1e-11, atol=1e-16)
    np.testing.assert_array_equal(
        model.static_outputs(model.vectors({**losses, "load_factor": 3.0})),
        model.static_outputs(
            model.vectors({**columns, "young_modulus_factor": np.ones(40), "tip_force": np.zeros(40)})
        ),
    )
    assert model.static_outputs(model.vectors({"z1": 0.1})).shape == (1, model.gauge_count + 1)


SHARED, LOADS, MASSES = (
    ("young_modulus_factor", "z1", "z2"),
    ("load_factor", "tip_force"),
    ("servo_mass", "pitot_mass"),
)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf"), 1e9, -1e9])
@pytest.mark.parametrize("name", SHARED + LOADS + MASSES)
def test_values_outside_validity_are_refused_by_name(model: ReducedModel, name: str, bad: float) -> None:
    vector = model.vector({name: bad})
    asked = []
    if name not in MASSES:
        asked += [(model.static_response, vector), (model.static_outputs, np.stack((model.nominal, vector)))]
    if name not in LOADS:
        asked.append((model.modes, vector))
    for ask, values in asked:
        with pytest.raises(OutsideModelError, match=rf"^{name} must lie between"):
            ask(values)


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
    for kind, seen in (("strain", response.strain), ("displacement", response.displacement[:1])):
        added = getattr(response, f"{kind}_error_bound") - getattr(without, f"{kind}_error_bound")
        assert added == pytest.approx(model.rounding_allowance * np.linalg.norm(seen), rel=1e-9)


STATES = [
    (1.0, (0.0, 0.0), 0.169, 0.134),
    (0.9, (0.8, 0.8), 0.30, 0.0),
    (1.1, (0.0, 0.8), 0.05, 0.30),
    (0.97, (0.35, 0.6), 0.21, 0.07),
    (1.04, (0.8, 0.15), 0.05, 0.0),
]


def vector_of(model: ReducedModel, e: float, loss: Losses, servo: float, pitot: float) -> np.ndarray:
    return model.vector({"young_modulus_factor": e, "servo_mass": servo, "pitot_mass": pitot}, loss)


@pytest.mark.parametrize("state", STATES)
def test_modes_are_those_of_the_full_model(
    coarse_operators: AffineOperators, model: ReducedModel, state: tuple[float, Losses, float, float]
) -> None:
    full = eigenmodes(coarse_operators, *state)
    reduced = model.modes(vector_of(model, *state))
    relative = reduced.frequency / full.frequency[: model.mode_count] - 1.0
    assert np.all(relative > -1e-6)  # a projection can only be stiffer
    assert np.all(relative < 1e-4)
    assert reduced.followed == tuple(full.flapwise_bending)
    assert min(reduced.followed_mac) > 0.8  # far more than any other mode could have
    for index in reduced.followed:
        shape = full.shape[:, index]
        np.testing.assert_allclose(reduced.output[-1, index], coarse_operators.tip_row @ shape, rtol=3e-3)
        strain, moved = coarse_operators.gauge_output @ shape, coarse_operators.load_tip @ shape
        np.testing.assert_allclose(
            reduced.output[:-1, index], strain, rtol=0, atol=1e-2 * np.abs(strain).max()
        )
        np.testing.assert_allclose(reduced.participation[1, index], moved, rtol=3e-3)


def test_modes_are_orthonormal_in_the_mass(model: ReducedModel) -> None:
    modes = model.modes(vector_of(model, 0.95, (0.3, 0.6), 0.2, 0.1))
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
        one, other = (which.modes(vector_of(model, *state)) for which in (model, turned))
        np.testing.assert_allclose(other.frequency, one.frequency, rtol=2e-13)
        np.testing.assert_allclose(other.followed_mac, one.followed_mac, rtol=1e-11)
        assert other.followed == one.followed


def test_modal_compliance_adds_up_to_the_static_one(model: ReducedModel) -> None:
    modes = model.modes(vector_of(model, 1.0, (0.2, 0.2), 0.169, 0.134))
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


def test_incomplete_damaged_or_foreign_files_are_refused(model: ReducedModel, tmp_path: Path) -> None:
    path = tmp_path / "wing.npz"
    with pytest.raises(FileNotFoundError):
        ReducedModel.load(path)
    path.write_bytes(model.to_bytes()[:1000])
    with pytest.raises(ReducedModelFileError, match=r"wing\.npz is not a sound archive"):
        ReducedModel.load(path)
    arrays = arrays_from_bytes(model.to_bytes(), "the model")
    for changes, sentence in (
        ({"cross_mass": None}, "lacks cross_mass"),
        ({"format": np.array(99)}, "has the format 99"),
        ({"static_load": np.zeros((2, 1))}, "static_load"),
        ({"static_load": arrays["static_load"] * np.nan}, "finite"),
        ({"mode_count": np.array(0)}, "modes"),
        ({"rounding_allowance": np.array(-1.0)}, "rounding_allowance"),
    ):
        wrong = {name: array for name, array in {**arrays, **changes}.items() if array is not None}
        with pytest.raises(ReducedModelFileError, match=sentence):
            ReducedModel.from_bytes(arrays_to_bytes(wrong))


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
            modules = []
            if isinstance(node, ast.Import):
                modules = [alias.name.split(".")[0] for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                modules = [str(node.module).split(".")[0]]
            elif isinstance(node, ast.ImportFrom):
                assert node.level <= len(name.relative_to(PACKAGE).parts), name
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
    here = model.static_response({"z1": 0.1, "z2": 0.2, "load_factor": 3.0})
    np.testing.assert_allclose(strain, here.strain, rtol=1e-12)
