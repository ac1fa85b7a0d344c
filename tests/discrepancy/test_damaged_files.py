"""TOML files that hold nonsense: one sentence that names file and key, before anything is computed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from discrepancy.campaign.reading import read_campaign
from discrepancy.catalogue.effect_file import effects_of_file
from discrepancy.errors import DiscrepancyError
from discrepancy.models.fmu_file import load_fmu_model
from discrepancy.models.lumped_file import SHIPPED_MODELS, load_lumped
from tests.refusals import Inputs

CAMPAIGN = Inputs(__file__).text("campaign.toml")
TABLE = "time,tip\n" + "".join(f"{0.01 * n:.2f},{10.0 - 0.1 * n:.1f}\n" for n in range(60))


def campaign(folder: Path, text: str) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "campaign.toml").write_text(text, encoding="utf-8")
    (folder / "release.csv").write_text(TABLE, encoding="utf-8")
    return folder


def test_a_campaign_with_a_byte_order_mark_is_read(tmp_path: Path) -> None:
    plain = read_campaign(campaign(tmp_path / "plain", CAMPAIGN))
    marked = read_campaign(campaign(tmp_path / "marked", "\ufeff" + CAMPAIGN))
    assert marked.channels == plain.channels
    text = (SHIPPED_MODELS / "three_mass_chain.toml").read_text(encoding="utf-8")
    (tmp_path / "model.toml").write_text("\ufeff" + text, encoding="utf-8")
    assert load_lumped(tmp_path / "model.toml") == load_lumped("three_mass_chain")


@pytest.mark.parametrize(
    "read", [lambda path: read_campaign(path.parent), load_lumped, load_fmu_model, effects_of_file]
)
@pytest.mark.parametrize("depth", [40, 3000])
def test_what_is_nested_too_deeply_is_refused(
    tmp_path: Path, read: Callable[[Path], object], depth: int
) -> None:
    path = tmp_path / "campaign.toml"
    path.write_text(f"format = 1\nkind = {'[' * depth}1{']' * depth}\n", encoding="utf-8")
    with pytest.raises(DiscrepancyError, match=r"campaign.toml is nested deeper than 32"):
        read(path)


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ('output = "tip"', 'output = "tip"\ngain_deviation = inf', "gain_deviation"),
        ('output = "tip"', 'output = "tip"\noffset_deviation = inf', "offset_deviation"),
        ('output = "tip"', 'output = "tip"\noffset_deviation = nan', "offset_deviation"),
        ("standard_deviation = 0.1", "standard_deviation = inf", "standard_deviation"),
        ("standard_deviation = 0.1", "standard_deviation = true", "standard_deviation"),
        ("standard_deviation = 0.1", "standard_deviation = 0.1, degrees_of_freedom = inf", "degrees_of_free"),
        ('unit = "mm" }', 'unit = "mm", mode_count = 0 }', "mode_count"),
        ('unit = "mm" }', 'unit = "mm", mode_count = 1000000000 }', "mode_count"),
        ('unit = "mm" }', f'unit = "mm", mode_count = 1{"0" * 40} }}', "an integer of 133 bits"),
    ],
)
def test_numbers_of_a_campaign_are_finite_and_bounded(tmp_path: Path, old: str, new: str, told: str) -> None:
    assert old in CAMPAIGN
    with pytest.raises(DiscrepancyError, match=told) as caught:
        read_campaign(campaign(tmp_path, CAMPAIGN.replace(old, new)))
    assert "\n" not in str(caught.value)


def test_a_free_zero_is_said_in_words(tmp_path: Path) -> None:
    text = CAMPAIGN.replace('output = "tip"', 'output = "tip"\noffset_deviation = "free"')
    assert read_campaign(campaign(tmp_path, text)).channels["tip"].offset_deviation == float("inf")


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("ratios = [", "ratios = [16.0, ", r"damping.ratios\[1\].*less than or equal to 3.*16"),
        ("ratios = [", "ratios = [inf, ", "damping.ratios"),
        ("deviation = ", "deviation = true #", r"parameter\[1\].deviation: a number is expected.*True"),
    ],
)
def test_numbers_of_a_lumped_model_make_sense(tmp_path: Path, old: str, new: str, told: str) -> None:
    text = (SHIPPED_MODELS / "three_mass_chain.toml").read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / "model.toml"
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(DiscrepancyError, match=told) as caught:
        load_lumped(path)
    assert "\n" not in str(caught.value)


def static(folder: Path, table: str, more: str = "") -> Path:
    head, _, _ = CAMPAIGN.partition("[[trial]]")
    trial = '[[trial]]\nname = "load"\nkind = "static"\nfile = "load.csv"\n'
    campaign(folder, more + head + trial)
    (folder / "load.csv").write_text(table, encoding="utf-8")
    return folder


def test_a_row_that_comes_twice_is_refused(tmp_path: Path) -> None:
    rows = "1.0,0.52\n2.0,1.03\n2.0,1.04\n"
    assert len(read_campaign(static(tmp_path / "a", "force,tip\n" + rows)).trials[0].force) == 3
    with pytest.raises(DiscrepancyError, match="lines 3 and 5 hold the same row; leave one out"):
        read_campaign(static(tmp_path / "b", "force,tip\n" + rows + "2.0,1.03\n"))
    timed = "time,force,tip\n0,2.0,1.03\n9,2.0,1.03\n"
    assert len(read_campaign(static(tmp_path / "c", timed)).trials[0].force) == 2


def test_no_temperature_is_below_absolute_zero(tmp_path: Path) -> None:
    with pytest.raises(DiscrepancyError, match=r"reference_temperature.*-273\.15"):
        read_campaign(static(tmp_path, "force,tip\n1.0,0.5\n", "reference_temperature = -300.0\n"))
