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
from tests.discrepancy.rigs import chosen, fmu_rig, hiding, simulated


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


def test_there_and_back_by_the_command_line(laboratory, tmp_path, monkeypatch):
    """Run, apply, run again, each in another folder: nothing is missing any more."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(laboratory / "verdict", "verdicts/copy")
    first, then = run("apply", "verdicts/copy").splitlines()
    assert first == "rig_patched.toml: Geometric (cubic) stiffness at slide, named."
    text = (tmp_path / "rig_patched.toml").read_text(encoding="utf-8")
    assert text.startswith("# Geometric (cubic) stiffness at slide, named.")
    content = tomllib.loads(text)
    (law,) = content["law"]
    assert (law["kind"], law["port"]) == ("power_stiffness", "slide")
    stored = uav_twin.read_verdict(laboratory / "verdict")
    assert [(row["name"], row["mean"], row["deviation"]) for row in content["parameter"]] == [
        (item.name, item.mean, item.deviation) for item in stored.verdict.parameters
    ]
    assert stored.verdict.parameters[0].deviation < 0.02  # the prior's
    words = shlex.split(then.removeprefix("Next: uav-twin discrepancy "))
    assert words[-4:] == ["--model", "rig_patched.toml", "--out", "verdicts/lab_rig_patched"]
    said = run(*words, "--no-report")
    assert "Verdict: nothing missing" in said
    assert "apply" not in said
    assert "nothing is missing, and the model needs no change" in run(
        "apply", words[-1], "--out", "more.json", failed=True
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == ["rig_patched.toml", "verdicts"]
    # the command of a verdict repeats the run in any folder
    run(*shlex.split(stored.origin.command)[2:], "--no-report")
    once, again = (
        json.loads((folder / "verdict.json").read_text(encoding="utf-8"))
        for folder in (laboratory / "verdict", tmp_path / "verdicts" / "lab")
    )
    assert once == again
    command = "uav-twin discrepancy run --from-run /flights/m1 --to-step 3 --model own.toml --seed 0"
    assert _command_with_model(command, Path("two/one.json")) == (
        "uav-twin discrepancy run --from-run /flights/m1 --to-step 3 --seed 0 --model two/one.json "
        "--out verdicts/m1_one"
    )


@pytest.mark.parametrize("kind", ["FMU", "structure", "wing"])
def test_there_and_back_from_python(kind, foreign_fmu, write_beam, tmp_path):
    """A patch beside the model's own file is a model itself, refused once that file has changed."""
    file = tmp_path / "rig.toml"
    if kind == "FMU":
        shutil.copy(foreign_fmu("rig2"), tmp_path / "rig.fmu")
        file = fmu_rig(tmp_path, "rig.fmu")
    elif kind == "structure":
        file = write_beam(tmp_path, {'set = "end", force': "point = [100, 10, 5], force"}, cells=2)
    choice = choose_model(None if kind == "wing" else file)
    ports = choice.model.ports
    port = "tip" if "tip" in ports else ports[0]
    hidden = "cubic_stiffness", CUBIC, port
    campaign = simulated(choice.model, "static", 3, hidden, tmp_path / "campaign")
    found = verdict_of(choice, campaign, SPRING, tmp_path / "verdict")
    assert found.verdict.kind is VerdictKind.NAMED, found.verdict.sentence
    applied = uav_twin.apply_verdict(tmp_path / "verdict", tmp_path / "patched.json")
    out = "'verdicts/a campaign_patched'"
    assert applied.command.endswith(f"--model {tmp_path / 'patched.json'} --out {out}")
    patched = choose_model(applied.path)
    assert len(patched.model.patch)
    assert patched.model.patch == found.verdict.effects[0].patch
    for item, calibrated in zip(patched.model.parameters, found.verdict.parameters, strict=True):
        assert (item.mean, item.deviation) == (calibrated.mean, calibrated.deviation)
    again = verdict_of(patched, campaign, SPRING, tmp_path / "again")
    assert again.verdict.kind is VerdictKind.NOTHING_MISSING, again.verdict.sentence
    if kind == "wing":
        left = tmp_path / "verdict" / "patch.json"
        channels = read_patch(left).channels
        assert "tip_displacement" in channels.values()
        left.unlink()  # as for what leaves none: another member of a group, an unexplained gap
        assert read_patch(apply_verdict(left.parent, tmp_path / "second.json").path).channels == channels
        packed = read_fmu(apply_verdict(tmp_path / "verdict", tmp_path / "wing.fmu").path)
        calibrated = {item.name: item.mean for item in found.verdict.parameters}
        for name, wanted in (
            ("effect.cubic_stiffness.active", 1.0),
            ("young_modulus_factor", calibrated["young_modulus_factor"]),
            ("damping.alpha", calibrated["damping_alpha"]),
        ):
            assert float(str(packed.variable(name).start)) == wanted
        return
    old, new = ("density = 2700", "density = 2710") if kind == "structure" else ("high = 1.3", "high = 1.4")
    file.write_text(file.read_text(encoding="utf-8").replace(old, new), encoding="utf-8")
    for call in (lambda: choose_model(applied.path), lambda: apply_verdict(tmp_path / "verdict", "x.json")):
        with pytest.raises(ModelError, match=r"has changed since .* run `uav-twin discrepancy run` again"):
            call()


def test_of_a_group_one_member_is_applied(tmp_path, monkeypatch):
    """Of a static campaign that cannot tell a compliant root from a crack: the leading one, or another.

    Both say that they are no name, and close the gap.
    """
    monkeypatch.chdir(tmp_path)
    choice = choose_model("three_mass_chain")
    effects = chosen("root_compliance", "breathing_crack")
    hidden = "root_compliance", {"compliance_share": 0.11}, ""
    campaign = simulated(choice.model, "static", 3, hidden, tmp_path / "campaign")
    verdict = verdict_of(choice, campaign, effects, tmp_path / "verdict").verdict
    assert verdict.kind is VerdictKind.GROUP, verdict.sentence
    assert set(verdict.group) == {"root_compliance", "breathing_crack"}
    leading, other = verdict.group
    for words, member in (((), leading), (("--member", other), other)):
        out = tmp_path / f"{member}.json"
        told = run("apply", tmp_path / "verdict", "--out", out, *words)
        assert (
            f"one of a group that the data cannot tell apart, and not a name (group: {leading}, {other})."
            in told
        )
        stored = read_patch(out)
        assert stored.verdict is VerdictKind.GROUP
        assert stored.sentence.startswith(told.splitlines()[0].split(": ", 1)[1])
        assert [effect.identifier for effect in stored.effects] == [member]
        (fitted,) = [item for item in verdict.hypotheses if item.identifiers == (member,)]
        assert stored.parameters == fitted.parameters
        again = investigate(
            uav_twin.read_campaign(tmp_path / "campaign"), out, effects, thorough=False
        ).verdict
        assert again.kind is VerdictKind.NOTHING_MISSING, again.sentence
    refused = run("apply", tmp_path / "verdict", "--member", "overflow", failed=True)
    assert f"which has '{leading}', '{other}'" in refused


def test_the_best_hypothesis_for_an_unexplained_gap_is_marked(tmp_path):
    """Drag with nothing but a stiffness that drifts to explain it, which takes some of the error away."""
    choice = choose_model("single_mass_rig")
    hidden = "quadratic_damping", {"equivalent_damping_ratio": 0.01}, "slide"
    campaign = simulated(choice.model, "laboratory", 4, hidden, tmp_path / "campaign")
    found = verdict_of(choice, campaign, chosen("stiffness_drift"), tmp_path / "verdict")
    assert found.verdict.kind is VerdictKind.UNEXPLAINED, found.verdict.sentence
    assert has_applicable_effects(found.verdict, found.proof)
    assert not has_applicable_effects(found.verdict, None)
    larger = replace(found.proof.closed, value=-0.3)
    assert not has_applicable_effects(found.verdict, replace(found.proof, closed=larger))
    applied = apply_verdict(tmp_path / "verdict", tmp_path / "patched.json")
    assert applied.sentence.endswith("the best hypothesis for a gap that stays unexplained: not a name.")
    stored = read_patch(applied.path)
    assert stored.verdict is VerdictKind.UNEXPLAINED
    assert [effect.identifier for effect in stored.effects] == ["stiffness_drift"]
    assert stored.sentence.startswith(applied.sentence)
    with pytest.raises(
        ModelError, match="only laws at the ports of a lumped model can be written into its own file"
    ):
        apply_verdict(tmp_path / "verdict", tmp_path / "patched.toml")


# ---------------------------------------------------------------- files


def test_files_are_not_taken_from_their_owner(laboratory, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    there = tmp_path / "there.toml"
    there.write_text("mine", encoding="utf-8")
    for words, message in (
        (("--out", "there.toml"), "there.toml exists: choose another --out or give --replace"),
        (
            ("--out", str(laboratory / "rig.toml"), "--replace"),
            "is a file from which the patched model is made",
        ),
        (("--out", "model.xml"), "must end in one of .toml, .json, .fmu"),
        (("--out", "model.fmu"), "only a wing is packed with its effects"),
        (("--member", "free_play"), "has no group: leave it out"),
    ):
        said = run("apply", laboratory / "verdict", *words, failed=True)
        assert message in said
        assert len(said.strip().splitlines()) == 1
    assert list(tmp_path.iterdir()) == [there]
    assert there.read_text(encoding="utf-8") == "mine"
    run("apply", laboratory / "verdict", "--out", "there.toml", "--replace")
    assert uav_twin.load_model("there.toml").name.endswith("with geometric (cubic) stiffness")


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
    with pytest.raises(ModelError, match="is gone: put it back there, or beside patched"):
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


def test_effects_are_applied_upon_each_other(laboratory, tmp_path):
    """What a patched model lacks goes into one file with what it had."""
    first = choose_model(apply_verdict(laboratory / "verdict", tmp_path / "first.json").path)
    assert len(first.model.patch)
    drag = "quadratic_damping", {"equivalent_damping_ratio": 0.02}, "slide"
    campaign = simulated(first.model, "ringdown", 5, drag, tmp_path / "campaign")
    found = verdict_of(first, campaign, chosen("quadratic_damping"), tmp_path / "verdict")
    assert [item.identifier for item in found.verdict.effects] == ["quadratic_damping"]
    beneath = (str(laboratory / "rig.toml"), str(tmp_path / "first.json"))
    assert choose_model(tmp_path / "verdict" / "patch.json").beneath == beneath
    for file in (*beneath, tmp_path / "verdict" / "verdict.json", tmp_path / "verdict" / "patch.json"):
        with pytest.raises(FileNotWrittenError, match="is a file from which the patched model is made"):
            apply_verdict(tmp_path / "verdict", file, replace=True)
    second = apply_verdict(tmp_path / "verdict", tmp_path / "second.toml").path
    laws = tomllib.loads(second.read_text(encoding="utf-8"))["law"]
    assert [law["name"] for law in laws] == ["cubic_stiffness", "quadratic_damping"]
    stored = read_patch(apply_verdict(tmp_path / "verdict", tmp_path / "both.json").path)
    assert stored.origin.model_file == str((laboratory / "rig.toml").resolve())
    assert stored.patch == first.model.patch + found.verdict.effects[0].patch
    assert uav_twin.load_model(tmp_path / "both.json").parameters == uav_twin.load_model(second).parameters


def test_a_built_in_sensor_is_that_of_its_channel():
    """Of two channels that measure one output, the one that the effect was found on."""
    model = uav_twin.load_model("single_mass_rig")
    noise = NoiseRecord(1e-5, 50.0)
    channels = tuple(
        Channel(name, Quantity.DISPLACEMENT, "displacement", noise) for name in ("laser", "transducer")
    )
    campaign = example_campaign(model, "static", 0, replace(usual_plan(model), channels=channels))
    patched, given = model.with_patch(ModelPatch((SensorGain("laser", 0.1),))), Conditions(np.ones(2))
    seen = observe(patched, campaign, campaign.trials[0], ModelPatch(), given).values
    np.testing.assert_allclose(seen[:, 0], 1.1 * seen[:, 1], rtol=1e-12)
    assert np.abs(seen[:, 1]).max() > 0.0


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
