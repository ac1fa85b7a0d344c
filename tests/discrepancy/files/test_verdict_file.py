"""Files of a verdict: round trips to the last bit, the shipped schemas, damaged files."""

import json
from dataclasses import replace
from math import inf, nan
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

from discrepancy.campaign.records import NoiseRecord
from discrepancy.errors import VerdictFileError
from discrepancy.files import verdict as files
from discrepancy.files.residuals import read_residuals, write_residuals
from discrepancy.files.verdict import (
    StoredPatch,
    patch_effects,
    primitive_intervals,
    read_patch,
    verdict_schema,
    write_patch,
    write_verdict,
)
from discrepancy.judgement.proof import prove_effects
from discrepancy.verdict import VerdictKind
from fe.runtime.patch import (
    PRIMITIVES,
    Line,
    ModelPatch,
    PointMass,
    PowerDamping,
    PowerStiffness,
    TableStiffness,
    Window,
)
from reporting.errors import FileNotWrittenError
from tests.discrepancy.bench import Bench
from tests.discrepancy.rigs import same as alike
from tests.refusals import Inputs, refused

INPUTS = Inputs(__file__)
FITTED = Bench(amplitudes=(200.0, 150.0), held_out=(False, True)).fit(np.random.default_rng(7))
GOLDEN = INPUTS.folder / "verdict.json"
"""A verdict with one of everything, written by this version."""
STORED = files.read_verdict_file(GOLDEN)
VERDICT, ORIGIN = STORED.verdict, STORED.origin
FRICTION, MASS = VERDICT.effects
(STIFFNESS,) = VERDICT.parameters


def same(first, second):
    """Compare records with nan equal to nan."""
    return repr(first) == repr(second)


def test_the_stored_verdict_has_its_kind_and_its_numbers():
    assert (VERDICT.kind, VERDICT.log_bayes_factor) == (VerdictKind.NAMED, inf)
    assert FRICTION.parameters[0].value == 0.0123456789012345678
    assert np.isnan([FRICTION.shape[0].high, STIFFNESS.deviation, VERDICT.gates[0].statistic]).all()


def test_the_stored_effects_have_their_patches():
    law = PowerStiffness("tip", -3.0, 3.0, -1, 0.05)
    assert FRICTION.patch == ModelPatch((PowerDamping("root", 1.0 / 3.0, 0.0, 0.0, 0.1, 5e-324),))
    assert MASS.patch == ModelPatch((PointMass(0.1 + 0.2, 1.7), law))


def test_a_verdict_is_written_as_it_was(tmp_path):
    again = write_verdict(tmp_path / "again.json", VERDICT, None, ORIGIN)
    assert again.read_bytes() == GOLDEN.read_bytes()


def test_a_verdict_of_an_earlier_version_names_no_plug_ins(tmp_path):
    content = json.loads(GOLDEN.read_text(encoding="utf-8"))
    del content["provenance"]["plug_ins"]
    path = tmp_path / "earlier.json"
    path.write_text(json.dumps(content), encoding="utf-8")
    assert files.read_verdict_file(path).origin.provenance.plug_ins == {}


@pytest.mark.parametrize("has_trials_before", [True, False])
def test_a_verdict_comes_back_equal(tmp_path, has_trials_before):
    proof = prove_effects(FITTED, FITTED)
    if not has_trials_before:
        proof = replace(proof, held_out_before=None)
    back = files.read_verdict_file(write_verdict(tmp_path / "v.json", VERDICT, proof, ORIGIN))
    assert same(back.verdict, VERDICT)
    assert same(back.proof, proof)
    assert back.origin == ORIGIN


def stored_patch(*effects, draws=()):
    found = patch_effects(effects, draws)
    return StoredPatch(VerdictKind.NAMED, "Two.", found, {}, (STIFFNESS,), ORIGIN)


@pytest.fixture(scope="module")
def patch_with_draws():
    """A patch of two effects, the first of which has 4000 draws of its coefficient."""
    (law,) = FRICTION.patch
    coefficients = np.random.default_rng(1).normal(1.0 / 3.0, 0.02, 4000)
    draws = [ModelPatch((replace(law, coefficient=float(value)),)) for value in coefficients]
    return stored_patch(FRICTION, MASS, draws=(draws, ()))


@pytest.fixture
def patch_read_back(patch_with_draws, tmp_path):
    return read_patch(write_patch(tmp_path / "patch.json", patch_with_draws))


def test_a_patch_comes_back_identical(patch_with_draws, patch_read_back):
    assert same(patch_read_back, patch_with_draws)
    assert patch_read_back.patch == FRICTION.patch + MASS.patch


def test_intervals_of_a_patch_have_parameters_and_units(patch_read_back):
    friction, mass = (effect.intervals for effect in patch_read_back.effects)
    rows = [(row.primitive, row.parameter, row.unit) for row in (friction[0], *mass[:3])]
    assert rows == [
        (0, "coefficient", "N or N m"),
        (0, "mass", "kg"),
        (0, "station", "m"),
        (1, "coefficient", "N or N m"),
    ]


def test_intervals_of_a_patch_are_those_of_its_draws(patch_read_back):
    friction, mass = (effect.intervals for effect in patch_read_back.effects)
    ends = 1.0 / 3.0 + 1.645 * 0.02 * np.array([-1.0, 1.0])
    assert [friction[0].low, friction[0].high] == pytest.approx(ends, abs=2e-3)
    assert np.isnan(mass[0].low)


NUMBER = st.floats(allow_nan=False, allow_infinity=False)
VALUES = {
    float: NUMBER,
    int: st.integers(-5, 50),
    str: st.text(max_size=5),
    tuple: st.lists(NUMBER, max_size=4).map(tuple),
}

COURSE = st.sampled_from(["3 * time", "step(time - 1.5)"])

WINDOW = st.builds(
    Window, st.text(max_size=3), st.none() | st.floats(0.0, 1.0), st.none() | st.floats(2.0, 3.0)
)


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_every_primitive_with_any_numbers_survives_the_file(data, tmp_path_factory):
    primitives = []
    for kind in data.draw(st.lists(st.sampled_from(sorted(PRIMITIVES)), min_size=1, max_size=4)):
        primitive = PRIMITIVES[kind]
        values = {
            name: data.draw(COURSE if name in primitive.formula_fields else VALUES[wanted])
            for name, wanted in primitive.value_types().items()
        }
        windows = data.draw(st.lists(WINDOW, max_size=2)) if primitive.can_act_in_windows else []
        primitives.append(primitive(**values, windows=tuple(windows)))
    effect = replace(MASS, patch=ModelPatch(tuple(primitives)))
    path = tmp_path_factory.mktemp("patch") / "patch.json"
    back = read_patch(write_patch(path, stored_patch(effect))).patch
    assert back == effect.patch
    assert same(back, effect.patch)  # tells 0.0 from -0.0


def test_every_real_value_of_a_primitive_has_a_unit():
    for primitive in PRIMITIVES.values():
        assert set(primitive.units) == {
            key for key, own in primitive.value_types().items() if own in (float, tuple)
        }


def test_files_fit_their_schemas_and_every_key_is_needed():
    jsonschema = pytest.importorskip("jsonschema")
    content = json.loads(GOLDEN.read_text(encoding="utf-8"))
    schema = verdict_schema()
    jsonschema.validate(content, schema)  # checks the schema, too
    validator = jsonschema.validators.validator_for(schema)(schema)
    for key in content:
        with pytest.raises(jsonschema.ValidationError, match="required"):
            validator.validate({name: content[name] for name in content if name != key})
    with pytest.raises(jsonschema.ValidationError, match="unexpected"):
        validator.validate({**content, "further": 1})


def test_damaged_files_are_refused_in_one_sentence_and_nothing_is_written_where_it_cannot_be(tmp_path):
    path = tmp_path / "verdict.json"
    whole = GOLDEN.read_text(encoding="utf-8")
    nested = ('"remarks": [', f'"remarks": [{"[" * 3000}{"]" * 3000}, ', "nested deeper")
    cut = (whole, whole[: len(whole) // 2], "is not valid JSON")
    for old, new, words in (
        cut,
        (whole, "[]", "not a file of this kind"),
        nested,
        *INPUTS.refused("verdict"),
    ):
        assert old in whole
        path.write_text(whole.replace(old, new, 1), encoding="utf-8")
        with refused(VerdictFileError, words):
            files.read_verdict_file(path)
    with refused(VerdictFileError, "There is no file"):
        files.read_verdict_file(tmp_path / "nothing.json")
    path.write_text(whole, encoding="utf-8")
    with refused(VerdictFileError, "'uav-twin verdict 5', but 'uav-twin patch 2' is needed"):
        read_patch(path)
    path.unlink()
    wrong = replace(VERDICT, probability="sure")
    with refused(VerdictFileError, r"verdict.json cannot be written: verdict.probability"):
        write_verdict(path, wrong, None, ORIGIN)
    assert not list(tmp_path.iterdir())
    with refused(FileNotWrittenError, "is a folder"):
        write_verdict(tmp_path, VERDICT, None, ORIGIN)
    with refused(ValueError, "shorter"):
        patch_effects((FRICTION, MASS), ((),))
    other = ModelPatch((Line("g1", 50.0, 1.0, 0.0),))
    with refused(VerdictFileError, "Draw 1 of the posterior has the primitives line"):
        files.primitive_intervals(MASS.patch, (other,))


# ---------------------------------------------------------------- residuals


def test_residuals_come_back_to_the_last_bit(tmp_path):
    """With a noise record, an unknown zero, no noise record, a missing reading, a place and named regions."""
    samples = np.random.default_rng(0).standard_normal(50)
    noise = NoiseRecord(2.0, inf, samples, 0.01, "pre-trigger")
    channels = dict(FITTED.channels)
    channels["g2"] = replace(channels["g2"], noise=noise, station=0.4, offset_deviation=inf)
    channels["g3"] = replace(channels["g3"], noise=None)
    first, *others = FITTED.trials
    used = first.used.copy()
    used[3, 1] = False
    residual = first.residual.copy()
    residual[3, 1] = nan
    trial = replace(first.trial, used=used, load_place=(1.0, 0.35), regions=("web", "z2"))
    changed_first = replace(first, trial=trial, residual=residual)
    stored_parts = tuple(replace(item, sensitivity=None) for item in (changed_first, *others))
    fitted = replace(FITTED, channels=channels, trials=stored_parts)
    path = write_residuals(tmp_path / "residuals.nc", fitted, {"hypothesis": "none"})
    assert alike(fitted, read_residuals(path))


@pytest.fixture
def residual_file(tmp_path):
    return write_residuals(tmp_path / "residuals.nc", FITTED)


def tree_of(path):
    """Return the content of a file of residuals, which is closed again."""
    with xr.open_datatree(path, engine="h5netcdf") as opened:
        return opened.load()


def test_the_file_of_residuals_has_units(residual_file):
    group = tree_of(residual_file)["trial_001"].to_dataset()
    assert group["time"].attrs["units"] == "s"
    assert set(group["unit"].values) == {"1"}


def test_the_file_of_residuals_has_axes_and_names(residual_file):
    group = tree_of(residual_file)["trial_001"].to_dataset()
    assert group["residual"].dims == ("row", "channel")
    assert group.attrs["name"] == "release 1"


def write_time_that_is_not_finite(path):
    tree = tree_of(path)
    tree["trial_001/time"].values[1] = nan
    tree.to_netcdf(path, engine="h5netcdf")


def cut_in_half(path):
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])


def write_another_schema(path):
    xr.Dataset(attrs={"schema": "other"}).to_netcdf(path, engine="h5netcdf")


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (write_time_that_is_not_finite, "time is not finite"),
        (cut_in_half, "damaged"),
        (lambda path: path.write_bytes(b""), "damaged"),
        (write_another_schema, "'other'"),
        (Path.unlink, "There is no file"),
    ],
)
def test_a_damaged_file_of_residuals_is_refused(residual_file, damage, sentence):
    damage(residual_file)
    with refused(VerdictFileError, sentence):
        read_residuals(residual_file)


@pytest.mark.parametrize("number", [1, 2, 3])
def test_files_of_earlier_numbers_are_read(number, tmp_path):
    path = tmp_path / "verdict.json"
    content = json.loads(GOLDEN.read_text(encoding="utf-8"))
    content["schema"] = f"uav-twin verdict {number}"
    later = {"force": None}
    if number < 3:
        del content["model_file"]
        for row in content["verdict"]["hypotheses"]:
            del row["parameters"]
        later["parameters"] = ()
    if number < 2:
        later |= {"remainders": (), "not_fitted": ()}
    for key in later:
        del content["verdict"][key]
    path.write_text(json.dumps(content), encoding="utf-8")
    told = VERDICT if number == 3 else replace(
        VERDICT, hypotheses=tuple(replace(item, parameters=()) for item in VERDICT.hypotheses)
    )  # fmt: skip
    found = files.read_verdict_file(path)
    assert same(found.verdict, replace(told, **later))
    assert found.origin == (ORIGIN if number == 3 else replace(ORIGIN, model_file=None))


def test_an_older_proof_is_read_without_its_share_and_says_why(tmp_path):
    """Chi-square after was divided by the posterior's doubt too: its errors are read, its share is not."""
    path = write_verdict(tmp_path / "verdict.json", VERDICT, prove_effects(FITTED, FITTED), ORIGIN)
    content = json.loads(path.read_text(encoding="utf-8"))
    content["schema"] = "uav-twin verdict 4"
    content["verdict"]["explained"] = {"value": 0.998}
    for name in ("held_out_before", "held_out_after", "fitted_before", "fitted_after"):
        scores = content["proof"][name]
        scores["chi_square_per_dof"] = scores.pop("chi_square_per_sample")
        del scores["chi_square_expected"]
    for name in ("closed", "closed_reason", "effects"):
        del content["proof"][name]
    content["proof"] |= {"gap_closed": 0.998, "gap_reason": ""}
    path.write_text(json.dumps(content), encoding="utf-8")
    proof = files.read_verdict_file(path).proof
    assert proof.held_out_after.rms == prove_effects(FITTED, FITTED).held_out_after.rms
    assert proof.closed is None
    assert "of an earlier version" in proof.closed_reason


def test_each_force_of_a_table_has_its_interval():
    tables = [TableStiffness("p", (0.0, 1.0), (2.0, force)) for force in np.linspace(5.0, 7.0, 41)]
    patches = [ModelPatch((table,)) for table in tables]

    intervals = {item.parameter: item for item in primitive_intervals(patches[20], patches)}

    assert set(intervals) == {"displacements[0]", "displacements[1]", "forces[0]", "forces[1]"}
    changing = intervals["forces[1]"]
    assert (changing.value, changing.unit) == (6.0, "N or N m")
    assert (changing.low, changing.high) == pytest.approx((5.1, 6.9))
