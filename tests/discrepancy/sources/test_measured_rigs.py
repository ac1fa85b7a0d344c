"""Rigs that others measured, and those of the documentation: their files, and what is found in them."""

import re
import subprocess
import sys
from math import pi
from pathlib import Path

import numpy as np
import pytest

from discrepancy.campaign.reading import read_campaign
from discrepancy.campaign.records import TrialKind
from discrepancy.checks.model_check import check_against_model
from discrepancy.errors import CampaignDataError, CampaignFileError
from discrepancy.model_choice import load_model
from discrepancy.sources.measured_rigs import write_rig_campaign
from discrepancy.sources.real_wing import READING_ERROR, SIGNAL, TIP
from discrepancy.system.lumped_model import LumpedModel
from discrepancy.verdict import VerdictKind
from discrepancy.workflow import investigate
from tests.command_line import said
from tests.discrepancy.rigs import chosen

PUBLISHED = Path(__file__).parents[3].parent / "shared" / "reference" / "measured"


def rig(name, folder):
    """Return campaign and model of a published rig."""
    if not (PUBLISHED / name).is_dir():
        pytest.skip(f"the published records of {name} are not beside the project")
    made = write_rig_campaign(name, PUBLISHED / name, folder / name)
    return read_campaign(made), load_model(made / "model.toml")


def is_sound(campaign, model):
    return not any(fault.fatal for fault in check_against_model(campaign, model))


def write_falls(folder, size=400):
    """Write a rest of a second and a half, a fall of 0.4 s in the middle of a record, and a second record."""
    folder.mkdir()
    time = 0.005 * np.arange(size)
    z = np.where((time > 0.6) & (time < 1.0), 0.2, 9.7)
    np.savetxt(folder / "at_rest.txt", np.column_stack((time, 0 * time, 0 * time, 9.7 + 0.01 * np.cos(time))))
    for number in (2, 10):
        table = np.column_stack((time, 0 * time, 0 * time, z))
        np.savetxt(folder / f"fall_{number}.csv", table, delimiter=",", header="t,x,y,z")
    return folder


@pytest.fixture
def converted_falls(tmp_path):
    """The folder of a campaign of two falls, and what the command said that wrote it."""
    out = tmp_path / "out"
    data = write_falls(tmp_path / "data")
    command = ["discrepancy", "convert", str(out), "--rig", "falling_phone", "--data", str(data)]
    return out, said(*command)


def test_a_converted_rig_is_a_campaign_of_its_trials(converted_falls):
    folder, printed = converted_falls
    campaign = read_campaign(folder)
    assert "2 trials" in printed
    assert is_sound(campaign, load_model(folder / "model.toml"))
    assert [trial.name for trial in campaign.trials] == ["fall_2", "fall_10"]


def test_only_the_fall_is_taken_without_its_ends(converted_falls):
    folder, _ = converted_falls
    for trial in read_campaign(folder).trials:
        np.testing.assert_allclose(trial.values, 0.2)
        assert (trial.time[0], trial.time[-1]) == pytest.approx((0.04, 0.345))


def test_what_is_not_as_published_is_refused_in_a_sentence_and_nothing_is_written(tmp_path):
    out, data = tmp_path / "out", write_falls(tmp_path / "data")
    flat = "".join(f"{0.01 * k},0,0,9.7\n" for k in range(20))
    for name, rows, words in (
        ("wing", None, "There is no rig 'wing': give one of real_wing, falling_phone, two_tanks"),
        ("two_tanks", None, r"There is no .*dataBenchmark\.csv: give the folder"),
        ("pendulum", None, r"There is no .*pd_trajectory\.csv: give the folder"),
        ("falling_phone", "0,0,0\n" * 20, r"fall_2\.csv is not as it was published: it needs the column"),
        ("falling_phone", flat, "holds no fall"),
        ("falling_phone", "0.1,0,0,0.1\n" * 20, "its times must increase"),
    ):
        if rows:
            (data / "fall_2.csv").write_text("t,x,y,z\n" + rows)
        with pytest.raises(CampaignFileError, match=words):
            write_rig_campaign(name, data, out)
    assert not out.exists()


def test_a_published_fall_is_not_a_short_record(tmp_path):
    assert is_sound(*rig("falling_phone", tmp_path))


def test_readings_at_the_end_of_the_level_sensor_are_left_out(tmp_path):
    tanks, _ = rig("two_tanks", tmp_path)
    for trial, left_out in zip(tanks.trials, (47, 37), strict=True):
        assert trial.values.shape == (1024, 1)
        assert int((~trial.used).sum()) == left_out
        assert float(trial.values[trial.used].max()) < 10.0


@pytest.mark.parametrize(("name", "held_out"), [("two_tanks", ["validation"]), ("pendulum", ["ilqr"])])
def test_a_published_record_for_validation_is_held_out(name, held_out, tmp_path):
    campaign, _ = rig(name, tmp_path)
    assert [trial.name for trial in campaign.held_out] == held_out


def test_the_published_pendulum_has_50_hz(tmp_path):
    pendulum, _ = rig("pendulum", tmp_path)
    assert [len(trial.time) for trial in pendulum.trials] == [195, 1000]
    for trial in pendulum.trials:
        assert float(np.median(np.diff(trial.time))) == pytest.approx(0.02, rel=0.01)


@pytest.mark.long
def test_the_drag_of_a_falling_phone_is_a_family_of_damping(tmp_path):
    """A law with free powers of speed and displacement fits better than quadratic drag itself."""
    effects = chosen(
        "quadratic_damping", "coulomb_friction", "cubic_stiffness", "joint_micro_slip", "clock_error"
    )
    found = investigate(*rig("falling_phone", tmp_path), effects, thorough=False)
    (effect,) = found.verdict.effects
    (law,) = effect.patch
    assert found.verdict.kind is VerdictKind.FAMILY, found.verdict.sentence
    assert (effect.place, law.velocity_exponent) == ("air", pytest.approx(2.5, abs=0.6))
    assert (found.proof.closed.trials, found.proof.closed.low > 0.9) == ("held-out", True)


@pytest.mark.long
def test_effects_that_leave_most_of_what_the_tanks_lack_are_not_named(tmp_path):
    """Of these three effects the best set is overflow and outflow, which explain a third of the gap."""
    effects = chosen("outflow", "overflow", "logger_clock")
    found = investigate(*rig("two_tanks", tmp_path), effects, thorough=False)
    assert found.verdict.kind is VerdictKind.UNEXPLAINED
    assert "It is not named, because where it was fitted it leaves" in found.verdict.text


def test_the_place_of_what_a_pendulum_lacks_is_said(tmp_path):
    effects = chosen("coulomb_friction", "quadratic_damping")
    found = investigate(*rig("pendulum", tmp_path), effects)
    assert found.verdict.kind is VerdictKind.UNEXPLAINED
    assert "is missing at pivot, and no law of the catalogue explains it: " in found.verdict.sentence
    assert found.proof is None or found.proof.closed.value < 0.5


# ---------------------------------------------------------------- the real wing's measurements


WING = Path(__file__).parents[3].parent / "shared" / "reference" / "uav_experimental_calibration"
STEP = 8.1112e-3
NOISE = 5e-5


def write_records(folder, count=4, size=795, seed=3):
    """Write ring-downs (count, size) of one motion, a zero that they share, and noise; return the zero."""
    generator = np.random.default_rng(seed)
    place = folder / "step3"
    place.mkdir(parents=True)
    time = 0.016 + STEP * np.arange(size)
    zero = 3e-4 * np.exp(-time / 2.0)
    for number in range(1, count + 1):
        wave = 8e-3 * np.exp(-0.9 * time) * np.cos(2.0 * pi * 5.6 * (time - 1e-3 * generator.normal()))
        signal = (1.0 + 0.02 * generator.normal()) * wave + zero + NOISE * generator.normal(size=size)
        table = np.column_stack((time, signal - 2e-4, signal, signal + 2e-4))
        np.savetxt(
            place / f"ringdown_trial{number}_digitised.csv",
            table,
            delimiter=",",
            header="t_s,V_low,V_mid,V_high",
        )
    return np.asarray(zero)


def wing_campaign(data, **options):
    return read_campaign(write_rig_campaign("real_wing", data, data / "campaign", **options))


def test_a_sample_is_the_mean_of_columns_without_the_shared_zero_and_noise_holds_reading_errors(tmp_path):
    write_records(tmp_path, size=500)
    plain = wing_campaign(tmp_path, detrended=False, columns=1)
    averaged = wing_campaign(tmp_path, detrended=False)
    first = plain.trials[0].values[:, 0]
    size = len(averaged.trials[0].values)
    np.testing.assert_allclose(
        averaged.trials[0].values[:, 0], first[: 4 * size].reshape(size, 4).mean(axis=1)
    )
    assert averaged.trials[0].interval == pytest.approx(4.0 * STEP, rel=1e-4)
    detrended = wing_campaign(tmp_path)
    assert abs(np.mean(detrended.trials[0].values)) < 0.1 * abs(np.mean(averaged.trials[0].values))
    record = detrended.channels[SIGNAL].noise
    # the average of four columns has half the noise; the shared zero takes little of it
    assert record.standard_deviation == pytest.approx(np.hypot(NOISE / 2.0, READING_ERROR), rel=0.08)


def test_a_folder_without_records_or_with_too_short_ones_is_refused(tmp_path):
    with pytest.raises(CampaignFileError, match="cannot be read"):
        wing_campaign(tmp_path / "nowhere")
    write_records(tmp_path / "short", size=200)
    with pytest.raises(CampaignDataError, match="60 are needed"):
        wing_campaign(tmp_path / "short")
    write_records(tmp_path / "one", count=1)
    with pytest.raises(CampaignDataError, match="two or more"):
        wing_campaign(tmp_path / "one")


@pytest.fixture
def published_wing(tmp_path):
    """The campaign of the published measurements of the wing; skips where they are not at hand."""
    if not WING.is_dir():
        pytest.skip("the published measurements are not beside the project")
    return read_campaign(write_rig_campaign("real_wing", WING, tmp_path / "campaign"))


def test_the_published_measurements_make_a_campaign(published_wing):
    kinds = [trial.kind for trial in published_wing.trials]
    assert kinds == [TrialKind.STATIC] * 2 + [TrialKind.RINGDOWN] * 5
    assert [trial.name for trial in published_wing.held_out] == ["release 3", "release 5"]


def test_the_published_loads_and_deflections_are_read(published_wing):
    loaded, unloaded = published_wing.trials[:2]
    deflections = [3.3528e-3, 7.2898e-3, 10.7442e-3, 13.7922e-3]
    np.testing.assert_allclose(loaded.force, [2.4525, 4.905, 7.3575, 9.81])
    np.testing.assert_allclose(unloaded.values[:, 0], deflections)


def test_the_published_wing_has_its_noise_and_its_modulus(published_wing):
    assert published_wing.channels[TIP].noise is not None
    assert published_wing.parameters["young_modulus_factor"] == (1.008, 0.0103)


# ---------------------------------------------------------------- the rigs of the notebook and of the cart


def named(folder, campaign):
    """Return the only effect that is named beside rivals, its place and its size."""
    model = LumpedModel.load(folder / "model.toml")
    found = investigate(read_campaign(folder / campaign), model, RIVALS, thorough=False)
    assert found.verdict.kind is VerdictKind.NAMED
    (effect,) = found.verdict.effects
    (law,) = effect.patch
    return effect.identifier, effect.place, law.coefficient


DOCS = Path(__file__).parents[3] / "docs"
RIVALS = chosen("coulomb_friction", "load_cell")


def write_rig(page, folder, campaign):
    """Write what a page gives into a folder and run its script; return its text."""
    text = (DOCS / page).read_text(encoding="utf-8")
    script, *cells = re.findall(r"```(?:{code-cell} )?python\n(.*?)```", text, re.DOTALL)
    written = [cell.removeprefix("%%writefile ").split("\n", 1) for cell in cells if cell.startswith("%%w")]
    if not cells:  # no notebook, whose script makes the folder
        (folder / campaign).mkdir()
        names = f"{campaign}/campaign.toml", "model.toml"
        written = zip(names, re.findall(r"```toml\n(.*?)```", text, re.DOTALL), strict=True)
    (folder / "make_tables.py").write_text(script, encoding="utf-8")
    subprocess.run([sys.executable, "make_tables.py"], cwd=folder, check=True)
    for name, content in written:
        (folder / name).write_text(content, encoding="utf-8")
    return text


def test_with_the_port_friction_is_named_in_the_size_that_was_hidden(tmp_path):
    """What the notebook gives, its tables made."""
    write_rig("tutorials/name_an_effect.md", tmp_path, "my_rig")
    found = named(tmp_path, "my_rig")
    # The corner of the script's friction is rounded off, that of the law is not.
    assert found == ("coulomb_friction", "slide", pytest.approx(0.16, rel=3e-3))


def test_friction_of_the_cart_is_named_in_the_size_shown_and_not_the_offset(tmp_path):
    """Its tables begin as they are shown side by side, and jitter."""
    folder, text = tmp_path, write_rig("tutorials/cart_in_ten_minutes.md", tmp_path, "my_cart")
    shown = re.search(r"my_cart/rest.csv +my_cart/ride_1.csv\n(.*?)```", text, re.DOTALL)
    columns = zip(*(line.split() for line in shown.group(1).splitlines()), strict=True)
    for name, lines in zip(("rest", "ride_1"), columns, strict=True):
        made = (folder / "my_cart" / f"{name}.csv").read_text(encoding="utf-8").splitlines()
        assert tuple(made[: len(lines)]) == lines
    for trial in read_campaign(folder / "my_cart").trials:
        steps = np.diff(trial.time)
        assert 0.015 < np.std(steps) / np.mean(steps) / np.sqrt(2.0) < 0.025
    told = re.search(r"rubs with ([\d.]+) N \(([\d.]+) to ([\d.]+)\)", text)
    value, low, high = (float(number) for number in told.groups())
    found = named(folder, "my_cart")
    assert found == ("coulomb_friction", "rail", pytest.approx(value, abs=0.2 * (high - low)))
