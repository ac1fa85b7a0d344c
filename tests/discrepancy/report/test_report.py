"""What a page says of a verdict; its folder: whole or not there, the same bytes again, never lost."""

import html
import os
import re
import stat
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import norm

from benchmarks.tank import tank_setting
from discrepancy.campaign.records import TrialKind
from discrepancy.errors import VerdictFileError
from discrepancy.files.residuals import read_residuals
from discrepancy.files.verdict import primitive_intervals, read_patch, read_verdict, read_verdict_file
from discrepancy.judgement import proof
from discrepancy.judgement.closed_share import percent_with_interval
from discrepancy.judgement.conclusion import probability_text
from discrepancy.judgement.proof import errors_of_fit
from discrepancy.judgement.separability import (
    CONFUSION_DISTANCE,
    DETECTION_DISTANCE,
    Detectability,
    Separability,
    compute_separability,
)
from discrepancy.judgement.simulation_comparison import SimulationComparison
from discrepancy.pictures import plot_missing_force
from discrepancy.report.decidability_text import (
    campaign_needs,
    confused_effects,
    group_lines,
)
from discrepancy.report.figures import ReportInput, report_figures
from discrepancy.report.page import missing_effects_text, render_report
from discrepancy.report.printed import check_lines
from discrepancy.report.residual_figures import gauge_places, planform_figure
from discrepancy.report.sizes import si_sizes
from discrepancy.report.tables import detectable_sizes_table, parameter_rows
from discrepancy.report.text import formula, number
from discrepancy.report.verdict_sentences import error_sentence, headline, proof_scores, remainders_sentence
from discrepancy.system.structures import WingModel
from discrepancy.verdict import NotFitted, RemainderEstimate, Verdict, VerdictKind
from discrepancy.verdict_folder import check_verdict_folder, write_verdict_folder
from fe.runtime import patch as patches
from fe.runtime.patch import PowerDamping, SensorDrift
from fe.wing.design import load_design
from reporting.errors import FileNotWrittenError
from reporting.figures import to_svg
from reporting.folders import lock_folder
from reporting.words import listing, rounded
from tests.discrepancy.bench import Bench
from tests.discrepancy.rigs import FEW, INPUTS, ORIGIN, drag_found, model_of

pytestmark = pytest.mark.xdist_group("verdict")  # one worker finds it


@pytest.fixture(scope="module")
def drag():
    return drag_found()


@pytest.fixture(scope="module")
def able(drag):
    return compute_separability(drag.campaign, drag.model, drag.problem.setting, FEW)


def test_page_file_and_sentences_state_one_record_of_the_errors(drag, tmp_path, monkeypatch):
    """The errors of a fit are computed once; all that states them reads that record."""
    errors = errors_of_fit(drag.search, drag.fit)
    assert drag.proof.closed is errors.closed
    before, after, trials = proof_scores(drag.proof)
    assert trials == errors.closed.trials
    assert before.rms == errors.rms_before
    assert after.rms == errors.rms_after
    # what judges this fit after the verdict computes no share again
    monkeypatch.setattr(proof, "closed_share", lambda *residuals: pytest.fail("computed twice"))
    clause = SimulationComparison(drag.search).closed_share_clause(drag.fit)
    percent = percent_with_interval(errors.closed)
    assert percent in clause
    assert percent in error_sentence(drag)
    assert percent in page_of(drag)
    write_verdict_folder(tmp_path / "verdict", ReportInput(drag, ORIGIN), report=False)
    stored = read_verdict(tmp_path / "verdict")
    assert stored.proof.closed == errors.closed
    assert stored.proof.held_out_after.rms == errors.rms_after


def page_of(investigation, **verdict):
    """Return the page of an investigation without its figures, its verdict changed, as a browser shows it."""
    changed = replace(investigation, verdict=replace(investigation.verdict, **verdict))
    page = render_report(ReportInput(changed, ORIGIN), {}, {})
    return html.unescape(page).replace("\N{NO-BREAK SPACE}", " ")


def test_a_verdict_begins_with_what_is_missing_how_large_and_what_is_left(drag):
    closed, held = drag.proof.closed, drag.proof.held_out_after
    said = f"It explains {percent_with_interval(closed)} of the mean square error in "
    text = page_of(drag)  # without intervals, by its parameters
    force = drag.verdict.force
    opening = (
        f">Quadratic aerodynamic damping at {force.port}<", f">{number(force.rms)} N<",
        f">{percent_with_interval(closed)}<", f">{probability_text(drag.verdict.probability)}<",
        f">{headline(drag.verdict)}<", "Its size: ", said,
    )  # fmt: skip
    places = [text.index(words) for words in opening]
    assert places == sorted(places)
    # one line says what is missing, where, how large and how sure that is; the others are unfolded
    size = f"{number(force.rms)} N (rms) at {force.port}"
    card = f"Quadratic aerodynamic damping at {force.port} is missing; {size}"
    assert f'class="card">{card}; probability {probability_text(drag.verdict.probability)}.<' in text
    assert text.index('class="card"') < text.index("<details>") < places[0]
    assert f">{number(held.chi_square_per_sample)}<" in text
    assert "rms residual of leaf strain (µε)<" in text
    for name, factor in (("displacement", 1e3), ("leaf_strain", 1e6)):
        assert f">{number(factor * held.rms[name])}<" in text
    # gates say what they compare
    absolute, shape, consistency, _ = drag.verdict.gates
    for gate in (absolute, consistency):
        assert f"p = {gate.statistic:.2g}</td>" in text
        assert f"p at least {gate.limit:g}</td>" in text
    assert f"at most {shape.limit:g} nat</td>" in text
    # no name, no gap to close, no absolute fit that could be judged, no proof
    assert "The best hypothesis, which is not named, explains" in page_of(drag, kind=VerdictKind.GROUP)
    untested = replace(drag.proof, closed=None, closed_reason="Held-out trials show no gap before.")
    assert "Held-out trials show no gap before." in page_of(replace(drag, proof=untested))
    larger = replace(closed, value=-0.2, low=-0.3, high=-0.1)
    assert "makes the error in" in page_of(replace(drag, proof=replace(drag.proof, closed=larger)))
    unknown = replace(absolute, passed=None, statistic=float("nan"))
    gates = (unknown, shape, replace(consistency, passed=False, statistic=2e-5))
    unproved = {"kind": VerdictKind.UNEXPLAINED, "effects": (), "gates": gates, "force": None}
    text = page_of(replace(drag, proof=None), **unproved)
    assert "of the mean square error" not in text
    assert "p of the consistency; a fit has at least 0.001" in text


def test_an_investigation_shows_its_verdict_and_the_missing_force_in_a_notebook(drag):
    text = drag._repr_html_()
    assert drag.verdict.sentence in html.unescape(text)
    assert "quadratic aerodynamic damping" in text.lower()
    panels = drag.plot()
    assert len(panels) == len(drag.missing.courses[:6])
    for panel, course in zip(panels, drag.missing.courses, strict=False):
        force, law = panel.get_lines()
        np.testing.assert_array_equal(force.get_ydata(), course.force)
        np.testing.assert_array_equal(law.get_ydata(), course.law)
    with pytest.raises(ValueError, match="has no missing force"):
        plot_missing_force(replace(drag, missing=None))


def test_members_of_a_group_stand_apart_and_first(drag):
    (effect,) = drag.verdict.effects
    rival = replace(effect, identifier="rival", name="a rival")
    hypotheses = tuple(
        replace(drag.verdict.hypotheses[0], effects=effects, log_evidence=0.0, probability=0.3)
        for effects in ((), (effect,), (effect, replace(rival, identifier="other", name="other")), (rival,))
    )
    text = page_of(
        drag, kind=VerdictKind.GROUP, effects=(effect, rival), hypotheses=hypotheses,
        group=(effect.identifier, rival.identifier),
    )  # fmt: skip
    assert f"Quadratic aerodynamic damping at {effect.place} or a rival at {effect.place}" in text
    text = re.sub(' data-of="[^"]*"', "", text)  # headings for narrow screens
    members = re.findall(r"<td>(\d?)</td><td>(.*?)</td>", text[text.index("The members of the group") :])
    assert [row for row in members if row[0]] == [("1", effect.name), ("2", "a rival")]
    roles = re.findall(r"<td>([^<]*)</td><td>(member of the group|)</td>", text[text.index("Evidence.") :])
    assert [role for _, role in roles[:4]] == ["member of the group"] * 2 + [""] * 2


def test_parameters_are_shown_before_and_after(drag):
    rows = parameter_rows(drag)
    assert [row[0] for row in rows] == ["stiffness factor", "damping factor"]
    fitted = drag.problem.shared.parameters(drag.fit.point.shared)
    for row, item, value in zip(rows, drag.model.parameters, fitted, strict=True):
        moments = [[float(part) for part in cell.split(" ± ")] for cell in row[2:]]
        assert moments[0] == pytest.approx([item.mean, norm.ppf(0.95) * item.deviation], rel=0.03)
        assert moments[2][0] == pytest.approx(value, abs=0.06 * moments[2][1])
        assert moments[2][1] < moments[0][1]
    nothing = replace(drag, fit=drag.search.no_effect)
    assert [row[:4] for row in parameter_rows(nothing)] == [row[:4] for row in rows]
    assert {len(row) for row in parameter_rows(nothing)} == {4}


def test_what_explains_most_of_the_gap_is_told_first(drag):
    gap = {"static": 0.0, "ring-down": 0.0}
    for item in drag.before.trials:
        if not item.trial.held_out:
            kind = "static" if item.trial.kind is TrialKind.STATIC else "ring-down"
            gap[kind] += float(np.nansum(item.standardised**2) - item.expected_variance[item.used].sum())
    told = [item.share * max(gap[item.trials], 0.0) for item in drag.location.disagreements]
    assert len(told) > 1
    assert told == sorted(told, reverse=True)


@pytest.mark.parametrize("count", [1, 3])
def test_an_effect_is_not_the_nearest_to_itself(drag, count):
    hidden = tuple(
        Detectability(effect, "", "", DETECTION_DISTANCE / (n + 2) ** 2, "size", 1.0, "1", 0.5, n + 2.0)
        for n, effect in enumerate(FEW[:count])
    )
    (told,) = (
        line
        for line in campaign_needs(
            Separability(hidden, (), np.zeros((0, 0)), ()), drag.campaign, FEW, TrialKind
        )
        if "would not be detectable" in line
    )
    first = FEW[0].identifier.replace("_", " ")
    assert told.count(first) == (1 if count == 1 else 2)
    assert told.endswith("with noise 2 times smaller or 4 times as many trials.")


def test_what_can_be_decided(drag, able):
    rows = {row[0].replace(" ", "_"): row for row in detectable_sizes_table(able).table.rows}
    assert set(rows) == {effect.identifier for effect in FEW} - {"washout"}
    assert rows["quadratic_damping"][1] == "yes"
    lines = list(check_lines(drag.campaign, model=drag.model, catalogue=FEW, faults=(), separability=able))
    assert "Not testable: washout. The campaign has no flight trial to fit." in lines
    confused = [line for line in lines if isinstance(line, str) and line.startswith("Confused: ")]
    assert len(confused) == sum(bool(confused_effects(able, name)) for name in able.identifiers)
    for line in confused:
        assert all(other in line for other in confused_effects(able, line.split()[1]))
    for row, name in enumerate(able.identifiers):
        near = np.minimum(able.distance[row], able.distance[:, row]) < CONFUSION_DISTANCE
        near[row] = False
        assert confused_effects(able, name) == [able.identifiers[place] for place in np.flatnonzero(near)]
    assert group_lines(able)
    text = " ".join(campaign_needs(able, drag.campaign, FEW, TrialKind))
    for group in able.groups:
        assert group[0].replace("_", " ") in text
    assert " add " not in " ".join(
        campaign_needs(able, drag.campaign, FEW, ())
    )  # trials that its model cannot follow
    unproved = campaign_needs(able, replace(drag.campaign, trials=drag.campaign.fitted), FEW, ())
    assert [line for line in unproved if "nothing can be proved" in line] == unproved[-1:]
    assert "nothing can be proved" not in text
    quiet = {name: replace(item, noise=None) for name, item in drag.campaign.channels.items()}
    *_, asked = campaign_needs(able, replace(drag.campaign, channels=quiet), FEW, TrialKind)
    assert asked.startswith(f"Give a noise record for {', '.join(quiet)} (")


def test_what_is_named_in_part_shows_shares_remainder_and_what_was_not_fitted(drag):
    text = page_of(
        drag, kind=VerdictKind.NAMED_IN_PART,
        remainders=(RemainderEstimate("displacement", 3.1, 0.25, 2.0),),
        not_fitted=(
            *(NotFitted(name, "No flight trial.") for name in ("washout", "inertia_relief")),
            NotFitted("free_play", "screened out: 0.3 nat at most", 0.3),
        ),
    )  # fmt: skip
    for words in (
        "displacement 3.1 standard deviations of the noise over 0.25 s, swinging at 2 Hz",
        "<td>No flight trial.</td><td>washout and inertia relief</td>",
        "<td>Screened out</td><td>free play (0.3 nat)</td>",
        "explains most of what is missing",
    ):
        assert words in text
    assert remainders_sentence(replace(drag.verdict, remainders=())) == ""


# ---------------------------------------------------------------- numbers, formulas and sentences


def test_numbers_formulas_and_lists_as_they_are_written():
    minus = "\N{MINUS SIGN}"
    for value, text in (
        (1582.6, "1,580"), (-11424.0, f"{minus}11,400"), (0.98, "0.98"), (2e6, "2e+06"), (999.6, "1,000"),
    ):  # fmt: skip
        assert number(value) == text
    # numbers that nobody should read as certain
    for value, text in ((1.0 - 1e-6, "> 0.999"), (1e-200, "< 1e-99"), (float("nan"), "not known")):
        assert probability_text(value) == text
    assert formula("zeta_eq = 4 c A w^2 / (3 pi k) -> zeta") == "ζ_eq = 4 c A w² / (3 π k) → ζ"
    assert formula("x^n, beta2, multiplier mu") == "x^n, beta2, multiplier μ"
    assert listing(["a"]) == "a"
    assert listing(["a", "b", "c"]) == "a, b and c"


@given(st.floats(-1e6, 1e6), st.floats(1e-9, 1e3))
def test_rounding_keeps_values_within_a_twentieth_of_their_spread(value, spread):
    text = rounded(value, spread).replace("\N{MINUS SIGN}", "-")
    assert abs(float(text) - value) <= 0.051 * spread + 1e-9 * abs(value)


def test_the_card_of_a_group_with_long_names_says_how_many_hypotheses(drag):
    (effect,) = drag.verdict.effects
    names = {"short": ("play", "drag"), "long": ("a law with a long name", "another law with a name as long")}
    cards = {}
    for length, (first, second) in names.items():
        effects = (replace(effect, identifier="a", name=first), replace(effect, identifier="b", name=second))
        verdict = Verdict(VerdictKind.GROUP, "", 0.97, 12.0, effects=effects, group=("a", "b"))
        cards[length] = missing_effects_text(verdict)
    assert cards["short"] == f"play at {effect.place} or drag at {effect.place}"
    assert cards["long"] == "one of 2 hypotheses"


def test_a_headline_has_one_probability(drag):
    named = Verdict(VerdictKind.NAMED, "The model lacks drag (probability 0.998).", 0.998, 12.0)
    assert headline(named).count("probability") == 1
    group = Verdict(VerdictKind.GROUP, "One of a, b is missing.", 0.97, 12.0)
    assert headline(group) == "One of a, b is missing (together they have the probability 0.970)."
    broken = Verdict(VerdictKind.DATA_ERROR, "Channel x is clipped.", float("nan"), float("nan"))
    assert headline(broken) == "Channel x is clipped."
    # a name that holds its identifier is said once
    (effect,) = drag.verdict.effects
    flow = replace(effect, identifier="outflow", name="outflow by a power of the level")
    sentence = f"The nearest is outflow; {flow.name} closes 74 %."
    said = headline(replace(drag.verdict, sentence=sentence, effects=(flow,), hypotheses=()))
    assert said.startswith(f"The nearest is {flow.name}; {flow.name} closes 74 %")


def test_gauges_lie_where_the_design_has_them():
    bench = Bench()
    residuals = bench.fit(np.random.default_rng(3))
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
    labels = [text.get_text() for text in figure.axes[0].texts]
    assert labels == ["g1", "g2", "g3", "g4"]
    nowhere = {name: replace(channel, output="x") for name, channel in channels.items()}
    assert planform_figure(replace(residuals, channels=nowhere), None, design) is None


@pytest.mark.parametrize(
    ("kind", "primitive", "text"),
    [
        ("rig", PowerDamping("slide", 0.5, 0.0, 0.0, 1.0, 1.0), "force 0.5000 N"),
        ("rig", PowerDamping("slide", 0.5, 2.0, 0.0, 0.25, 1.0), "force 0.5000 N at 0.25 m/s"),
        ("rig", patches.PowerStiffness("slide", 3.0, 3.0, 0, 0.01), "force 3 N at 0.01 m"),
        ("rig", patches.PointMass(0.2, 0.4), "mass 0.200 kg at 0.4 m"),
        ("rig", patches.SensorGain("displacement", 0.02), ""),
        ("rig", SensorDrift("displacement", 0.002, 10.0), "amplitude 0.002 m"),
        ("rig", SensorDrift("leaf_strain", 0.002, 10.0), ""),
        ("rig", PowerDamping("elsewhere", 0.5, 0.0, 0.0, 1.0, 1.0), "force 0.500 N or N m"),
        ("tank", PowerDamping("outlet", 0.5, 0.5, 0.0, 2.0, 1.0), "flow 0.500 m/s times capacity at 2 m"),
        ("tank", patches.Overflow("outlet", 0.5, 1.5, 3.0, 2.0), "flow 0.500 m/s times capacity, level 3 m"),
        ("wing", PowerDamping("root", 0.5, 0.0, 0.0, 1.0, 1.0), "moment 0.500 N m"),
        ("wing", PowerDamping("tip", 0.5, 0.0, 0.0, 1.0, 1.0), "force 0.500 N"),
    ],
)
def test_sizes_have_the_unit_of_their_port_state_or_channel(drag, coarse_patch_arrays, kind, primitive, text):
    patch = patches.ModelPatch((primitive,))
    others = {"tank": lambda: tank_setting().model, "wing": lambda: WingModel(coarse_patch_arrays)}
    model = others.get(kind, lambda: drag.model)()
    found = si_sizes(patch, primitive_intervals(patch), model, drag.campaign)
    assert re.sub(r"(\d\.\d*?)0+(?= )", r"\1", found) == re.sub(r"(\d\.\d*?)0+(?= )", r"\1", text)


def test_a_port_turns_as_what_is_measured_or_prescribed_of_it():
    model = model_of(INPUTS.text("turning.toml"))
    units = {name: model.port_units(name)[0] for name in model.ports}
    known = {"measured": "N m", "driven": "N m", "straight": "N"}
    assert units == known | dict.fromkeys(("free", "half known", "mixed"), "N or N m")


# ---------------------------------------------------------------- the folder


def test_an_old_verdict_is_not_lost(drag, tmp_path):
    """Where writing fails, another process replaces it, or a killed one had moved it aside.

    How a kill between the moves leaves it is in test_workflow of twin_master.
    """
    folder = tmp_path / "v"
    folder.mkdir()
    (folder / "verdict.json").write_text("first", encoding="utf-8")
    (folder / "notes.txt").write_text("mine", encoding="utf-8")

    def refuse(patch, target):
        raise OSError(28, "No space left on device")

    with pytest.raises(FileNotWrittenError, match="No space"):
        write_verdict_folder(folder, ReportInput(drag, ORIGIN, pack=refuse), replace_it=True, report=False)
    lock = lock_folder(folder)
    with pytest.raises(FileNotWrittenError, match="another process is replacing"):
        write_verdict_folder(folder, ReportInput(drag, ORIGIN), replace_it=True, report=False)
    os.close(lock)
    aside = tmp_path / ".v.old-x" / "v"
    for put_back in (
        lambda: check_verdict_folder(folder, replace_it=True),
        lambda: read_verdict(folder),  # which is a word
    ):
        aside.parent.mkdir()
        folder.rename(aside)
        with suppress(VerdictFileError):
            put_back()
        assert (folder / "verdict.json").read_text(encoding="utf-8") == "first"
        assert (folder / "notes.txt").read_text(encoding="utf-8") == "mine"
        assert [path.name for path in tmp_path.iterdir()] == ["v"]
    # replaced on demand only, and nothing else ever
    other = tmp_path / "thesis"
    other.mkdir()
    with pytest.raises(FileNotWrittenError, match="--replace"):
        write_verdict_folder(folder, ReportInput(drag, ORIGIN), report=False)
    write_verdict_folder(folder, ReportInput(drag, ORIGIN), replace_it=True, report=False)
    assert not (folder / "notes.txt").exists()
    assert stat.S_IMODE(folder.stat().st_mode) == stat.S_IMODE(other.stat().st_mode)
    (other / "chapter.tex").write_text("x", encoding="utf-8")
    for place, words in ((other, "left unchanged"), (other / "chapter.tex", "not a folder")):
        with pytest.raises(FileNotWrittenError, match=words):
            check_verdict_folder(place, replace_it=True)


def test_the_folder_of_a_named_effect(drag, able, tmp_path):
    written = tmp_path / "verdict"
    write_verdict_folder(written, ReportInput(drag, ORIGIN, able))
    assert drag.verdict.kind is VerdictKind.NAMED
    page = next(written.glob("*.html")).read_text(encoding="utf-8")
    assert "quadratic aerodynamic damping" in page
    assert "F = c |v| v" in page  # the equation of the catalogue
    assert page.count("<script>") == page.count("<script") == 1
    assert not re.search(r'(?:src|href)="(?!#|data:)', page)  # self-contained
    assert str(written.parent) not in page
    for title in ("Verdict", "Where the gap is", "Proof on held-out trials", "What this campaign can decide"):
        assert f">{title}<" in page
    identifiers = re.findall(r'\bid="([^"]+)"', page)
    assert len(set(identifiers)) == len(identifiers)
    assert read_verdict_file(written / "verdict.json").verdict.sentence == drag.verdict.sentence
    patch = read_patch(written / "patch.json")
    assert patch.patch == drag.verdict.effects[0].patch
    assert patch.verdict is VerdictKind.NAMED
    row = patch.effects[0].intervals[0]
    assert row.low < row.value < row.high
    assert len(read_residuals(written / "residuals.nc").trials) == len(drag.campaign.trials)
    pictures = {path.name for path in (written / "figures").iterdir()}
    assert {"history.svg", "history.png", "missing_force.svg", "backbone.svg", "separability.png"} <= pictures
    assert not list(written.parent.glob(".*"))  # nothing half-written is left
    # the report repeats bit for bit
    content = ReportInput(drag, ORIGIN, able, intervals=[effect.intervals for effect in patch.effects])
    figures = report_figures(content)
    held_out = listing(trial.name for trial in drag.campaign.held_out)
    assert f"Held out: {held_out};" in figures["residual_table"].caption
    again = render_report(content, {name: to_svg(item.figure) for name, item in figures.items()}, figures)
    assert again == page
