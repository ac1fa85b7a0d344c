"""What verdicts are worth."""

import json
from typing import Any

import pytest
from scipy.stats import binomtest

from benchmarks.blind.__main__ import main
from benchmarks.blind.effects import DRAWS
from benchmarks.blind.scoring import FAMILIES, Outcome, coverage, outcome, wilson
from tests.refusals import Inputs


def _truth(**given: Any) -> dict[str, Any]:
    return {"identifiers": [], "kind": "catalogue", "accepted": [], "places": {}, "truth": {}} | given


def _said(**given: Any) -> dict[str, Any]:
    return {"identifiers": []} | given


@pytest.mark.parametrize(("truth", "verdict", "wanted"), Inputs(__file__).table("outcomes.toml")["outcomes"])
def test_outcomes(truth, verdict, wanted):
    assert outcome(_truth(**truth), _said(**verdict)) is Outcome[wanted]


def test_every_effect_has_a_family():
    assert set(FAMILIES) == set(DRAWS)


def test_interval_is_compared_at_the_port_where_the_effect_was_named():
    truth = _truth(identifiers=["quadratic_damping"], places={"quadratic_damping": "planform"})
    truth["truth"] = {
        "quadratic_damping.coefficient@planform": 3.0,
        "quadratic_damping.coefficient@span": 10.0,
        "quadratic_damping.coefficient@tip": 0.5,
    }
    name = "quadratic_damping.coefficient"
    for port, low, high, wanted in (
        ("span", 9.0, 11.0, True), ("span", 0.4, 0.6, False), ("tip", 0.4, 0.6, True), ("", 9.0, 11.0, None),
        ("planform", 2.0, 4.0, True), ("planform", 9.0, 11.0, False),
    ):  # fmt: skip
        verdict = _said(kind="named", estimates={name: [low, 1.0, high]}, places={"quadratic_damping": port})
        assert coverage(truth, verdict) == {name: wanted}
    local = _truth(
        identifiers=["free_play"], places={"free_play": "root"}, truth={"free_play.stiffness": 4.0}
    )
    estimates = {"free_play.stiffness": [3.0, 4.0, 5.0], "gauge_gain.gain": [0.0, 0.1, 0.2]}
    for place, wanted in (("root", True), ("tip", None)):
        verdict = _said(kind="named", estimates=estimates, places={"free_play": place})
        assert coverage(local, verdict) == {"free_play.stiffness": wanted}


@pytest.mark.parametrize(("hits", "count"), [(0, 10), (10, 10), (97, 100), (1, 3)])
def test_interval_of_a_share(hits, count):
    wanted = binomtest(hits, count).proportion_ci(method="wilson")
    assert wilson(hits, count) == pytest.approx((wanted.low, wanted.high), abs=1e-6)


@pytest.mark.long
def test_command_line(tmp_path, capsys):
    out = ["--out", str(tmp_path)]
    sizes = ["--count-per-effect", "0", "--nulls", "4", "--pairs", "0", "--outside", "0", "--traps", "0"]
    assert main(["generate", *out, *sizes, "--seed", "7", "--rigs", "lumped", "--jobs", "1"]) == 0
    sealed = sorted((tmp_path / "sealed").glob("*.json"))
    assert len(sealed) == len(list((tmp_path / "campaigns").iterdir())) >= 2
    assert main(["score", *out]) == 2
    (tmp_path / "verdicts").mkdir()
    for file in sealed:
        truth = json.loads(file.read_text(encoding="utf-8"))
        names = truth["identifiers"]
        verdict = _said(
            kind="named" if names else "nothing missing", identifiers=names, gap_closed=0.95, seconds=1.0
        )
        (tmp_path / "verdicts" / file.name).write_text(json.dumps(verdict), encoding="utf-8")
    capsys.readouterr()
    assert main(["score", *out]) == 0
    page = capsys.readouterr().out
    assert (tmp_path / "score.md").read_text(encoding="utf-8") in page
    assert "| Nothing hidden | lumped |" in page
    assert "100.0 %" in page
