"""The record of a whole calibration and its file: what it gives back, and what is no such file."""

from collections.abc import Callable
from dataclasses import fields, replace

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st

from calibration.errors import CalibrationRecordError
from calibration.result.file import load_calibration, result_bytes, save_calibration
from calibration.result.record import Calibration

MakeCalibration = Callable[..., Calibration]


def test_what_it_gives(make_calibration):
    result = make_calibration()
    assert result.draws_of("servo_mass").tolist() == result.samples[:, 1].tolist()
    assert result.draws_of("tip_stiffness").tolist() == result.samples[:, 5].tolist()
    assert result.draws_of("damping_beta", prior=True).size == 43
    assert result.mean("pitot_mass") == pytest.approx(result.samples[:, 2].mean())
    state = result.mean_state()
    assert state.young_modulus_factor == pytest.approx(result.samples[:, 0].mean())
    assert state.geometry.semi_span == 1.83
    assert state.stiffness_loss == ()  # healthy
    states = result.states()
    assert len(states) == 40
    assert [states[7].young_modulus_factor, states[7].servo_mass, states[7].damping_beta] == [
        *result.samples[7, :2], result.samples[7, 4],
    ]  # fmt: skip
    with pytest.raises(CalibrationRecordError, match="no samples of `mass`; it has young_modulus_factor"):
        result.draws_of("mass")
    with pytest.raises(ValueError, match="read-only"):
        result.samples[0, 0] = 0.0


@given(count=st.integers(1, 60), seed=st.integers(0, 5))
def test_stratified_draws_take_one_sample_from_each_stratum(make_calibration, count, seed):
    """As many draws as samples are all samples, shuffled; fewer are one of each group of neighbours."""
    result = make_calibration(count=60)
    draws = result.stratified_draws("young_modulus_factor", count, seed)
    ordered = np.sort(result.samples[:, 0])
    place = np.searchsorted(ordered, np.sort(draws))
    np.testing.assert_array_equal(ordered[place], np.sort(draws))
    # stratum i of n covers the samples from 60 i / n to 60 (i + 1) / n, edges shared
    edge = 60.0 * np.arange(count + 1) / count
    assert np.all(place >= np.floor(edge[:-1]))
    assert np.all(place <= np.ceil(edge[1:]) - 1)
    np.testing.assert_array_equal(draws, result.stratified_draws("young_modulus_factor", count, seed))


def test_more_draws_than_samples_keep_their_shares(make_calibration):
    result = make_calibration(count=4)
    values, times = np.unique(result.stratified_draws("servo_mass", 400, 0), return_counts=True)
    np.testing.assert_array_equal(values, np.sort(result.samples[:, 1]))
    assert times.tolist() == [100, 100, 100, 100]


def test_readings_are_judged_by_the_deviations_of_both(make_calibration):
    """And the error of an experiment is in half-widths of its readings, as the paper's reward has it."""
    result = make_calibration()
    (reading,) = result.readings
    stiffness = result.draws_of("tip_stiffness")
    off = stiffness.mean() - 682.1
    assert result.score(reading) == pytest.approx(off / np.hypot(6.5, stiffness.std(ddof=1)))
    assert result.error("load test") == pytest.approx(-abs(off) / (1.96 * 6.5))
    before = result.draws_of("tip_stiffness", prior=True).mean() - 682.1
    assert result.error("load test", prior=True) == pytest.approx(-abs(before) / (1.96 * 6.5))


def test_figures_that_follow_one_another_have_no_information(make_calibration):
    """Else it is that of Gaussians: KL(N(m, s^2) | N(0, 1)) = (s^2 + m^2 - 1) / 2 - ln s for each of them."""
    made = make_calibration(count=4000)
    result = replace(made, priors=made.priors[:2], quantities=(), samples=made.samples[:, :2],
                     prior_samples=made.prior_samples[:, :2])  # fmt: skip
    assert result.information == pytest.approx(2.0 * (0.5 * (1.0 / 9.0 - 1.0) + np.log(3.0)), rel=0.05)
    line = np.column_stack([result.samples[:, 0], 1.0 - 2.0 * result.samples[:, 0]])
    assert replace(result, samples=line).information is None


def test_the_file_gives_back_everything(tmp_path, make_calibration):
    result = make_calibration()
    path = save_calibration(result, tmp_path / "deep" / "calibration.nc")
    found = load_calibration(path)
    assert path.read_bytes() == result_bytes(result) == result_bytes(found)
    for field in fields(result):
        value, again = getattr(result, field.name), getattr(found, field.name)
        if field.name == "measured":
            xr.testing.assert_identical(value, again)
        elif isinstance(value, np.ndarray):
            np.testing.assert_array_equal(value, again)
        else:
            assert value == again, field.name
    assert result_bytes(replace(result, seed=6)) != result_bytes(result)


def test_the_file_has_the_layout_of_arviz(tmp_path, make_calibration):
    result = make_calibration()
    path = save_calibration(result, tmp_path / "c.nc")
    with xr.open_datatree(path, engine="h5netcdf") as tree:
        tree.load()
    assert set(tree.children) == {"prior", "posterior", "observed_data"}
    for figure in result.figures:
        variable = tree["posterior"][figure.name]
        assert variable.attrs["units"] == figure.unit
        assert figure.title in variable.attrs["long_name"]
        assert variable.dims == ("chain", "draw")
        assert tree["prior"][figure.name].shape == (1, 43)
    assert tree["observed_data"]["load"].values.tolist() == [2.5, 5.0]
    for group in tree.children:
        for variable in tree[group].to_dataset().data_vars.values():
            assert {"units", "long_name"} <= set(variable.attrs)


@pytest.mark.parametrize("share", [0.0, 0.001, 0.3, 0.9, 0.999])
def test_a_file_cut_off_is_one_sentence(tmp_path, share, make_calibration):
    content = result_bytes(make_calibration())
    path = tmp_path / "c.nc"
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(CalibrationRecordError, match=r"c\.nc .*calibrate again\.$"):
        load_calibration(path)


def test_a_flipped_bit_never_passes(tmp_path, make_calibration):
    """A flip is refused, or lies in bytes that mean nothing; it never gives another calibration."""
    content = result_bytes(make_calibration())
    refused = 0
    for place in np.random.default_rng(3).integers(0, len(content), 15).tolist():
        damaged = bytearray(content)
        damaged[place] ^= 0x10
        path = tmp_path / "c.nc"
        path.write_bytes(damaged)
        try:
            found = load_calibration(path)
        except CalibrationRecordError:
            refused += 1
        else:
            assert result_bytes(found) == content, place
    assert refused > 5


def test_other_files_are_told(tmp_path):
    with pytest.raises(CalibrationRecordError, match="is not there; give the calibration"):
        load_calibration(tmp_path / "no.nc")
    with pytest.raises(CalibrationRecordError, match="is no file"):
        load_calibration(tmp_path)
    text = tmp_path / "text.nc"
    text.write_text("load,displacement\n", encoding="utf-8")
    with pytest.raises(CalibrationRecordError, match="cannot be read as NetCDF"):
        load_calibration(text)
    foreign = tmp_path / "foreign.nc"
    xr.Dataset({"x": ("t", [1.0])}).to_netcdf(foreign, engine="h5netcdf")
    with pytest.raises(CalibrationRecordError, match="no calibration file, but 'uav-twin calibration 2'"):
        load_calibration(foreign)
    older = tmp_path / "older.nc"
    xr.Dataset(attrs={"schema": "uav-twin wing calibration 0"}).to_netcdf(older, engine="h5netcdf")
    with pytest.raises(CalibrationRecordError, match="of the schema 'uav-twin wing calibration 0'"):
        load_calibration(older)


def test_a_changed_design_does_not_pass(tmp_path, make_calibration):
    path = save_calibration(make_calibration(), tmp_path / "c.nc")
    with xr.open_datatree(path, engine="h5netcdf") as tree:
        tree.load()
    tree.attrs["design"] = str(tree.attrs["design"]).replace("1.83", "1.84")
    changed = tmp_path / "changed.nc"
    changed.write_bytes(bytes(tree.to_netcdf(engine="h5netcdf")))
    with pytest.raises(CalibrationRecordError, match="content does not match its hash"):
        load_calibration(changed)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"asset": ""}, "1 to 80 printable"),
        ({"asset": "a\nb"}, "1 to 80 printable"),
        ({"asset": "x" * 81}, "1 to 80 printable"),
        ({"procedure": "other"}, "one of quadrature"),
        ({"samples": np.ones((3, 4))}, r"samples must have the shape \(N, 11\)"),
        ({"prior_samples": np.full((43, 11), np.nan)}, "not finite"),
        ({"samples": np.ones((0, 11))}, "shape"),
    ],
)
def test_what_is_no_calibration(change, message, make_calibration):
    with pytest.raises(CalibrationRecordError, match=message):
        replace(make_calibration(), **change)
