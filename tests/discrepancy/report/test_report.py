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
from discrepancy.judgement.hypotheses import probability_text
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
from discrepancy.report.levels import answers, probability_of_force, probability_of_port
from discrepancy.report.page import verdict_page
from discrepancy.report.printed import check_lines
from discrepancy.report.residual_figures import gauge_places, planform_figure
from discrepancy.report.sizes import si_sizes
from discrepancy.report.tables import detectable_sizes_table, parameter_rows
from discrepancy.report.text import added_label, formula, number
from discrepancy.report.verdict_sentences import error_sentence, proof_scores, remainders_sentence
from discrepancy.system.wing_model import WingModel
from discrepancy.verdict import NotFitted, RemainderEstimate, VerdictKind
from discrepancy.verdict_folder import check_verdict_folder, write_verdict_folder
from fe.runtime import patch as patches
from fe.runtime.patch import PowerDamping, SensorDrift
from fe.wing.design import load_design
from reporting.errors import FileNotWrittenError
from reporting.pages.figures import page_figure
from reporting.pages.page import render_page
from reporting.system.operating_system import lock_folder
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


def test_the_proof_has_the_errors_of_its_fit(drag):
    """The errors of a fit are computed once; all that states them reads that record."""
    errors = errors_of_fit(drag.search, drag.fit)
    before, after, trials = proof_scores(drag.proof)
    assert drag.proof.closed is errors.closed
    assert trials == errors.closed.trials
    assert (before.rms, after.rms) == (errors.rms_before, errors.rms_after)


def test_page_and_sentences_state_one_record_of_the_errors(drag, monkeypatch):
    """What judges the fit after the verdict computes no share again."""
    percent = percent_with_interval(errors_of_fit(drag.search, drag.fit).closed)
    monkeypatch.setattr(proof, "closed_share", lambda *residuals: pytest.fail("computed twice"))
    assert percent in SimulationComparison(drag.search).closed_share_clause(drag.fit)
    assert percent in error_sentence(drag)
    assert percent in page_of(drag)


def test_the_file_of_a_verdict_states_the_record_of_the_errors(drag, tmp_path):
    errors = errors_of_fit(drag.search, drag.fit)
    write_verdict_folder(tmp_path / "verdict", ReportInput(drag, ORIGIN), report=False)
    stored = read_verdict(tmp_path / "verdict")
    assert stored.proof.closed == errors.closed
    assert stored.proof.held_out_after.rms == errors.rms_after


def page_of(investigation, **verdict):
    """Return the page of an investigation without its figures, its verdict changed, as a browser shows it."""
    changed = replace(investigation, verdict=replace(investigation.verdict, **verdict))
    page = render_page(verdict_page(ReportInput(changed, ORIGIN), {}))
    return html.unescape(page).replace("\N{NO-BREAK SPACE}", " ")


@pytest.fixture(scope="module")
def page(drag):
    """The page of the verdict without its figures."""
    return page_of(drag)


def test_a_verdict_begins_with_what_is_missing_how_large_and_what_is_left(drag, page):
    """Without intervals the size is told by its parameters."""
    closed, force = percent_with_interval(drag.proof.closed), drag.verdict.force
    opening = (
        f'class="card">{drag.verdict.sentence} Size: ',
        f">{closed}<",
        "Is something missing?",
        f">yes: a force of {number(force.rms)} N (rms), at most ",
        f">at {force.port}<",
        f">{force.followed_percent} % of its variance<",
        "Which law is it?",
        "<details>",
    )
    places = [page.index(words) for words in opening]
    assert places == sorted(places)
    name = f"quadratic aerodynamic damping at {force.port}"
    assert drag.verdict.sentence == f"The model lacks {name} (probability > 0.999)."


def test_a_verdict_has_the_scores_of_its_held_out_trials(drag, page):
    held_out = drag.proof.held_out_after
    assert f">{number(held_out.chi_square_per_sample)}<" in page
    assert "rms residual of leaf strain (µε)<" in page
    for name, factor in (("displacement", 1e3), ("leaf_strain", 1e6)):
        assert f">{number(factor * held_out.rms[name])}<" in page


def test_gates_say_what_they_compare(drag, page):
    absolute, shape, consistency, _ = drag.verdict.gates
    for gate in (absolute, consistency):
        assert f"p = {gate.statistic:.2g}</td>" in page
        assert f"p at least {gate.limit:g}</td>" in page
    assert f"at most {shape.limit:g} nat</td>" in page


def test_a_group_is_no_name(drag):
    page = page_of(drag, kind=VerdictKind.GROUP)
    assert f"is taken away by {added_label(drag)}, the most probable of them" in page


def test_a_proof_without_a_gap_says_so(drag):
    sentence = "Held-out trials show no gap before."
    without_gap = replace(drag.proof, closed=None, closed_reason=sentence)
    assert sentence in page_of(replace(drag, proof=without_gap))


def test_an_error_that_grew_is_said_to_be_made(drag):
    larger = replace(drag.proof.closed, value=-0.2, low=-0.3, high=-0.1)
    grown = replace(drag, proof=replace(drag.proof, closed=larger))
    assert "of the mean square error in held-out trials is added" in page_of(grown)
    assert error_sentence(grown).startswith("It makes the error in")


def test_an_unexplained_gap_without_a_proof_has_the_consistency_and_no_share(drag):
    absolute, shape, consistency, _ = drag.verdict.gates
    unknown = replace(absolute, passed=None, statistic=float("nan"))
    gates = (unknown, shape, replace(consistency, passed=False, statistic=2e-5))
    unexplained = {"kind": VerdictKind.UNEXPLAINED, "effects": (), "gates": gates, "force": None}
    page = page_of(replace(drag, proof=None), **unexplained)
    assert "of the mean square error" not in page
    assert "<td>p = 2e-05 that it is noise</td>" in page.replace(' class="name"', "")


def test_the_first_screen_says_what_a_force_depends_on(drag):
    dependence = next(row for row in answers(drag.verdict) if row.question == "What does it depend on?")
    assert drag.verdict.force.ordered_by == ("velocity",)
    assert dependence.text == "the velocity"
    assert dependence.certainty == f"{drag.verdict.force.followed_percent} % of its variance"


def test_the_certainty_of_a_port_is_that_among_the_ports(drag):
    force = replace(drag.verdict.force, port="a", evidence={"a": 20.0, "b": 18.0, "c": -5.0})
    assert probability_of_port(force) == pytest.approx(1.0 / (1.0 + np.exp(-2.0)), rel=1e-6)
    assert probability_of_force(force) > 0.999
    where = answers(replace(drag.verdict, force=replace(force, port="b")))[1]
    assert where == ("Where?", "at b", "by its law; a force without a law shows more at a")


def test_where_nothing_is_missing_there_is_one_answer(drag):
    nothing = replace(drag.verdict, kind=VerdictKind.NOTHING_MISSING, probability=0.97)
    (answer,) = answers(nothing)
    assert answer.text == "no"
    assert answer.certainty == "probability that nothing is missing 0.970"


def test_an_investigation_shows_its_verdict_and_the_missing_force_in_a_notebook(drag):
    text = drag._repr_html_()
    assert drag.verdict.text in html.unescape(text)
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
    assert f">{effect.name} at slide or a rival at slide<" in text
    text = re.sub(' data-of="[^"]*"| class="name"', "", text)  # how cells look
    members = re.findall(r"<td>(\d?)</td><td>(.*?)</td>", text[text.index("The members of the group") :])
    assert [row for row in members if row[0]] == [("1", effect.name), ("2", "a rival")]
    roles = re.findall(r"<td>([^<]*)</td><td>(member of the group|)</td>", text[text.index("Evidence.") :])
    assert [role for _, role in roles[:4]] == ["member of the group"] * 2 + [""] * 2


def test_parameters_are_shown_before_and_after(drag):
    fitted = drag.problem.shared.parameters(drag.fit.point.shared)
    for row, parameter, value in zip(parameter_rows(drag), drag.model.parameters, fitted, strict=True):
        before, _, after = [[float(part) for part in cell.split(" ± ")] for cell in row[2:]]
        half_width = norm.ppf(0.95) * parameter.deviation
        assert before == pytest.approx([parameter.mean, half_width], rel=0.03)
        assert after[0] == pytest.approx(value, abs=0.06 * after[1])
        assert after[1] < before[1]


def test_parameters_are_shown_by_their_names(drag):
    assert [row[0] for row in parameter_rows(drag)] == ["stiffness factor", "damping factor"]


def test_without_an_effect_parameters_have_no_column_after_it(drag):
    rows = parameter_rows(replace(drag, fit=drag.search.no_effect))
    assert [row[:4] for row in rows] == [row[:4] for row in parameter_rows(drag)]
    assert {len(row) for row in rows} == {4}


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
            Separability(hidden, (), np.zeros((0, 0)), (), ()), drag.campaign, FEW, TrialKind
        )
        if "would not be detectable" in line
    )
    first = FEW[0].identifier.replace("_", " ")
    assert told.count(first) == (1 if count == 1 else 2)
    assert told.endswith("with noise 2 times smaller or 4 times as many trials.")


@pytest.fixture(scope="module")
def needs(drag, able):
    """What the campaign needs, in one text."""
    return " ".join(campaign_needs(able, drag.campaign, FEW, TrialKind))


def test_detectable_sizes_are_listed_of_effects_that_the_campaign_can_test(able):
    rows = {row[0].replace(" ", "_"): row for row in detectable_sizes_table(able).rows}
    assert set(rows) == {effect.identifier for effect in FEW} - {"washout"}
    assert rows["quadratic_damping"][1] == "yes"


def test_effects_that_the_campaign_cannot_test_are_printed(drag, able):
    lines = list(check_lines(drag.campaign, model=drag.model, catalogue=FEW, faults=(), separability=able))
    assert "Not testable: washout. The campaign has no flight trial to fit." in lines


def test_confused_effects_are_printed(drag, able):
    lines = check_lines(drag.campaign, model=drag.model, catalogue=FEW, faults=(), separability=able)
    confused = [line for line in lines if isinstance(line, str) and line.startswith("Confused: ")]
    assert len(confused) == sum(bool(confused_effects(able, name)) for name in able.identifiers)
    for line in confused:
        assert all(other in line for other in confused_effects(able, line.split()[1]))


def test_effects_are_confused_that_are_nearer_than_the_limit(able):
    for row, name in enumerate(able.identifiers):
        is_near = np.minimum(able.distance[row], able.distance[:, row]) < CONFUSION_DISTANCE
        is_near[row] = False
        near = [able.identifiers[number] for number in np.flatnonzero(is_near)]
        assert confused_effects(able, name) == near


def test_groups_of_confused_effects_are_told(able, needs):
    assert group_lines(able)
    assert all(group[0].replace("_", " ") in needs for group in able.groups)


def test_trials_that_a_model_cannot_follow_are_not_asked_for(drag, able):
    assert " add " not in " ".join(campaign_needs(able, drag.campaign, FEW, ()))


def test_without_held_out_trials_it_is_said_last_that_nothing_can_be_proved(drag, able, needs):
    without_proof = replace(drag.campaign, trials=drag.campaign.fitted)
    lines = campaign_needs(able, without_proof, FEW, ())
    assert [line for line in lines if "nothing can be proved" in line] == lines[-1:]
    assert "nothing can be proved" not in needs


def test_noise_records_are_asked_for_where_there_are_none(drag, able):
    quiet = {name: replace(channel, noise=None) for name, channel in drag.campaign.channels.items()}
    *_, last = campaign_needs(able, replace(drag.campaign, channels=quiet), FEW, TrialKind)
    assert last.startswith(f"Give a noise record for {', '.join(quiet)} (")


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


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1582.6, "1,580"),
        (-11424.0, "\N{MINUS SIGN}11,400"),
        (0.98, "0.98"),
        (2e6, "2e+06"),
        (999.6, "1,000"),
    ],
)
def test_numbers_have_three_digits(value, text):
    assert number(value) == text


@pytest.mark.parametrize(
    ("value", "text"), [(1.0 - 1e-6, "> 0.999"), (1e-200, "< 1e-99"), (float("nan"), "not known")]
)
def test_a_probability_is_not_read_as_certain(value, text):
    assert probability_text(value) == text


@pytest.mark.parametrize(
    ("text", "printed"),
    [
        ("zeta_eq = 4 c A w^2 / (3 pi k) -> zeta", "ζ_eq = 4 c A w² / (3 π k) → ζ"),
        ("x^n, beta2, multiplier mu", "x^n, beta2, multiplier μ"),
    ],
)
def test_formulas_have_greek_letters_and_powers(text, printed):
    assert formula(text) == printed


@pytest.mark.parametrize(("words", "text"), [(["a"], "a"), (["a", "b", "c"], "a, b and c")])
def test_lists_end_with_and(words, text):
    assert listing(words) == text


@given(st.floats(-1e6, 1e6), st.floats(1e-9, 1e3))
def test_rounding_keeps_values_within_a_twentieth_of_their_spread(value, spread):
    text = rounded(value, spread).replace("\N{MINUS SIGN}", "-")
    assert abs(float(text) - value) <= 0.051 * spread + 1e-9 * abs(value)


@pytest.fixture(scope="module")
def strains():
    """Residuals of four channels that are the first gauges of a wing."""
    residuals = Bench().fit(np.random.default_rng(3))
    channels = {
        name: replace(channel, output=f"strain[{gauge}]")
        for gauge, (name, channel) in enumerate(residuals.channels.items(), start=1)
    }
    return replace(residuals, channels=channels)


def test_gauges_lie_where_the_design_has_them(strains):
    """Gauges count from one."""
    design = load_design()
    places = gauge_places(list(strains.channels.values()), design)
    assert list(places.values()) == list(design.gauges.positions[:4])


def test_a_gauge_lies_where_its_channel_says(strains):
    channel = replace(strains.channels["g1"], station=0.5, chord=0.2)
    assert gauge_places([channel], load_design()) == {"g1": (0.5, 0.2)}


def test_gauges_are_named_on_the_planform(strains):
    figure = planform_figure(strains, None, load_design())
    assert [text.get_text() for text in figure.axes[0].texts] == ["g1", "g2", "g3", "g4"]


def test_without_gauges_there_is_no_planform(strains):
    nowhere = {name: replace(channel, output="x") for name, channel in strains.channels.items()}
    assert planform_figure(replace(strains, channels=nowhere), None, load_design()) is None


@pytest.mark.parametrize(
    ("kind", "primitive", "text"),
    [
        ("rig", PowerDamping("slide", 0.5, 0.0, 0.0, 1.0, 1.0), "slide rubs with 0.5000 N"),
        ("rig", PowerDamping("slide", 0.5, 2.0, 0.0, 0.25, 1.0), "force 0.5000 N at 0.25 m/s"),
        ("rig", patches.PowerStiffness("slide", -3.0, 3.0, 0, 0.01), "slide softens by 3 N at 0.01 m"),
        ("rig", patches.PointMass(0.2, 0.4), "mass 0.200 kg at 0.4 m"),
        ("rig", patches.SensorGain("displacement", 0.02), ""),
        ("rig", SensorDrift("displacement", 0.002, 10.0), "amplitude 0.002 m"),
        ("rig", SensorDrift("leaf_strain", 0.002, 10.0), ""),
        ("rig", PowerDamping("elsewhere", 0.5, 0.0, 0.0, 1.0, 1.0), "elsewhere rubs with 0.500 N or N m"),
        (
            "tank",
            PowerDamping("outlet", 0.5, 0.0, 0.0, 2.0, 1.0),
            "outlet lets through 0.500 m/s times capacity",
        ),
        ("tank", PowerDamping("outlet", 0.5, 0.5, 0.0, 2.0, 1.0), "flow 0.500 m/s times capacity at 2 m"),
        ("tank", patches.Overflow("outlet", 0.5, 1.5, 3.0, 2.0), "flow 0.500 m/s times capacity, level 3 m"),
        ("wing", PowerDamping("root", 0.5, 0.0, 0.0, 1.0, 1.0), "root rubs with 0.500 N m"),
        ("wing", PowerDamping("tip", 0.5, 0.0, 0.0, 1.0, 1.0), "tip rubs with 0.500 N"),
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
    known = {"measured": "N m", "driven": "N m", "straight": "N", "stretch": "N"}
    assert units == known | dict.fromkeys(("free", "half known", "mixed"), "N or N m")


# ---------------------------------------------------------------- the folder


@pytest.fixture
def old_verdict(tmp_path):
    """Folder of a verdict with a note of the user's."""
    folder = tmp_path / "v"
    folder.mkdir()
    (folder / "verdict.json").write_text("first", encoding="utf-8")
    (folder / "notes.txt").write_text("mine", encoding="utf-8")
    return folder


def check_old_verdict(folder):
    """Check that the verdict is whole, and nothing beside it."""
    assert (folder / "verdict.json").read_text(encoding="utf-8") == "first"
    assert (folder / "notes.txt").read_text(encoding="utf-8") == "mine"
    assert [path.name for path in folder.parent.iterdir()] == ["v"]


def test_an_old_verdict_is_not_lost_where_writing_fails(drag, old_verdict):
    def refuse(patch, target):
        raise OSError(28, "No space left on device")

    failing = ReportInput(drag, ORIGIN, pack=refuse)
    with pytest.raises(FileNotWrittenError, match="No space"):
        write_verdict_folder(old_verdict, failing, replace_it=True, report=False)
    check_old_verdict(old_verdict)


def test_an_old_verdict_is_not_lost_where_another_process_replaces_it(drag, old_verdict):
    lock = lock_folder(old_verdict)
    with pytest.raises(FileNotWrittenError, match="another process is replacing"):
        write_verdict_folder(old_verdict, ReportInput(drag, ORIGIN), replace_it=True, report=False)
    os.close(lock)


def check_for_replacement(folder):
    check_verdict_folder(folder, replace_it=True)


@pytest.mark.parametrize("look", [check_for_replacement, read_verdict])
def test_an_old_verdict_that_a_killed_process_had_moved_aside_is_put_back(old_verdict, look):
    """How a kill between the moves leaves it is in test_workflow of twin_master.

    The verdict of this test is a word, which is refused once it is back.
    """
    aside = old_verdict.parent / ".v.old-x" / "v"
    aside.parent.mkdir()
    old_verdict.rename(aside)
    with suppress(VerdictFileError):
        look(old_verdict)
    check_old_verdict(old_verdict)


def test_an_old_verdict_is_replaced_on_demand_only(drag, old_verdict):
    with pytest.raises(FileNotWrittenError, match="--replace"):
        write_verdict_folder(old_verdict, ReportInput(drag, ORIGIN), report=False)
    other = old_verdict.with_name("other")
    other.mkdir()
    write_verdict_folder(old_verdict, ReportInput(drag, ORIGIN), replace_it=True, report=False)
    assert not (old_verdict / "notes.txt").exists()
    assert stat.S_IMODE(old_verdict.stat().st_mode) == stat.S_IMODE(other.stat().st_mode)


@pytest.mark.parametrize(("name", "sentence"), [(".", "left unchanged"), ("chapter.tex", "not a folder")])
def test_what_is_no_verdict_is_never_replaced(tmp_path, name, sentence):
    (tmp_path / "chapter.tex").write_text("x", encoding="utf-8")
    with pytest.raises(FileNotWrittenError, match=sentence):
        check_verdict_folder(tmp_path / name, replace_it=True)


@pytest.fixture(scope="module")
def folder_of_drag(drag, able, tmp_path_factory):
    """The folder of the verdict, with its report."""
    folder = tmp_path_factory.mktemp("drag") / "verdict"
    write_verdict_folder(folder, ReportInput(drag, ORIGIN, able))
    return folder


@pytest.fixture(scope="module")
def page_of_drag(folder_of_drag):
    return next(folder_of_drag.glob("*.html")).read_text(encoding="utf-8")


def test_the_page_of_a_named_effect_has_its_name_and_equation(drag, page_of_drag):
    """The equation is that of the catalogue."""
    assert drag.verdict.kind is VerdictKind.NAMED
    assert "quadratic aerodynamic damping" in page_of_drag
    assert "F = c |v| v" in page_of_drag


def test_the_page_of_a_verdict_contains_all_that_it_shows(folder_of_drag, page_of_drag):
    assert page_of_drag.count("<script>") == page_of_drag.count("<script") == 1
    assert not re.search(r'(?:src|href)="(?!#|data:)', page_of_drag)
    assert str(folder_of_drag.parent) not in page_of_drag


@pytest.mark.parametrize(
    "title", ["Effects", "Where the gap is", "Proof on held-out trials", "What this campaign can decide"]
)
def test_the_page_of_a_verdict_has_its_sections(page_of_drag, title):
    assert f">{title}<" in page_of_drag


def test_identifiers_of_a_page_are_unique(page_of_drag):
    identifiers = re.findall(r'\bid="([^"]+)"', page_of_drag)
    assert len(set(identifiers)) == len(identifiers)


def test_the_files_of_a_verdict_read_back(drag, folder_of_drag):
    stored = read_verdict_file(folder_of_drag / "verdict.json")
    residuals = read_residuals(folder_of_drag / "residuals.nc")
    assert stored.verdict.sentence == drag.verdict.sentence
    assert len(residuals.trials) == len(drag.campaign.trials)


def test_the_patch_of_a_verdict_has_its_effect_with_intervals(drag, folder_of_drag):
    patch = read_patch(folder_of_drag / "patch.json")
    interval = patch.effects[0].intervals[0]
    assert patch.patch == drag.verdict.effects[0].patch
    assert patch.verdict is VerdictKind.NAMED
    assert interval.low < interval.value < interval.high


def test_the_folder_of_a_verdict_has_figures_and_nothing_half_written(folder_of_drag):
    figures = {path.name for path in (folder_of_drag / "figures").iterdir()}
    assert {"history.svg", "history.png", "missing_force.svg", "backbone.svg", "separability.png"} <= figures
    assert not list(folder_of_drag.parent.glob(".*"))


def test_the_report_of_a_verdict_repeats_to_the_bit(drag, able, folder_of_drag, page_of_drag):
    patch = read_patch(folder_of_drag / "patch.json")
    content = ReportInput(drag, ORIGIN, able, intervals=[effect.intervals for effect in patch.effects])
    figures = report_figures(content)
    drawn = {name: page_figure(figure) for name, figure in figures.items()}
    held_out = listing(trial.name for trial in drag.campaign.held_out)
    assert f"Held out: {held_out};" in figures["residual_table"].caption
    assert render_page(verdict_page(content, drawn)) == page_of_drag
