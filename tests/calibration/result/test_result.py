"""The record of a whole calibration and its file: what it gives back, and what is not one."""

from dataclasses import fields, replace

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st

from calibration.errors import CalibrationRecordError
from calibration.result.file import load_calibration, result_bytes, save_calibration
from calibration.wing.calibrate import calibrate


@pytest.fixture(scope="module")
def calibration(make_calibration):
    return make_calibration()


@pytest.fixture(scope="module")
def samples(calibration):
    """The samples of the calibration, by the name of their figure."""
    names = [figure.name for figure in calibration.all_quantities]
    return dict(zip(names, calibration.samples.T, strict=True))


# ---------------------------------------------------------------- samples and means


@pytest.mark.parametrize("name", ["servo_mass", "tip_stiffness"])
def test_draws_are_the_samples_of_a_figure(calibration, samples, name):
    assert calibration.draws_of(name).tolist() == samples[name].tolist()


def test_draws_of_the_prior_are_its_samples(calibration):
    assert calibration.draws_of("damping_beta", prior=True).size == len(calibration.prior_samples)
    assert len(calibration.prior_samples) == 43


def test_draws_of_an_unknown_figure_are_refused(calibration):
    sentence = "no samples of `mass`; it has young_modulus_factor"

    with pytest.raises(CalibrationRecordError, match=sentence):
        calibration.draws_of("mass")


def test_the_mean_is_that_of_the_samples(calibration, samples):
    assert calibration.mean("pitot_mass") == pytest.approx(samples["pitot_mass"].mean())


def test_the_mean_state_is_healthy_with_the_measured_geometry(calibration, samples):
    state = calibration.mean_state()

    assert state.young_modulus_factor == pytest.approx(samples["young_modulus_factor"].mean())
    assert state.geometry.semi_span == 1.83
    assert state.stiffness_loss == ()


def test_each_sample_is_a_state(calibration, samples):
    states = calibration.states()

    state = states[7]
    values = (state.young_modulus_factor, state.servo_mass, state.damping_beta)
    names = ("young_modulus_factor", "servo_mass", "damping_beta")
    assert len(states) == 40
    assert values == tuple(samples[name][7] for name in names)


# ---------------------------------------------------------------- readings


def test_a_reading_is_judged_by_the_deviations_of_both(calibration, samples):
    (reading,) = calibration.readings

    score = calibration.score(reading)

    error = samples["tip_stiffness"].mean() - 682.1
    deviation = np.hypot(6.5, samples["tip_stiffness"].std(ddof=1))
    assert score == pytest.approx(error / deviation)


@pytest.mark.parametrize("prior", [False, True])
def test_the_error_of_an_experiment_is_in_half_widths_of_its_interval(calibration, prior):
    """It is negative, so that the best calibration has the largest one."""
    stiffness = calibration.draws_of("tip_stiffness", prior=prior)

    error = calibration.error("load test", prior=prior)

    assert error == pytest.approx(-abs(stiffness.mean() - 682.1) / (1.96 * 6.5))


# ---------------------------------------------------------------- stratified draws


@given(count=st.integers(1, 60), seed=st.integers(0, 5))
def test_stratified_draws_take_one_sample_from_each_stratum(make_calibration, count, seed):
    """As many draws as samples are all samples, shuffled.

    Fewer draws are one of each group of neighbours.
    """
    calibration = make_calibration(count=60)

    draws = calibration.stratified_draws("young_modulus_factor", count, seed)

    ordered_draws = np.sort(draws)
    ordered_samples = np.sort(calibration.draws_of("young_modulus_factor"))
    rank = np.searchsorted(ordered_samples, ordered_draws)
    np.testing.assert_array_equal(ordered_samples[rank], ordered_draws)
    # stratum i of n covers the samples from 60 i / n to 60 (i + 1) / n, edges shared
    edge = 60.0 * np.arange(count + 1) / count
    assert np.all(rank >= np.floor(edge[:-1]))
    assert np.all(rank <= np.ceil(edge[1:]) - 1)


@given(count=st.integers(1, 60), seed=st.integers(0, 5))
def test_stratified_draws_repeat_with_their_seed(calibration, count, seed):
    draws = calibration.stratified_draws("young_modulus_factor", count, seed)

    again = calibration.stratified_draws("young_modulus_factor", count, seed)
    np.testing.assert_array_equal(draws, again)


def test_more_draws_than_samples_take_each_sample_equally_often(make_calibration):
    calibration = make_calibration(count=4)

    draws = calibration.stratified_draws("servo_mass", 400, 0)

    values, counts = np.unique(draws, return_counts=True)
    np.testing.assert_array_equal(values, np.sort(calibration.draws_of("servo_mass")))
    assert counts.tolist() == [100, 100, 100, 100]


# ---------------------------------------------------------------- information


@pytest.fixture(scope="module")
def two_figures(make_calibration):
    """A calibration of two independent figures, whose prior is three times as wide."""
    calibration = make_calibration(count=4000)
    first_two = slice(2)
    return replace(
        calibration,
        priors=calibration.priors[first_two],
        quantities=(),
        samples=calibration.samples[:, first_two],
        prior_samples=calibration.prior_samples[:, first_two],
    )


def test_information_is_that_of_gaussians(two_figures):
    """KL(N(m, s^2) | N(0, 1)) = (s^2 + m^2 - 1) / 2 - ln s for each of the two figures."""
    of_one_figure = 0.5 * (1.0 / 9.0 - 1.0) + np.log(3.0)

    assert two_figures.information == pytest.approx(2.0 * of_one_figure, rel=0.05)


def test_figures_that_follow_one_another_have_no_information(two_figures):
    factor = two_figures.draws_of("young_modulus_factor")
    line = np.column_stack([factor, 1.0 - 2.0 * factor])

    assert replace(two_figures, samples=line).information is None


# ---------------------------------------------------------------- the file


@pytest.fixture(scope="module")
def path(tmp_path_factory, calibration):
    """The file of the calibration, in a folder that was not there."""
    folder = tmp_path_factory.mktemp("calibration") / "deep"
    return save_calibration(calibration, folder / "calibration.nc")


@pytest.fixture(scope="module")
def file_content(path):
    """The file as xarray reads it."""
    with xr.open_datatree(path, engine="h5netcdf") as tree:
        tree.load()
    return tree


def test_the_bytes_of_a_file_follow_from_its_record(calibration, path):
    assert path.read_bytes() == result_bytes(calibration)
    assert path.read_bytes() == result_bytes(load_calibration(path))
    assert result_bytes(replace(calibration, seed=6)) != result_bytes(calibration)


def test_the_file_gives_back_everything(calibration, path):
    read = load_calibration(path)

    for field in fields(calibration):
        written_value = getattr(calibration, field.name)
        read_value = getattr(read, field.name)
        if field.name == "measured":
            xr.testing.assert_identical(written_value, read_value)
        elif isinstance(written_value, np.ndarray):
            np.testing.assert_array_equal(written_value, read_value)
        else:
            assert written_value == read_value, field.name


def test_the_file_has_the_groups_of_arviz(file_content):
    assert set(file_content.children) == {"prior", "posterior", "observed_data"}


def test_figures_of_the_file_have_chains_and_draws(calibration, file_content):
    for figure in calibration.all_quantities:
        assert file_content["posterior"][figure.name].dims == ("chain", "draw")
        assert file_content["prior"][figure.name].shape == (1, 43)


def test_figures_of_the_file_have_their_unit_and_title(calibration, file_content):
    for figure in calibration.all_quantities:
        attributes = file_content["posterior"][figure.name].attrs
        assert attributes["units"] == figure.unit
        assert figure.title in attributes["long_name"]


def test_the_file_holds_what_was_measured(file_content):
    assert file_content["observed_data"]["load"].values.tolist() == [2.5, 5.0]


def test_all_variables_of_the_file_have_unit_and_name(file_content):
    for group in file_content.children.values():
        for variable in group.to_dataset().data_vars.values():
            assert {"units", "long_name"} <= set(variable.attrs)


# ---------------------------------------------------------------- other files


def make_foreign_file(_):
    dataset = xr.Dataset({"x": ("t", [1.0])})
    return dataset.to_netcdf(engine="h5netcdf")


def make_file_of_older_schema(_):
    dataset = xr.Dataset(attrs={"schema": "uav-twin wing calibration 0"})
    return dataset.to_netcdf(engine="h5netcdf")


def change_design(path):
    """Return the content of a file whose design was changed by hand."""
    with xr.open_datatree(path, engine="h5netcdf") as tree:
        tree.load()
    tree.attrs["design"] = str(tree.attrs["design"]).replace("1.83", "1.84")
    return tree.to_netcdf(engine="h5netcdf")


def cut_off(path, fraction):
    content = path.read_bytes()
    return content[: int(fraction * len(content))]


DAMAGES = {
    "text": (lambda _: b"load,displacement\n", "cannot be read as NetCDF"),
    "foreign": (make_foreign_file, "is not a calibration file, but 'uav-twin calibration 2'"),
    "older": (make_file_of_older_schema, "of the schema 'uav-twin wing calibration 0'"),
    "changed": (change_design, "content does not match its hash"),
    "nearly whole": (lambda path: cut_off(path, 0.999), r"c\.nc .*calibrate again\.$"),
    "a third": (lambda path: cut_off(path, 1 / 3), r"c\.nc .*calibrate again\.$"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_another_file_is_refused_with_its_reason(tmp_path, path, damage):
    make_content, sentence = DAMAGES[damage]
    other = tmp_path / "c.nc"
    other.write_bytes(bytes(make_content(path)))

    with pytest.raises(CalibrationRecordError, match=sentence):
        load_calibration(other)


def test_a_folder_is_no_calibration(tmp_path):
    with pytest.raises(CalibrationRecordError, match="is not a file"):
        load_calibration(tmp_path)


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(CalibrationRecordError, match="is missing; give the calibration"):
        load_calibration(tmp_path / "d.nc")


@pytest.mark.parametrize("name", ["", "a\nb", "x" * 81])
def test_a_calibration_needs_a_printable_name(calibration, name):
    with pytest.raises(CalibrationRecordError, match="1 to 80 printable"):
        replace(calibration, asset=name)


@pytest.mark.parametrize(
    "change",
    [{"samples": np.full((3, 11), np.nan)}, {"prior_samples": np.ones((0, 11))}],
    ids=["not a number", "empty"],
)
def test_a_calibration_needs_finite_samples(calibration, change):
    with pytest.raises(CalibrationRecordError, match="finite samples"):
        replace(calibration, **change)


@pytest.mark.parametrize("seed", [-1, 2**63])
def test_a_calibration_refuses_another_seed(seed):
    with pytest.raises(CalibrationRecordError, match="`seed` must be a whole number from 0"):
        calibrate(seed=seed)
