"""The report, its folder, the choice of a model, and the workflow tried on simulated campaigns."""

from __future__ import annotations

import html
import json
import re
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import norm

from discrepancy.campaign.records import Campaign, TrialKind
from discrepancy.catalogue.entry import Setting
from discrepancy.catalogue.library import effect_by_identifier, library
from discrepancy.errors import FitError, ModelError
from discrepancy.files.document import Origin
from discrepancy.files.patch import primitive_intervals, read_patch
from discrepancy.files.residuals import read_residuals
from discrepancy.files.verdict import read_verdict
from discrepancy.judgement.conclusion import named_effects
from discrepancy.judgement.separability import CONFUSED, DETECTED, Detectability, Separability, separability
from discrepancy.location.residuals import ResidualSet
from discrepancy.model_choice import ModelKind, choose_model
from discrepancy.models.lumped import LumpedModel
from discrepancy.models.lumped_file import parse_lumped
from discrepancy.models.wing import WingModel
from discrepancy.report.check_tables import (
    confused_lines,
    group_lines,
    needs,
    neighbours,
    rows_of,
    untested_lines,
)
from discrepancy.report.content import ReportInput
from discrepancy.report.figures import draw, report_figures
from discrepancy.report.findings import add_verdict, closing_sentence
from discrepancy.report.grounds import add_gates
from discrepancy.report.page import render_report
from discrepancy.report.parameter_table import parameter_rows
from discrepancy.report.residual_figures import (
    gauge_places,
    planform_figure,
    size,
    size_by_channel,
    size_table,
)
from discrepancy.report.sizes import si_sizes, size_sentence
from discrepancy.report.text import (
    formula,
    headline,
    number,
    percent,
    probability_text,
    remainders_sentence,
    residual_sizes,
    rounded,
    shares_sentence,
)
from discrepancy.self_calibration import (
    NOTHING,
    outcome_of,
    self_calibrate,
    wilson,
    write_self_calibration,
)
from discrepancy.sources.examples import example_campaign, plan_for
from discrepancy.sources.simulated_campaigns import Simulator
from discrepancy.verdict import ExplainedShare, NotFitted, RemainderEstimate, Verdict, VerdictKind
from discrepancy.verdict_folder import VerdictContent, check_folder, write_verdict_folder
from discrepancy.workflow import Investigation, investigate, patch_draws
from fe.runtime.patch import (
    ModelPatch,
    Overflow,
    PointMass,
    PowerDamping,
    PowerStiffness,
    Primitive,
    SensorDrift,
    SensorGain,
)
from fe.wing.design import load_design
from reporting.errors import FileNotWrittenError
from reporting.page import Page
from reporting.provenance import collect_provenance
from reporting.words import listing

MODEL = "single_mass_rig"
ORIGIN = Origin("Rig", MODEL, "ab" * 32, "cd" * 32, "uav-twin discrepancy run rig", collect_provenance(0))


def measured(hidden: str = "", value: float = 0.0, kind: str = "laboratory") -> tuple[Campaign, LumpedModel]:
    """A simulated campaign of the single-mass rig."""
    model = LumpedModel.load(MODEL)
    outputs = tuple(item.name for item in model.description.output)
    plan = plan_for(model, outputs, model.description.input[0].name)
    plan = replace(plan, duration=0.5 * plan.duration)
    patch = ModelPatch()
    if hidden:
        effect = effect_by_identifier(hidden, library())
        bare = example_campaign(model, kind, 4, plan)  # type: ignore[arg-type]
        setting = Setting(bare, model, model.scales(bare))
        values = {item.name: item.prior.value(0.0) for item in effect.parameters}
        values[effect.parameters[0].name] = value
        patch = effect.patch(setting, values, effect.places(setting)[0])
    return example_campaign(model, kind, 4, plan, patch), model  # type: ignore[arg-type]


FEW = tuple(
    effect
    for effect in library()
    if effect.identifier
    in ("quadratic_damping", "coulomb_friction", "structural_damping", "gauge_gain", "load_cell", "washout")
)
"""Part of the catalogue, where the whole one would only take time."""


@pytest.fixture(scope="module")
def drag() -> Investigation:
    """Quadratic damping, hidden in ring-downs and static trials, and found."""
    campaign, model = measured("quadratic_damping", 0.01)
    return investigate(campaign, model, FEW)


@pytest.fixture(scope="module")
def able(drag: Investigation) -> Separability:
    assert drag.problem is not None
    return separability(drag.campaign, drag.model, drag.problem.setting, FEW)


# ---------------------------------------------------------------- text


@given(st.floats(-1e6, 1e6), st.floats(1e-9, 1e3))
def test_rounding_keeps_values_within_a_twentieth_of_their_spread(value: float, spread: float) -> None:
    text = rounded(value, spread)(value).replace("\N{MINUS SIGN}", "-")
    assert abs(float(text) - value) <= 0.051 * spread + 1e-9 * abs(value)


def test_numbers_that_nobody_should_read_as_certain() -> None:
    assert probability_text(1.0 - 1e-6) == "> 0.999"
    assert probability_text(1e-200) == "< 1e-99"
    assert probability_text(float("nan")) == "not known"
    assert rounded(float("nan"), 1.0)(float("nan")) == "not known"


@pytest.mark.parametrize(
    ("value", "text"),
    [(1582.6, "1,580"), (-11424.0, "\N{MINUS SIGN}11,400"), (0.98, "0.98"), (2e6, "2e+06"), (999.6, "1,000")],
)
def test_large_numbers_are_written_out(value: float, text: str) -> None:
    assert number(value) == text


def test_formulas_and_lists() -> None:
    assert formula("zeta_eq = 4 c A w^2 / (3 pi k) -> zeta") == "ζ_eq = 4 c A w² / (3 π k) → ζ"
    assert formula("x^n, beta2, multiplier mu") == "x^n, beta2, multiplier μ"
    assert listing(["a"]) == "a"
    assert listing(["a", "b", "c"]) == "a, b and c"


def test_a_headline_has_one_probability() -> None:
    named = Verdict(VerdictKind.NAMED, "The model lacks drag (probability 0.998).", 0.998, 12.0)
    assert headline(named).count("probability") == 1
    group = Verdict(VerdictKind.GROUP, "One of a, b is missing.", 0.97, 12.0)
    assert headline(group) == "One of a, b is missing (together they have the probability 0.970)."
    broken = Verdict(VerdictKind.DATA_ERROR, "Channel x is clipped.", float("nan"), float("nan"))
    assert headline(broken) == "Channel x is clipped."


# ---------------------------------------------------------------- sizes of residuals


def test_sizes_are_one_for_noise_and_follow_what_is_added(make_bench: Callable[..., object]) -> None:
    bench = make_bench(amplitudes=(200.0, 150.0))  # type: ignore[call-arg]
    residuals: ResidualSet = bench.fit(np.random.default_rng(3))  # type: ignore[attr-defined]
    channels, _, table = size_table(residuals)
    assert table.shape == (4, 3)
    assert channels == ["g1", "g2", "g3", "g4"]
    assert np.all(np.abs(table[:, :2] - 1.0) < 0.25)
    item = residuals.trials[0]
    louder = replace(item, residual=3.0 * item.residual)
    assert size(louder, 2) == pytest.approx(3.0 * size(item, 2), rel=1e-12)
    alone = ResidualSet(residuals.channels, (item,))
    assert size_by_channel(alone)["g3"] == pytest.approx(size(item, 2), rel=1e-12)


def test_gauges_lie_where_the_design_has_them(make_bench: Callable[..., object]) -> None:
    bench = make_bench()  # type: ignore[call-arg]
    residuals: ResidualSet = bench.fit(np.random.default_rng(3))  # type: ignore[attr-defined]
    design = load_design()
    channels = {
        name: replace(channel, output=f"strain[{number}]")
        for number, (name, channel) in enumerate(residuals.channels.items(), start=1)
    }
    places = gauge_places(list(channels.values()), design)
    assert list(places.values()) == list(design.gauges.positions[:4])  # gauges count from one
    own = {"g1": replace(channels["g1"], station=0.5, chord=0.2)}
    assert gauge_places(list(own.values()), design) == {"g1": (0.5, 0.2)}
    figure = planform_figure(replace(residuals, channels=channels), None, design)
    assert figure is not None
    labels = [text.get_text() for text in figure.axes[0].texts]
    assert labels == ["g1", "g2", "g3", "g4"]
    nowhere = {name: replace(channel, output="x") for name, channel in channels.items()}
    assert planform_figure(replace(residuals, channels=nowhere), None, design) is None


# ---------------------------------------------------------------- page and folder


@pytest.fixture(scope="module")
def written(drag: Investigation, able: Separability, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of that verdict."""
    folder = tmp_path_factory.mktemp("named") / "verdict"
    write_verdict_folder(folder, VerdictContent(drag, ORIGIN, able))
    return folder


def test_the_folder_of_a_named_effect(drag: Investigation, written: Path) -> None:
    assert drag.verdict.kind is VerdictKind.NAMED
    folder = written
    page = next(folder.glob("*.html")).read_text(encoding="utf-8")
    assert "quadratic aerodynamic damping" in page
    assert "F = c |v| v" in page  # the equation of the catalogue
    assert page.count("<script>") == page.count("<script") == 1
    assert not re.search(r'(?:src|href)="(?!#|data:)', page)  # self-contained
    assert str(folder.parent) not in page
    for title in ("Verdict", "Where the gap is", "Proof on held-out trials", "What this campaign can decide"):
        assert f">{title}<" in page
    assert len(set(re.findall(r'\bid="([^"]+)"', page))) == len(re.findall(r'\bid="([^"]+)"', page))
    stored = read_verdict(folder / "verdict.json")
    assert stored.verdict.sentence == drag.verdict.sentence
    patch = read_patch(folder / "patch.json")
    assert patch.patch == drag.verdict.effects[0].patch
    assert patch.verdict is VerdictKind.NAMED
    row = patch.intervals[0][0]
    assert row.low < row.value < row.high
    residuals = read_residuals(folder / "residuals.nc")
    assert len(residuals.trials) == len(drag.campaign.trials)
    pictures = {path.name for path in (folder / "figures").iterdir()}
    assert {"history.svg", "history.png", "evidence.svg", "backbone.svg", "separability.png"} <= pictures
    assert not list(folder.parent.glob(".*"))  # nothing half-written is left


def test_a_report_repeats_bit_for_bit(drag: Investigation, able: Separability, written: Path) -> None:
    intervals = read_patch(written / "patch.json").intervals
    content = ReportInput(drag, ORIGIN, able, intervals)
    figures = report_figures(content)
    page = render_report(content, draw(figures), figures)
    assert page == next(written.glob("*.html")).read_text(encoding="utf-8")


def test_a_null_has_no_patch_and_no_model_after(tmp_path: Path) -> None:
    campaign, model = measured(kind="static")
    found = investigate(campaign, model, library())
    assert found.verdict.kind is VerdictKind.NOTHING_MISSING
    report = write_verdict_folder(tmp_path / "v", VerdictContent(found, ORIGIN))
    assert not (tmp_path / "v" / "patch.json").exists()
    page = report.read_text(encoding="utf-8")
    assert "with the effect" not in page
    assert "nothing is missing" in page


def test_faults_of_the_data_are_reported_and_nothing_else(tmp_path: Path) -> None:
    campaign, model = measured(kind="static")
    wrong = tuple(replace(trial, values=1e6 * trial.values) for trial in campaign.trials)
    found = investigate(replace(campaign, trials=wrong), model, library())
    assert found.verdict.kind is VerdictKind.DATA_ERROR
    report = write_verdict_folder(tmp_path / "v", VerdictContent(found, ORIGIN))
    page = report.read_text(encoding="utf-8")
    assert found.verdict.sentence.split(",")[0] in page
    assert "Proof" not in page
    assert sorted(path.name for path in (tmp_path / "v").iterdir()) == ["report.html", "verdict.json"]


def test_a_folder_is_replaced_on_demand_only_and_only_if_it_is_a_verdict(tmp_path: Path) -> None:
    campaign, model = measured(kind="static")
    content = VerdictContent(investigate(campaign, model, library()), ORIGIN)
    folder = tmp_path / "v"
    write_verdict_folder(folder, content)
    (folder / "stray.txt").write_text("x", encoding="utf-8")
    with pytest.raises(FileNotWrittenError, match="--replace"):
        write_verdict_folder(folder, content)
    write_verdict_folder(folder, content, replace_it=True)
    assert not (folder / "stray.txt").exists()
    other = tmp_path / "thesis"
    other.mkdir()
    (other / "chapter.tex").write_text("x", encoding="utf-8")
    with pytest.raises(FileNotWrittenError, match="not touched"):
        check_folder(other, replace_it=True)
    with pytest.raises(FileNotWrittenError, match="no folder"):
        check_folder(other / "chapter.tex", replace_it=True)


def test_a_failure_while_writing_leaves_the_old_folder(
    drag: Investigation, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "v"
    folder.mkdir()
    (folder / "verdict.json").write_text("old", encoding="utf-8")

    def refuse(patch: Path, target: Path) -> str:
        raise OSError(28, "No space left on device")

    with pytest.raises(FileNotWrittenError, match="No space"):
        write_verdict_folder(folder, VerdictContent(drag, ORIGIN, pack=refuse), replace_it=True)
    assert (folder / "verdict.json").read_text(encoding="utf-8") == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["v"]


# ---------------------------------------------------------------- sizes and parameters


@pytest.mark.parametrize(
    ("primitive", "text"),
    [
        (PowerDamping("slide", 0.5, 0.0, 0.0, 1.0, 1.0), "force 0.5000 N"),
        (PowerDamping("slide", 0.5, 2.0, 0.0, 0.25, 1.0), "force 0.5000 N at 0.25 m/s"),
        (PowerStiffness("slide", 3.0, 3.0, 0, 0.01), "force 3.000 N at 0.01 m"),
        (PointMass(0.2, 0.4), "mass 0.200 kg at 0.4 m"),
        (SensorGain("displacement", 0.02), ""),
        (SensorDrift("displacement", 0.002, 10.0), "amplitude 0.002 m"),
        (SensorDrift("leaf_strain", 0.002, 10.0), ""),
        (PowerDamping("elsewhere", 0.5, 0.0, 0.0, 1.0, 1.0), "force 0.500 N or N m"),
    ],
)
def test_sizes_have_the_unit_of_their_port_or_channel(
    drag: Investigation, primitive: Primitive, text: str
) -> None:
    patch = ModelPatch((primitive,))
    found = si_sizes(patch, primitive_intervals(patch), drag.model, drag.campaign)
    assert re.sub(r"(\d\.\d*?)0+(?= )", r"\1", found) == re.sub(r"(\d\.\d*?)0+(?= )", r"\1", text)


def test_a_flow_has_the_unit_of_its_state(drag: Investigation) -> None:
    tank = """
format = 1
name = "Tank"
capacity = 2.0
conductance_part = [{ name = "outlet", matrix = 0.1 }]
output = [{ name = "level", vector = 1.0, quantity = "level" }]
port = [{ name = "outlet", vector = 1.0 }]
"""
    model = LumpedModel(parse_lumped(tomllib.loads(tank)))
    for law, text in (
        (PowerDamping("outlet", 0.5, 0.5, 0.0, 2.0, 1.0), "flow 0.500 m/s times capacity at 2 m"),
        (Overflow("outlet", 0.5, 1.5, 3.0, 2.0), "flow 0.500 m/s times capacity, level 3.000 m"),
    ):
        patch = ModelPatch((law,))
        assert si_sizes(patch, primitive_intervals(patch), model, drag.campaign) == text


def test_a_name_that_holds_its_identifier_is_said_once(drag: Investigation) -> None:
    (effect,) = drag.verdict.effects
    named = replace(effect, identifier="outflow", name="outflow by a power of the level")
    sentence = f"The nearest is outflow; {named.name} closes 74 %."
    said = headline(replace(drag.verdict, sentence=sentence, effects=(named,), hypotheses=()))
    assert said.startswith(f"The nearest is {named.name}; {named.name} closes 74 %")


def test_a_port_that_turns_has_a_moment(drag: Investigation) -> None:
    wing = WingModel.shipped()
    for port, text in (("root", "moment 0.500 N m"), ("tip", "force 0.500 N")):
        patch = ModelPatch((PowerDamping(port, 0.5, 0.0, 0.0, 1.0, 1.0),))
        assert si_sizes(patch, primitive_intervals(patch), wing, drag.campaign) == text


def test_the_headline_size_is_that_of_the_patch(drag: Investigation) -> None:
    assert drag.problem is not None
    assert drag.fit is not None
    effects = named_effects(drag.problem, drag.fit)
    draws = patch_draws(drag.problem, drag.fit, 0)
    intervals = [primitive_intervals(e.patch, d) for e, d in zip(effects, draws, strict=True)]
    sentence = size_sentence(drag, effects, intervals)
    force, low, high = (float(text) for text in re.findall(r"\d+\.\d+", sentence)[:3])
    (law,) = effects[0].patch
    assert isinstance(law, PowerDamping)
    assert force == pytest.approx(law.coefficient, rel=1e-2)
    assert low < force < high
    assert "m/s; 90 % intervals" in sentence


def test_a_verdict_begins_with_what_is_missing_how_large_and_what_is_left(drag: Investigation) -> None:
    assert drag.proof is not None
    closed, held = drag.proof.gap_closed, drag.proof.held_out_after
    assert held is not None
    said = closing_sentence(drag)
    assert said.startswith(f"It closes {percent(closed)} % of the gap on held-out trials: χ²/dof is ")
    assert f"and {number(held.chi_square_per_dof)} after it" in said
    page = Page("a", "b")
    page.add_section("c")
    add_verdict(page, ReportInput(drag, ORIGIN))  # without intervals of the patch, by its parameters
    text = html.unescape(page.render()).replace("\N{NO-BREAK SPACE}", " ")
    assert text.index(headline(drag.verdict)) < text.index("Its size: ") < text.index(said)
    assert text.count(f"{percent(closed)} %") == 1
    # no name, no gap to close, no proof
    group = replace(drag, verdict=replace(drag.verdict, kind=VerdictKind.GROUP))
    assert closing_sentence(group).startswith("The best hypothesis, which is no name, closes")
    none = replace(drag, proof=replace(drag.proof, gap_closed=float("nan")))
    assert closing_sentence(none).startswith("On held-out trials χ²/dof is ")
    worse = replace(drag, proof=replace(drag.proof, gap_closed=-0.2, held_out_after=None))
    assert closing_sentence(worse).startswith("On fitted trials χ²/dof is ")
    assert closing_sentence(replace(drag, proof=None)) == ""


def test_parameters_are_shown_before_and_after(drag: Investigation) -> None:
    rows = parameter_rows(drag)
    assert [row[0] for row in rows] == ["stiffness factor", "damping factor"]
    assert drag.fit is not None
    fitted = drag.problem.shared.parameters(drag.fit.point.shared)  # type: ignore[union-attr]
    for row, item, value in zip(rows, drag.model.parameters, fitted, strict=True):
        moments = [[float(part) for part in cell.split(" ± ")] for cell in row[2:]]
        assert moments[0] == pytest.approx([item.mean, norm.ppf(0.95) * item.deviation], rel=0.03)
        assert moments[2][0] == pytest.approx(value, abs=0.06 * moments[2][1])
        assert moments[2][1] < moments[0][1]
    nothing = replace(drag, fit=drag.search.none)  # type: ignore[union-attr]
    assert [row[:4] for row in parameter_rows(nothing)] == [row[:4] for row in rows]
    assert {len(row) for row in parameter_rows(nothing)} == {4}


# ---------------------------------------------------------------- what a campaign can decide


def test_gates_say_what_they_compare(drag: Investigation) -> None:
    page = Page("a", "b")
    page.add_section("c")
    add_gates(page, drag)
    text = page.render()
    absolute, shape, consistency, _ = drag.verdict.gates
    for gate in (absolute, consistency):
        assert f"p = {gate.statistic:.2g}</td>" in text
        assert f"p at least {gate.limit:g}</td>" in text
    assert f"at most {shape.limit:g} nat</td>" in text


def test_the_gate_that_decided_stands_out_where_the_absolute_fit_could_not_be_judged(
    drag: Investigation,
) -> None:
    absolute, shape, consistency, _ = drag.verdict.gates
    gates = (
        replace(absolute, passed=None, statistic=float("nan")), shape,
        replace(consistency, passed=False, statistic=2e-5),
    )  # fmt: skip
    verdict = replace(drag.verdict, kind=VerdictKind.UNEXPLAINED, effects=(), gates=gates)
    page = Page("a", "b")
    page.add_section("c")
    add_verdict(page, ReportInput(replace(drag, verdict=verdict, proof=None), ORIGIN))
    assert "p of the consistency; a fit has at least 0.001" in page.render()


def test_a_reader_sees_which_trial_is_held_out(drag: Investigation) -> None:
    assert drag.before is not None
    _, names, _ = size_table(drag.before)
    trials = drag.campaign.trials
    assert names == [f"{t.name} (held out)" if t.held_out else t.name for t in trials]
    assert any(trial.held_out for trial in trials)
    caption = report_figures(ReportInput(drag, ORIGIN))["residual_table"].caption
    assert f"Held out: {listing(trial.name for trial in trials if trial.held_out)};" in caption


def test_what_explains_most_of_the_gap_is_told_first(drag: Investigation) -> None:
    assert drag.location is not None
    assert drag.before is not None
    gap = {"static": 0.0, "ring-down": 0.0}
    for item in drag.before.trials:
        if not item.trial.held_out:
            kind = "static" if item.trial.kind is TrialKind.STATIC else "ring-down"
            gap[kind] += float(np.nansum(item.standardised**2) - item.expected_variance[item.used].sum())
    told = [item.share * max(gap[item.trials], 0.0) for item in drag.location.disagreements]
    assert len(told) > 1
    assert told == sorted(told, reverse=True)


def test_each_reason_is_given_once_and_each_confusion_by_name(able: Separability) -> None:
    assert untested_lines(able) == ["Not testable: washout. The campaign has no flight trial to fit."]
    lines = confused_lines(able)
    assert len(lines) == sum(bool(neighbours(able, name)) for name in able.identifiers)
    for line in lines:
        name = line.split()[1]
        assert all(other in line for other in neighbours(able, name))


@pytest.mark.parametrize("count", [1, 3])
def test_an_effect_is_not_the_nearest_to_itself(drag: Investigation, count: int) -> None:
    hidden = tuple(
        Detectability(effect, "", "", DETECTED / (n + 2) ** 2, "size", 1.0, "1", 0.5)
        for n, effect in enumerate(FEW[:count])
    )
    (told,) = (
        line
        for line in needs(Separability(hidden, (), np.zeros((0, 0)), ()), drag.campaign, FEW)
        if "would not be seen" in line
    )
    first = FEW[0].identifier.replace("_", " ")
    assert told.count(first) == (1 if count == 1 else 2)
    assert told.endswith("with noise 2 times smaller or 4 times as many trials.")


def test_rows_of_what_can_be_decided(drag: Investigation, able: Separability) -> None:
    rows = {row[0]: row for row in rows_of(able)}
    assert set(rows) == {effect.identifier for effect in FEW}
    assert rows["washout"][1] == "no"
    assert rows["quadratic_damping"][1] == "yes"
    for row, name in enumerate(able.identifiers):
        near = np.minimum(able.distance[row], able.distance[:, row]) < CONFUSED
        near[row] = False
        assert neighbours(able, name) == [able.identifiers[place] for place in np.flatnonzero(near)]
    assert group_lines(able)
    text = " ".join(needs(able, drag.campaign, FEW))
    for group in able.groups:
        assert group[0].replace("_", " ") in text


# ---------------------------------------------------------------- the workflow tried


@pytest.mark.parametrize(
    ("hidden", "kind", "named", "group", "outcome"),
    [
        (NOTHING, VerdictKind.NOTHING_MISSING, (), (), "right"),
        (NOTHING, VerdictKind.NAMED, ("a",), (), "wrong"),
        ("a", VerdictKind.NAMED, ("a",), (), "right"),
        ("a", VerdictKind.NAMED, ("b",), (), "wrong"),
        ("a", VerdictKind.NAMED, ("a", "b"), (), "wrong"),
        ("a", VerdictKind.GROUP, ("b", "a"), ("b", "a"), "group"),
        ("a", VerdictKind.GROUP, ("b", "c"), ("b", "c"), "wrong"),
        ("a", VerdictKind.GROUP, ("a", "b"), ("a + b",), "group"),
        ("a", VerdictKind.FAMILY, ("a",), (), "family"),
        ("a", VerdictKind.FAMILY, ("b",), (), "wrong"),
        ("a", VerdictKind.NOTHING_MISSING, (), (), "missed"),
        ("a", VerdictKind.UNEXPLAINED, (), (), "unexplained"),
    ],
)
def test_how_verdicts_count(
    hidden: str, kind: VerdictKind, named: tuple[str, ...], group: tuple[str, ...], outcome: str
) -> None:
    assert outcome_of(hidden, kind, named, group) == outcome


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 60), st.integers(1, 60))
def test_wilson_intervals_solve_their_equation(count: int, total: int) -> None:
    count = min(count, total)
    found = wilson(count, total)
    z = norm.ppf(0.95)
    for end in (found.low, found.high):
        if 0.0 < end < 1.0:  # Wilson 1927: |p - end| = z sqrt(end (1 - end) / n)
            assert abs(found.value - end) == pytest.approx(z * np.sqrt(end * (1.0 - end) / total), rel=1e-6)
    assert wilson(0, 0).total == 0


def test_simulated_campaigns_have_the_noise_and_the_nuisances_of_the_real_one() -> None:
    campaign, model = measured()
    simulator = Simulator(campaign, model)
    squares: list[float] = []
    for seed in range(12):
        drawn = simulator.simulate(None, np.random.default_rng(seed))
        assert [trial.name for trial in drawn.trials] == [trial.name for trial in campaign.trials]
        found = investigate(drawn, model, (), thorough=False) if seed < 2 else None
        assert found is None or found.verdict.kind is VerdictKind.NOTHING_MISSING
        again = simulator.simulate(None, np.random.default_rng(seed)).trials[-1].values
        assert np.array_equal(again, drawn.trials[-1].values)
        # sixth differences of a slow motion hold noise alone: variance times the sum of squared binomials
        sixth = np.diff(drawn.trials[-1].values[:, 0], 6)
        noise = simulator.problem.noise[drawn.trials[-1].channels[0]].standard_deviation
        squares.append(float(np.mean(sixth**2)) / 924.0 / noise**2)
    assert np.mean(squares) == pytest.approx(1.0, abs=0.12)


def test_the_workflow_tried_on_its_own_geometry(tmp_path: Path) -> None:
    campaign, model = measured(kind="static")
    steps: list[int] = []
    found = self_calibrate(campaign, model, FEW, 9, seed=2, workers=1, advance=lambda: steps.append(1))
    assert len(steps) == len(found.cases) == 9
    assert [case.hidden == NOTHING for case in found.cases] == [True, False, False] * 3
    assert all(case.distance >= 25.0 for case in found.cases if case.hidden != NOTHING)
    assert sum(found.confusion()[2].ravel()) == 9
    assert found.share("right", null=True).total == 3
    again = self_calibrate(campaign, model, FEW, 9, seed=2, workers=1)
    assert again == found
    path = write_self_calibration(tmp_path / "self_calibration.json", found, ORIGIN)
    stored = json.loads(path.read_text(encoding="utf-8"))
    assert stored["schema"] == "uav-twin self calibration 1"
    assert len(stored["cases"]) == 9
    with pytest.raises(FitError, match="at least one"):
        self_calibrate(campaign, model, library(), 0)


# ---------------------------------------------------------------- choice of the model


def test_models_by_name_and_file(tmp_path: Path) -> None:
    shipped = choose_model(MODEL)
    assert shipped.kind is ModelKind.LUMPED
    assert shipped.path is None
    text = (Path(__file__).parents[2] / "discrepancy" / "lumped_models" / f"{MODEL}.toml").read_text(
        encoding="utf-8"
    )
    file = tmp_path / "rig.toml"
    file.write_text(text, encoding="utf-8")
    own = choose_model(file)
    assert own.source_hash == shipped.source_hash
    assert own.label == "rig.toml"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("no_such_rig", "three_mass_chain"),
        ("missing.toml", "no model file"),
        ("missing.nc", "no model file"),
        ("wing.fmu", "is an FMU"),
        ("table.csv", "is no model"),
        ("broken.toml", "not valid TOML"),
        ("design.toml", "design"),
    ],
)
def test_models_that_cannot_be_used(name: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "table.csv").write_text("a,b\n", encoding="utf-8")
    (tmp_path / "broken.toml").write_text("mass = [", encoding="utf-8")
    (tmp_path / "design.toml").write_text("name = 'half a wing'\n", encoding="utf-8")
    with pytest.raises(ModelError, match=message):
        choose_model(tmp_path / name if "." in name else name)


def test_what_is_named_in_part_shows_shares_remainder_and_what_was_not_fitted(drag: Investigation) -> None:
    verdict = replace(
        drag.verdict,
        kind=VerdictKind.NAMED_IN_PART,
        explained=ExplainedShare(0.94, 0.92, 0.953, 3.1, 0.9, 0.06, 0.04, "held-out"),
        remainders=(RemainderEstimate("displacement", 3.1, 0.25, 2.0),),
        not_fitted=(NotFitted("washout", "No flight trial."), NotFitted("free_play", "screened out", 0.3)),
    )
    content = ReportInput(replace(drag, verdict=verdict), ORIGIN)
    figures = report_figures(content)
    assert figures["shares"].title == "What the gap is made of"
    text = render_report(content, draw({"shares": figures["shares"]}), {"shares": figures["shares"]})
    text = text.replace("\N{NO-BREAK SPACE}", " ")
    for words in (
        "90.0 % of the mean square on held-out trials",
        "displacement 3.1 noises over 0.25 s, swinging at 2 Hz",
        "It closes 94 % of the gap on held-out trials (92 to 95 %) and leaves 3.1 noises.",
        "No flight trial.",
        "closes most of the gap on trials that it did not see",
    ):
        assert words in text
    assert shares_sentence(replace(verdict, explained=None)) == ""
    assert verdict.explained is not None
    # a mean square of 25 in units of the noise, of which 2.5 are left
    assert residual_sizes(verdict.explained) == ("5", "1.6")
    assert remainders_sentence(replace(verdict, remainders=())) == ""
