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


def static(folder: Path, table: str) -> Path:
    head, _, _ = CAMPAIGN.partition("[[trial]]")
    trial = '[[trial]]\nname = "load"\nkind = "static"\nfile = "load.csv"\n'
    campaign(folder, head + trial)
    (folder / "load.csv").write_text(table, encoding="utf-8")
    return folder


def test_a_row_that_comes_twice_is_refused(tmp_path: Path) -> None:
    rows = "1.0,0.52\n2.0,1.03\n2.0,1.04\n"
    assert len(read_campaign(static(tmp_path / "a", "force,tip\n" + rows)).trials[0].force) == 3
    with pytest.raises(DiscrepancyError, match="lines 3 and 5 hold the same row; leave one out"):
        read_campaign(static(tmp_path / "b", "force,tip\n" + rows + "2.0,1.03\n"))
    timed = "time,force,tip\n0,2.0,1.03\n9,2.0,1.03\n"
    assert len(read_campaign(static(tmp_path / "c", timed)).trials[0].force) == 2
