"""The record of a whole calibration and its file: what it gives back, and what is no such file."""

from dataclasses import fields, replace

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st

from calibration.errors import CalibrationRecordError
from calibration.result.file import load_calibration, result_bytes, save_calibration
from calibration.wing.calibrate import calibrate


def test_what_it_gives(make_calibration):
    """Readings are judged by the deviations of both; errors of experiments are in half-widths."""
    result = make_calibration()
    assert result.draws_of("servo_mass").tolist() == result.samples[:, 1].tolist()
    stiffness = result.draws_of("tip_stiffness")
    assert stiffness.tolist() == result.samples[:, 5].tolist()
    assert result.draws_of("damping_beta", prior=True).size == 43
    assert result.mean("pitot_mass") == pytest.approx(result.samples[:, 2].mean())
    state = result.mean_state()
    assert state.young_modulus_factor == pytest.approx(result.samples[:, 0].mean())
    assert state.geometry.semi_span == 1.83
    assert state.stiffness_loss == ()  # healthy
    states = result.states()
    assert len(states) == 40
    told = states[7].young_modulus_factor, states[7].servo_mass, states[7].damping_beta
    assert told == (*result.samples[7, :2], result.samples[7, 4])
    with pytest.raises(
        CalibrationRecordError, match="no samples of `mass`; it has young_modulus_factor"
    ):
        result.draws_of("mass")
    (reading,) = result.readings
    off = stiffness.mean() - 682.1
    assert result.score(reading) == pytest.approx(off / np.hypot(6.5, stiffness.std(ddof=1)))
    assert result.error("load test") == pytest.approx(-abs(off) / (1.96 * 6.5))
    before = result.draws_of("tip_stiffness", prior=True).mean() - 682.1
    assert result.error("load test", prior=True) == pytest.approx(-abs(before) / (1.96 * 6.5))
    # more draws than samples keep their shares
    few = make_calibration(count=4)
    values, times = np.unique(few.stratified_draws("servo_mass", 400, 0), return_counts=True)
    np.testing.assert_array_equal(values, np.sort(few.samples[:, 1]))
    assert times.tolist() == [100, 100, 100, 100]


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
    np.testing.assert_array_equal(
        draws, result.stratified_draws("young_modulus_factor", count, seed)
    )


def test_figures_that_follow_one_another_have_no_information(make_calibration):
    """Else it is that of Gaussians: KL(N(m, s^2) | N(0, 1)) = (s^2 + m^2 - 1) / 2 - ln s for each of them."""
    made = make_calibration(count=4000)
    result = replace(made, priors=made.priors[:2], quantities=(), samples=made.samples[:, :2],
                     prior_samples=made.prior_samples[:, :2])  # fmt: skip
    assert result.information == pytest.approx(
        2.0 * (0.5 * (1.0 / 9.0 - 1.0) + np.log(3.0)), rel=0.05
    )
    line = np.column_stack([result.samples[:, 0], 1.0 - 2.0 * result.samples[:, 0]])
    assert replace(result, samples=line).information is None


def test_the_file_gives_back_everything_in_the_layout_of_arviz(tmp_path, make_calibration):
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
    with xr.open_datatree(path, engine="h5netcdf") as tree:
        assert set(tree.children) == {"prior", "posterior", "observed_data"}
        for figure in result.figures:
            variable = tree["posterior"][figure.name]
            assert variable.attrs["units"] == figure.unit
            assert figure.title in variable.attrs["long_name"]
            assert variable.dims == ("chain", "draw")
            assert tree["prior"][figure.name].shape == (1, 43)
        assert tree["observed_data"]["load"].values.tolist() == [2.5, 5.0]
        for group in tree.children.values():
            for variable in group.to_dataset().data_vars.values():
                assert {"units", "long_name"} <= set(variable.attrs)


def test_other_files_are_told(tmp_path, make_calibration):
    path = save_calibration(make_calibration(), tmp_path / "c.nc")
    whole = path.read_bytes()
    with xr.open_datatree(path, engine="h5netcdf") as tree:
        tree.load()
    tree.attrs["design"] = str(tree.attrs["design"]).replace("1.83", "1.84")
    foreign, older = (
        xr.Dataset({"x": ("t", [1.0])}),
        xr.Dataset(attrs={"schema": "uav-twin wing calibration 0"}),
    )
    for content, words in (
        (b"load,displacement\n", "cannot be read as NetCDF"),
        (foreign.to_netcdf(engine="h5netcdf"), "no calibration file, but 'uav-twin calibration 2'"),
        (older.to_netcdf(engine="h5netcdf"), "of the schema 'uav-twin wing calibration 0'"),
        (tree.to_netcdf(engine="h5netcdf"), "content does not match its hash"),
        (whole[: int(0.999 * len(whole))], r"c\.nc .*calibrate again\.$"),
        (whole[: len(whole) // 3], r"c\.nc .*calibrate again\.$"),
    ):
        path.write_bytes(bytes(content))
        with pytest.raises(CalibrationRecordError, match=words):
            load_calibration(path)
    for place, words in (
        (tmp_path, "is no file"),
        (tmp_path / "d.nc", "is not there; give the calibration"),
    ):
        with pytest.raises(CalibrationRecordError, match=words):
            load_calibration(place)


def test_what_is_no_calibration(make_calibration):
    for change, message in (
        *(({"asset": name}, "1 to 80 printable") for name in ("", "a\nb", "x" * 81)),
        ({"samples": np.full((3, 11), np.nan)}, "finite ones"),
        ({"prior_samples": np.ones((0, 11))}, "finite ones"),
    ):
        with pytest.raises(CalibrationRecordError, match=message):
            replace(make_calibration(), **change)


@pytest.mark.parametrize("seed", [-1, 2**63])
def test_a_calibration_refuses_another_seed(seed):
    with pytest.raises(CalibrationRecordError, match="`seed` must be a whole number from 0"):
        calibrate(seed=seed)
