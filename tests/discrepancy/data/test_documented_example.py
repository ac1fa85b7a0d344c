"""The example of docs/campaign.md is read as it stands."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from discrepancy.campaign.reading import read_campaign
from discrepancy.campaign.records import TrialKind

PAGE = Path(__file__).parents[3] / "docs" / "campaign.md"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    text = PAGE.read_text(encoding="utf-8")
    toml = re.search(r"```toml\n(.*?)```", text, re.DOTALL)
    tables = re.search(r"begin with\n\n```\n(.*?)```", text, re.DOTALL)
    (tmp_path / "campaign.toml").write_text(toml.group(1), encoding="utf-8")
    columns = [re.split(r"\s{3,}", line) for line in tables.group(1).splitlines()]
    for number, name in enumerate(("noise", "tip_up", "release_1", "turns")):
        rows = [row[number] for row in columns]
        if name in ("noise", "release_1"):  # the page shows how they begin; a record is longer
            rows += [f"{0.002 * sample:.3f},{(-1) ** sample}" for sample in range(3, 50)]
        (tmp_path / f"{name}.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    return tmp_path


def test_the_documented_campaign_is_read(folder: Path) -> None:
    campaign = read_campaign(folder)
    kinds = [TrialKind.STATIC, TrialKind.RINGDOWN, TrialKind.FLIGHT]
    assert [trial.kind for trial in campaign.trials] == kinds
    assert campaign.trials[0].values[1].tolist() == [54.1e-6, 2.98e-3]
    assert campaign.trials[0].temperature.tolist() == [1.5] * 3
    assert campaign.trials[1].release.displacement == 0.015
    assert campaign.trials[2].health[2].tolist() == [0.2, 0.0]
    assert campaign.channels["g17"].noise.source == "pre-trigger"
    assert campaign.remarks == ()
