"""The way back: a campaign, its verdict, the model patched by it, the campaign once more; models by name."""

import json
import shlex
import shutil
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import uav_twin
from discrepancy.application import _command_with_model, apply_verdict, has_applicable_effects
from discrepancy.campaign.records import Channel, NoiseRecord, Quantity
from discrepancy.document import Origin
from discrepancy.errors import ModelError, VerdictFileError
from discrepancy.files.verdict import read_patch
from discrepancy.fits.candidate import Candidate
from discrepancy.fits.fitting import fit
from discrepancy.model_choice import choose_model
from discrepancy.report.figures import ReportInput
from discrepancy.search.whole_search import search
from discrepancy.sources.examples import example_campaign, usual_plan
from discrepancy.system.lumped_file import SHIPPED_MODELS
from discrepancy.system.response import Conditions
from discrepancy.system.sensing import observe
from discrepancy.verdict import VerdictKind
from discrepancy.verdict_folder import write_verdict_folder
from discrepancy.workflow import investigate
from fe.runtime.patch import ModelPatch, SensorGain
from fmu_asset.archive.fmu_file import read_fmu
from reporting.errors import FileNotWrittenError
from reporting.provenance import collect_provenance
from tests import command_line
from tests.discrepancy.core.kit import problem_of
from tests.discrepancy.rigs import chosen, drag_beside_a_drift, fmu_rig, hiding, simulated


def run(*words, failed=False):
    """Return what a command says, on the stream where it says it."""
    done = command_line.command("discrepancy", *words)
    assert (done.returncode == 1) is failed, done.stderr
    return done.stderr if failed else done.stdout


SPRING = chosen("cubic_stiffness", "load_cell")
CUBIC = {"stiffening": 0.15}


def verdict_of(choice, campaign, effects, folder, *, replace_it=False):
    """Investigate, and write the folder of the verdict without its report."""
    found = investigate(campaign, choice.model, effects, thorough=False)
    origin = Origin(
        campaign.name, choice.model.name, campaign.data_hash, choice.source_hash,
        "uav-twin discrepancy run 'a campaign' --model rig.toml --seed 0", collect_provenance(0), choice.file,
    )  # fmt: skip
    write_verdict_folder(folder, ReportInput(found, origin), report=False, replace_it=replace_it)
    return found


# ---------------------------------------------------------------- round trips


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory):
    """A folder with a lumped model, a campaign with a cubic spring hidden in it, and its verdict."""
    folder = tmp_path_factory.mktemp("laboratory")
    shutil.copy(SHIPPED_MODELS / "single_mass_rig.toml", folder / "rig.toml")
    spring = ("--seed", 3, "--effect", "cubic_stiffness@slide=0.15")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        run("example", "static", "lab", "--model", "rig.toml", *spring)
        said = run("run", "lab", "--model", "rig.toml", "--out", "verdict", "--no-report")
    assert "Verdict: named" in said
    assert said.rstrip().endswith("Next: uav-twin discrepancy apply verdict")
    return folder


class CommandLineRoundTrip:
    """A verdict is applied and its campaign run again, each in another folder, as a user does."""

    def __init__(self, laboratory, folder):
        self.folder = folder
        self.stored = uav_twin.read_verdict(laboratory / "verdict")
        with pytest.MonkeyPatch.context() as patch:
            patch.chdir(folder)
            shutil.copytree(laboratory / "verdict", "verdicts/copy")
            self.first_line, next_line = run("apply", "verdicts/copy").splitlines()
            self.words = shlex.split(next_line.removeprefix("Next: uav-twin discrepancy "))
            self.printed = run(*self.words, "--no-report")
        self.text = (folder / "rig_patched.toml").read_text(encoding="utf-8")
        self.model = tomllib.loads(self.text)


@pytest.fixture(scope="module")
def round_trip(laboratory, tmp_path_factory):
    return CommandLineRoundTrip(laboratory, tmp_path_factory.mktemp("round_trip"))


def test_a_patched_model_says_what_it_was_patched_with(round_trip):
    sentence = "Geometric (cubic) stiffness at slide, named."
    (law,) = round_trip.model["law"]
    assert round_trip.first_line == f"rig_patched.toml: {sentence}"
    assert round_trip.text.startswith(f"# {sentence}")
    assert (law["kind"], law["port"]) == ("power_stiffness", "slide")


def test_a_patched_model_has_the_parameters_of_its_verdict(round_trip):
    """The prior's deviation is 0.02."""
    parameters = round_trip.stored.verdict.parameters
    rows = [(row["name"], row["mean"], row["deviation"]) for row in round_trip.model["parameter"][:-1]]
    assert rows == [(item.name, item.mean, item.deviation) for item in parameters]
    assert parameters[0].deviation < 0.02


def test_a_patched_model_has_the_deviation_of_its_law_as_a_parameter(round_trip):
    """The force is proportional to the only size of the effect."""
    (size,) = round_trip.stored.verdict.effects[0].parameters
    factor = round_trip.model["parameter"][-1]
    assert (factor["name"], factor["terms"]) == ("cubic_stiffness_factor", ["cubic_stiffness"])
    assert factor["mean"] == 1.0
    relative_width = (size.high - size.low) / (2.0 * 1.645 * size.value)
    # the patch has the quantiles of draws, which scatter
    assert factor["deviation"] == pytest.approx(relative_width, rel=0.25)


def test_the_next_run_keeps_value_and_deviation_of_a_law(round_trip):
    """The same records again: the value within a deviation, and the deviation not larger."""
    prior = round_trip.model["parameter"][-1]
    again = uav_twin.read_verdict(round_trip.folder / round_trip.words[-1]).verdict
    (posterior,) = (item for item in again.parameters if item.name == "cubic_stiffness_factor")
    assert posterior.mean == pytest.approx(1.0, abs=prior["deviation"])
    assert 0.3 * prior["deviation"] < posterior.deviation <= prior["deviation"]


def test_of_a_patched_model_nothing_is_missing_any_more(round_trip):
    end = ["--model", "rig_patched.toml", "--out", "verdicts/lab_rig_patched"]
    assert round_trip.words[-4:] == end
    assert "Verdict: nothing missing" in round_trip.printed
    assert "apply" not in round_trip.printed


def test_a_verdict_of_nothing_missing_is_not_applied(round_trip, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = round_trip.folder / round_trip.words[-1]
    sentence = run("apply", folder, "--out", "more.json", failed=True)
    assert "nothing is missing, and the model needs no change" in sentence
    assert not list(tmp_path.iterdir())


def test_the_command_of_a_verdict_repeats_the_run_in_any_folder(laboratory, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    stored = uav_twin.read_verdict(laboratory / "verdict")
    run(*shlex.split(stored.origin.command)[2:], "--no-report")
    once, again = (
        json.loads((folder / "verdict.json").read_text(encoding="utf-8"))
        for folder in (laboratory / "verdict", tmp_path / "verdicts" / "lab")
    )
    assert once == again


def test_the_command_of_a_verdict_of_a_flight_gets_another_model():
    command = "uav-twin discrepancy run --from-run /flights/m1 --to-step 3 --model own.toml --seed 0"
    assert _command_with_model(command, Path("two/one.json")) == (
        "uav-twin discrepancy run --from-run /flights/m1 --to-step 3 --model two/one.json "
        "--out verdicts/m1_one"
    )


def test_the_next_command_is_relative_to_the_working_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    command = f"uav-twin discrepancy run {tmp_path}/my_cart --model {tmp_path}/m.toml --seed 7"
    assert _command_with_model(command, tmp_path / "m_patched.toml") == (
        "uav-twin discrepancy run my_cart --seed 7 --model m_patched.toml --out verdicts/my_cart_m_patched"
    )


class PythonRoundTrip:
    """A model with a hidden cubic spring: its verdict, and the model that is patched by it."""

    def __init__(self, kind, file, folder):
        self.kind, self.file, self.folder = kind, file, folder
        choice = choose_model(file)
        ports = choice.model.ports
        hidden = ("cubic_stiffness", CUBIC, "tip" if "tip" in ports else ports[0])
        self.campaign = simulated(choice.model, "static", 3, hidden, folder / "campaign")
        self.verdict = verdict_of(choice, self.campaign, SPRING, folder / "verdict").verdict
        self.applied = uav_twin.apply_verdict(folder / "verdict", folder / "patched.json")
        self.patched = choose_model(self.applied.path)


@pytest.fixture(scope="module", params=["FMU", "structure", "wing"])
def python_round_trip(request, foreign_fmu, write_beam, tmp_path_factory):
    folder, file = tmp_path_factory.mktemp("python"), None
    if request.param == "FMU":
        shutil.copy(foreign_fmu("rig2"), folder / "rig.fmu")
        file = fmu_rig(folder, "rig.fmu")
    elif request.param == "structure":
        file = write_beam(folder, {'set = "end", force': "point = [100, 10, 5], force"}, cells=2)
    return PythonRoundTrip(request.param, file, folder)


def test_a_patch_beside_the_file_of_a_model_is_a_model_itself(python_round_trip):
    trip = python_round_trip
    assert trip.verdict.kind is VerdictKind.NAMED, trip.verdict.sentence
    assert len(trip.patched.model.patch)
    assert trip.patched.model.patch == trip.verdict.effects[0].patch


def test_a_model_that_is_patched_from_python_has_the_calibrated_parameters(python_round_trip):
    trip = python_round_trip
    model = trip.patched.model
    listed = [parameter for parameter in model.parameters if parameter.name not in model.nuisance_parameters]
    for parameter, calibrated in zip(listed, trip.verdict.parameters, strict=True):
        assert (parameter.mean, parameter.deviation) == (calibrated.mean, calibrated.deviation)


def test_an_applied_verdict_names_the_command_that_runs_again(python_round_trip):
    out = "'verdicts/a campaign_patched'"
    file = python_round_trip.folder / "patched.json"
    assert python_round_trip.applied.command.endswith(f"--model {file} --out {out}")


def test_of_a_model_that_is_patched_from_python_nothing_is_missing(python_round_trip, tmp_path):
    trip = python_round_trip
    again = verdict_of(trip.patched, trip.campaign, SPRING, tmp_path / "again").verdict
    assert again.kind is VerdictKind.NOTHING_MISSING, again.sentence


WING = pytest.mark.parametrize("python_round_trip", ["wing"], indirect=True)


@WING
def test_a_verdict_that_leaves_no_patch_has_its_channels(python_round_trip, tmp_path):
    """As it is for another member of a group and for an unexplained gap."""
    folder = shutil.copytree(python_round_trip.folder / "verdict", tmp_path / "verdict")
    patch = folder / "patch.json"
    channels = read_patch(patch).channels
    patch.unlink()
    applied = apply_verdict(folder, tmp_path / "second.json")
    assert "tip_displacement" in channels.values()
    assert read_patch(applied.path).channels == channels


@WING
def test_a_wing_is_packed_with_its_effects_and_calibrated_parameters(python_round_trip, tmp_path):
    applied = apply_verdict(python_round_trip.folder / "verdict", tmp_path / "wing.fmu")
    fmu = read_fmu(applied.path)
    calibrated = {item.name: item.mean for item in python_round_trip.verdict.parameters}
    starts = {
        "effect.cubic_stiffness.active": 1.0,
        "young_modulus_factor": calibrated["young_modulus_factor"],
        "damping.alpha": calibrated["damping_alpha"],
    }
    assert {name: float(str(fmu.variable(name).start)) for name in starts} == starts


@pytest.mark.parametrize(
    ("python_round_trip", "change"),
    [("FMU", ("high = 1.3", "high = 1.4")), ("structure", ("density = 2700", "density = 2710"))],
    indirect=["python_round_trip"],
)
def test_a_patch_is_refused_once_the_file_of_its_model_has_changed(python_round_trip, change):
    trip = python_round_trip
    text = trip.file.read_text(encoding="utf-8")
    trip.file.write_text(text.replace(*change), encoding="utf-8")
    sentence = r"has changed since .* run `uav-twin discrepancy run` again"
    try:
        for use in (
            lambda: choose_model(trip.applied.path),
            lambda: apply_verdict(trip.folder / "verdict", "x.json"),
        ):
            with pytest.raises(ModelError, match=sentence):
                use()
    finally:
        trip.file.write_text(text, encoding="utf-8")


ROOT_OR_CRACK = chosen("support_compliance", "breathing_crack")


class GroupVerdict:
    """The verdict of a static campaign that cannot tell a compliant root from a crack."""

    def __init__(self, folder):
        self.folder = folder / "verdict"
        self.campaign = folder / "campaign"
        choice = choose_model("three_mass_chain")
        hidden = ("support_compliance", {"compliance_share": 0.11}, "")
        campaign = simulated(choice.model, "static", 3, hidden, self.campaign)
        self.verdict = verdict_of(choice, campaign, ROOT_OR_CRACK, self.folder).verdict


@pytest.fixture(scope="module")
def group_verdict(tmp_path_factory):
    return GroupVerdict(tmp_path_factory.mktemp("group"))


def test_a_static_campaign_cannot_tell_a_compliant_root_from_a_crack(group_verdict):
    verdict = group_verdict.verdict
    assert verdict.kind is VerdictKind.GROUP, verdict.sentence
    assert set(verdict.group) == {"support_compliance", "breathing_crack"}


class AppliedMember:
    """A member of the group that is applied: the leading one unless another one is asked for."""

    def __init__(self, group_verdict, is_leading, folder):
        self.group = group_verdict
        leading, other = group_verdict.verdict.group
        self.name = leading if is_leading else other
        self.file = folder / f"{self.name}.json"
        options = () if is_leading else ("--member", other)
        self.printed = run("apply", group_verdict.folder, "--out", self.file, *options)
        self.patch = read_patch(self.file)


@pytest.fixture(scope="module", params=[True, False], ids=["leading", "other"])
def applied_member(request, group_verdict, tmp_path_factory):
    return AppliedMember(group_verdict, request.param, tmp_path_factory.mktemp("member"))


def test_a_member_of_a_group_is_no_name(applied_member):
    leading, other = applied_member.group.verdict.group
    sentence = f"one of a group that the data cannot tell apart, and not a name (group: {leading}, {other})."
    first_sentence = applied_member.printed.splitlines()[0].split(": ", 1)[1]
    assert sentence in applied_member.printed
    assert applied_member.patch.verdict is VerdictKind.GROUP
    assert applied_member.patch.sentence.startswith(first_sentence)


def test_a_member_of_a_group_has_the_parameters_of_its_own_fit(applied_member):
    name, hypotheses = applied_member.name, applied_member.group.verdict.hypotheses
    hypothesis = next(item for item in hypotheses if item.identifiers == (name,))
    assert [effect.identifier for effect in applied_member.patch.effects] == [name]
    assert applied_member.patch.parameters == hypothesis.parameters


def test_each_member_of_a_group_closes_the_gap(applied_member):
    campaign = uav_twin.read_campaign(applied_member.group.campaign)
    verdict = investigate(campaign, applied_member.file, ROOT_OR_CRACK, thorough=False).verdict
    assert verdict.kind is VerdictKind.NOTHING_MISSING, verdict.sentence


def test_what_is_no_member_of_a_group_is_refused(group_verdict):
    leading, other = group_verdict.verdict.group
    sentence = run("apply", group_verdict.folder, "--member", "overflow", failed=True)
    assert f"which has '{leading}', '{other}'" in sentence


@pytest.fixture(scope="module")
def unexplained(tmp_path_factory):
    """The verdict on drag beside a drift, with nothing but the drift to explain both, and its folder."""
    folder = tmp_path_factory.mktemp("unexplained")
    choice = choose_model("single_mass_rig")
    campaign, _ = drag_beside_a_drift(folder / "campaign")
    return verdict_of(choice, campaign, chosen("stiffness_drift"), folder / "verdict"), folder / "verdict"


def test_the_best_hypothesis_can_be_applied_if_it_takes_error_away(unexplained):
    investigation, _ = unexplained
    verdict, proof = investigation.verdict, investigation.proof
    grown = replace(proof, closed=replace(proof.closed, value=-0.3))
    assert verdict.kind is VerdictKind.UNEXPLAINED, verdict.sentence
    assert has_applicable_effects(verdict, proof)
    assert not any(has_applicable_effects(verdict, other) for other in (None, grown))


def test_the_best_hypothesis_for_an_unexplained_gap_is_marked(unexplained, tmp_path):
    applied = apply_verdict(unexplained[1], tmp_path / "patched.json")
    patch = read_patch(applied.path)
    assert applied.sentence.endswith("the best hypothesis for a gap that stays unexplained: not a name.")
    assert patch.sentence.startswith(applied.sentence)
    assert (patch.verdict, [effect.identifier for effect in patch.effects]) == (
        VerdictKind.UNEXPLAINED,
        ["stiffness_drift"],
    )


def test_what_is_no_law_at_a_port_does_not_stand_in_the_file_of_a_lumped_model(unexplained, tmp_path):
    sentence = "only laws at the ports of a lumped model can be written into its own file"
    with pytest.raises(ModelError, match=sentence):
        apply_verdict(unexplained[1], tmp_path / "patched.toml")


# ---------------------------------------------------------------- files


@pytest.fixture
def own_file(tmp_path, monkeypatch):
    """A file of the user's in the folder at hand."""
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "there.toml"
    file.write_text("mine", encoding="utf-8")
    return file


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (("--out", "there.toml"), "there.toml exists: choose another --out or give --replace"),
        (("--out", "LABORATORY/rig.toml", "--replace"), "is a file from which the patched model is made"),
        (("--out", "model.xml"), "must end in one of .toml, .json, .fmu"),
        (("--out", "model.fmu"), "only a wing is packed with its effects"),
        (("--member", "free_play"), "has no group: leave it out"),
    ],
)
def test_files_are_not_taken_from_their_owner(laboratory, own_file, options, sentence):
    words = [word.replace("LABORATORY", str(laboratory)) for word in options]
    refusal = run("apply", laboratory / "verdict", *words, failed=True)
    assert sentence in refusal
    assert len(refusal.strip().splitlines()) == 1
    assert [(path, path.read_text("utf-8")) for path in own_file.parent.iterdir()] == [(own_file, "mine")]


def test_a_file_is_replaced_by_a_patched_model_on_demand(laboratory, own_file):
    run("apply", laboratory / "verdict", "--out", own_file.name, "--replace")
    assert uav_twin.load_model(own_file.name).name.endswith("with geometric (cubic) stiffness")


def rewritten(file, change):
    """Write a JSON file anew with its content changed."""
    content = json.loads(file.read_text(encoding="utf-8"))
    change(content)
    file.write_text(json.dumps(content), encoding="utf-8")


def test_a_model_is_found_beside_its_patch(laboratory, tmp_path):
    """Files that moved together are a model still; one without its base is not."""
    there, moved = shutil.copytree(laboratory, tmp_path / "there"), tmp_path / "moved"
    own = str(there / "rig.toml")
    rewritten(there / "verdict" / "verdict.json", lambda content: content.update(model_file=own))
    apply_verdict(there / "verdict", there / "patched.json")
    there.rename(moved)
    assert len(uav_twin.load_model(moved / "patched.json").patch)
    (moved / "rig.toml").unlink()
    with pytest.raises(
        ModelError, match="does not exist any more: put it back there, or into the folder of patched"
    ):
        uav_twin.load_model(moved / "patched.json")


def test_a_verdict_of_an_earlier_version_asks_for_another_run(laboratory, tmp_path):
    """It is read (`files/test_verdict_file.py`), but does not say where its model is."""
    folder = shutil.copytree(laboratory / "verdict", tmp_path / "verdict")
    patch = folder / "patch.json"
    rewritten(folder / "verdict.json", lambda content: content.update(model_file=None))
    rewritten(patch, lambda content: [content.pop(key) for key in ("model_file", "parameters")])
    rewritten(patch, lambda content: content.update(schema="uav-twin patch 1"))
    assert read_patch(patch).patch == read_patch(laboratory / "verdict" / "patch.json").patch
    for call in (lambda: apply_verdict(folder, tmp_path / "x.toml"), lambda: choose_model(patch)):
        with pytest.raises(VerdictFileError, match="was left by an earlier version"):
            call()


class SecondVerdict:
    """A model that is patched by a verdict, and the verdict on drag that this model lacks."""

    def __init__(self, laboratory, folder):
        self.rig, self.first_file = laboratory / "rig.toml", folder / "first.json"
        self.folder = folder / "verdict"
        self.first = choose_model(apply_verdict(laboratory / "verdict", self.first_file).path)
        drag = ("quadratic_damping", {"equivalent_damping_ratio": 0.02}, "slide")
        campaign = simulated(self.first.model, "ringdown", 5, drag, folder / "campaign")
        self.verdict = verdict_of(self.first, campaign, chosen("quadratic_damping"), self.folder).verdict


@pytest.fixture(scope="module")
def second_verdict(laboratory, tmp_path_factory):
    return SecondVerdict(laboratory, tmp_path_factory.mktemp("second"))


def test_what_a_patched_model_lacks_is_named(second_verdict):
    assert len(second_verdict.first.model.patch)
    assert [item.identifier for item in second_verdict.verdict.effects] == ["quadratic_damping"]


def test_files_beneath_a_patched_model_are_not_replaced(second_verdict):
    base_files = (str(second_verdict.rig), str(second_verdict.first_file))
    files = (*base_files, second_verdict.folder / "verdict.json", second_verdict.folder / "patch.json")
    assert choose_model(second_verdict.folder / "patch.json").base_files == base_files
    for file in files:
        with pytest.raises(FileNotWrittenError, match="is a file from which the patched model is made"):
            apply_verdict(second_verdict.folder, file, replace=True)


def test_effects_are_applied_upon_each_other_in_the_file_of_the_model(second_verdict, tmp_path):
    path = apply_verdict(second_verdict.folder, tmp_path / "second.toml").path
    laws = tomllib.loads(path.read_text(encoding="utf-8"))["law"]
    assert [law["name"] for law in laws] == ["cubic_stiffness", "quadratic_damping"]


def test_effects_are_applied_upon_each_other_in_a_patch(second_verdict, tmp_path):
    patch = read_patch(apply_verdict(second_verdict.folder, tmp_path / "both.json").path)
    assert patch.origin.model_file == str(second_verdict.rig.resolve())
    assert patch.patch == second_verdict.first.model.patch + second_verdict.verdict.effects[0].patch


def test_the_file_of_a_model_has_the_parameters_of_its_patch_and_one_for_each_law(second_verdict, tmp_path):
    patch = uav_twin.load_model(apply_verdict(second_verdict.folder, tmp_path / "both.json").path)
    file = uav_twin.load_model(apply_verdict(second_verdict.folder, tmp_path / "second.toml").path)

    calibrated, of_laws = file.parameters[: len(patch.parameters)], file.parameters[len(patch.parameters) :]
    assert calibrated == patch.parameters
    assert [parameter.name for parameter in of_laws] == ["cubic_stiffness_factor", "quadratic_damping_factor"]


def test_a_built_in_sensor_is_that_of_its_channel():
    """Of two channels that measure one output, the one that the effect was found on."""
    model = uav_twin.load_model("single_mass_rig")
    noise = NoiseRecord(1e-5, 50.0)
    laser = Channel("laser", Quantity.DISPLACEMENT, "displacement", noise)
    transducer = Channel("transducer", Quantity.DISPLACEMENT, "displacement", noise)
    plan = replace(usual_plan(model), channels=(laser, transducer))
    campaign = example_campaign(model, "static", 0, plan)
    patched = model.with_patch(ModelPatch((SensorGain("laser", 0.1),)))
    readings = observe(patched, campaign, campaign.trials[0], ModelPatch(), Conditions(np.ones(2))).values
    of_laser, of_transducer = readings.T
    np.testing.assert_allclose(of_laser, 1.1 * of_transducer, rtol=1e-12)
    assert np.abs(of_transducer).max() > 0.0


def test_friction_in_the_model_is_fitted_from_the_beginnings():
    """A motion that friction ends has many optima; from the prior means the fit ends far off in one."""
    model = uav_twin.load_model("single_mass_rig")
    friction = "coulomb_friction", {"friction_ratio": 0.04}, "slide"
    campaign = simulated(model, "ringdown", 1, friction)
    patched = model.with_patch(hiding(campaign, model, *friction))
    problem = problem_of(campaign, patched)
    count = problem.sample_counts.sum()
    assert fit(problem, Candidate(), problem.prior_mean_point(Candidate())).chi_square > 10.0 * count
    assert search(problem, chosen("load_cell")).no_effect.chi_square < 1.2 * count


# ---------------------------------------------------------------- models by name or file


def test_a_structure_needs_no_cache(write_beam, tmp_path, monkeypatch):
    (tmp_path / "no_folder").write_text("", encoding="utf-8")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "no_folder"))
    file = write_beam(tmp_path, {'set = "end", force': "point = [100, 10, 5], force"}, cells=2)
    assert choose_model(file).model.ports == ("tip",)
