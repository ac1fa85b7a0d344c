"""`uav-twin calibrate` as a whole, and what comes after it: files, FMUs and flights of two wings."""

from __future__ import annotations

import contextlib
import errno
import io
import json
import os
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from fmpy import read_model_description
from fmpy.validation import validate_fmu

from calibration.geometry import published_lengths
from calibration.joint.wing_table import weighed
from calibration.result.file import load_calibration
from calibration.result.record import STATE, Calibration
from calibration.virtual_wing import VirtualWing, measure_load_test, measure_ring_down
from calibration.wing.lab_data import write_lab_folder
from fe.reduction.model_cache import reduced_model
from fe.runtime.reduced import ReducedModel
from fe.runtime.state import DigitalState
from fe.wing.design import SHIPPED_DESIGN, load_design
from fe.wing.operators import assemble
from fmu_asset.door.session import FmiAsset
from scenarios import scenario_files
from tests.command_line import call, command, refused, said
from tests.wings import tip_stiffness
from twin_master.errors import NotResumableError
from twin_master.workflow import resume as resume_run

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("wing")]

TRUTHS = {
    "soft": DigitalState(
        young_modulus_factor=0.97, servo_mass=0.160, pitot_mass=0.150, damping_alpha=0.8, damping_beta=6.0e-4
    ),
    "stiff": DigitalState(
        young_modulus_factor=1.04, servo_mass=0.180, pitot_mass=0.110, damping_alpha=1.4, damping_beta=9.0e-4
    ),
}


@pytest.fixture(scope="module")
def wing() -> ReducedModel:
    """The shipped wing, from the cache if an earlier test or run built it."""
    return reduced_model()


@dataclass(frozen=True)
class Tailored:
    """One virtual wing: its name, its truth and its laboratory folder; it is calibrated when asked for."""

    name: str
    truth: DigitalState
    lab: Path

    @cached_property
    def calibrated(self) -> tuple[Path, Calibration, str]:
        """Where its calibration was left, what it found, and what it said; the soft one has a report."""
        out = self.lab.with_name("out")
        with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(io.StringIO()) as said:
            report = ["--no-report"] if self.name == "stiff" else []
            places = ["--data", self.lab, "--out", out]
            code = call(patch, "calibrate", *places, "--asset", self.name, "--fitted", *report)
        assert code == 0
        return out, load_calibration(out / "calibration.nc"), said.getvalue()

    @property
    def out(self) -> Path:
        return self.calibrated[0]

    @property
    def result(self) -> Calibration:
        return self.calibrated[1]


@pytest.fixture(scope="module")
def wings(wing: ReducedModel, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Tailored]:
    """Two wings of the published planform, measured with errors."""
    made = {}
    for number, (name, truth) in enumerate(TRUTHS.items()):
        folder = tmp_path_factory.mktemp(name)
        bench = VirtualWing(wing, truth)
        write_lab_folder(
            folder / "lab",
            lengths=published_lengths(),
            load_test=measure_load_test(bench, number),
            records=measure_ring_down(bench, number, trials=3, noise=2e-5),
            total_mass=weighed(2.0 * truth.servo_mass + truth.pitot_mass, 1e-3),
        )
        made[name] = Tailored(name, truth, folder / "lab")
    return made


@pytest.mark.parametrize("name", ["soft", pytest.param("stiff", marks=pytest.mark.long)])
def test_the_truth_lies_in_the_posterior(wings: dict[str, Tailored], wing: ReducedModel, name: str) -> None:
    made = wings[name]
    assert made.result.asset == name
    assert made.result.design_hash == wing.design_hash  # published lengths: nothing was built anew
    for entry in STATE:
        off = made.result.mean(entry) - getattr(made.truth, entry)
        assert abs(off) < 4.0 * made.result.standard_deviation(entry), (name, entry)
    mass = 2.0 * made.result.samples[:, 1] + made.result.samples[:, 2]
    weighed = 2.0 * made.truth.servo_mass + made.truth.pitot_mass
    np.testing.assert_allclose(mass, weighed, atol=6e-3)


@pytest.mark.long
def test_wings_are_told_apart(wings: dict[str, Tailored]) -> None:
    soft, stiff = wings["soft"].result, wings["stiff"].result
    assert stiff.mean("young_modulus_factor") - soft.mean("young_modulus_factor") > 0.03
    assert stiff.mean("tip_stiffness") > soft.mean("tip_stiffness")
    assert stiff.mean("damping_ratio_2") > soft.mean("damping_ratio_2")


def test_the_published_figures_give_table_1(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    rows = {line.split("  ")[0].strip(): line for line in said("calibrate").splitlines() if "±" in line}
    table = {name: re.findall(r"[−+]?[\d.]+", line.replace(name, "", 1)) for name, line in rows.items()}
    assert table["modulus factor e"][4:8] == ["1.0073", "0.0103", "1.0073", "0.0103"]  # procedure and paper
    for name, near in (
        ("servo mass, g", 1.0),
        ("pitot mass, g", 2.0),
        ("alpha, 1/s", 0.01),
        ("beta, ms", 0.01),
    ):
        assert float(table[name][4]) == pytest.approx(float(table[name][6]), abs=near)
    for name, length in (
        ("semi-span, mm", "1828.00"),
        ("root chord, mm", "433.00"),
        ("tip chord, mm", "260.00"),
    ):
        assert table[name][6] == length


def test_what_a_calibration_leaves_and_says(wings: dict[str, Tailored]) -> None:
    made = wings["soft"]
    names = {path.relative_to(made.out).as_posix() for path in made.out.rglob("*") if path.is_file()}
    figures = (
        "load_test", "modes", "posterior", "prior_and_posterior", "procedure", "readings", "ring_down",
    )  # fmt: skip
    assert names == {
        "calibration.nc", "report.html", "table_1.csv", "wing.vtu", "modes.vtu",
        *(f"figures/{name}.{kind}" for name in figures for kind in ("svg", "png")),
    }  # fmt: skip
    page = (made.out / "report.html").read_text(encoding="utf-8")
    assert "Calibration of soft" in page
    assert "This calibration beside Table 1 of the paper" in page
    assert not re.search(r"https?://", page.replace("http://www.w3.org", ""))  # nothing is fetched
    assert str(made.out) not in page
    for word in (
        "Step 1: step1/geometry_data.csv read",
        "8 pairs",
        "initialconditiondata_1.DAT to",
        "Report:",
    ):
        assert word in made.calibrated[2]
    result = made.result
    assert [reading.experiment for reading in result.readings] == [
        *["planform"] * 3, "load test", "weighing", *["ring-down"] * 4,
    ]  # fmt: skip
    for experiment in ("load test", "ring-down"):
        assert result.error(experiment, prior=True) < result.error(experiment) <= 0.0
    assert -0.5 < result.error("weighing") <= 0.0
    assert all(0.0 < result.kept_share(prior.name) < 1.0 for prior in result.priors)
    assert result.information is not None
    assert result.information > 5.0
    assert result.mean("semi_span") == pytest.approx(1.828005, abs=1e-6)


@pytest.mark.long
def test_a_calibration_repeats_to_the_byte_and_another_wing_is_not_overwritten(
    wings: dict[str, Tailored], tmp_path: Path
) -> None:
    made, out = wings["soft"], tmp_path / "out"
    shutil.copytree(made.out, out)
    before = (out / "calibration.nc").read_bytes()
    assert "is the calibration of soft, not of other: choose another --out" in refused(
        "calibrate", "--out", out, "--asset", "other"
    )
    assert (out / "calibration.nc").read_bytes() == before
    old = (out / "calibration.nc").stat().st_ino
    arguments = ["calibrate", "--data", made.lab, "--asset", "soft", "--fitted", "--no-report"]
    said(*arguments, "--out", out)
    assert {path.name for path in out.iterdir()} == {"calibration.nc", "table_1.csv"}
    assert (out / "calibration.nc").stat().st_ino != old  # it was written anew
    assert (out / "calibration.nc").read_bytes() == before
    assert (out / "table_1.csv").read_bytes() == (made.out / "table_1.csv").read_bytes()


@pytest.mark.long
def test_a_report_of_a_calibration_repeats_to_the_byte(wings: dict[str, Tailored], tmp_path: Path) -> None:
    made = wings["soft"]
    arguments = ["calibrate", "--data", made.lab, "--asset", "soft", "--fitted"]
    said(*arguments, "--out", tmp_path)
    for name in ("calibration.nc", "report.html", "table_1.csv", "figures/posterior.svg"):
        assert (tmp_path / name).read_bytes() == (made.out / name).read_bytes(), name


@pytest.mark.long
def test_two_wings_are_two_fmus(wings: dict[str, Tailored], tmp_path: Path) -> None:
    strain, tip, guid = {}, {}, {}
    for name, made in wings.items():
        fmus = [tmp_path / f"{name}{copy}.fmu" for copy in (1, 2)]
        for fmu in fmus:
            arguments = ["fmu", "build", "--calibration", made.out / "calibration.nc", "--out", fmu]
            said(*arguments)
        assert fmus[0].read_bytes() == fmus[1].read_bytes()
        assert validate_fmu(str(fmus[0])) == []
        if name == "soft":
            said("fmu", "check", fmus[0], "--cycles", "5")
        described = read_model_description(str(fmus[0]))
        guid[name] = described.guid
        assert f"Calibrated for the wing '{name}'" in described.description
        start = {variable.name: variable.start for variable in described.modelVariables}
        for variable, entry in (
            ("young_modulus_factor", "young_modulus_factor"),
            ("mass.servo", "servo_mass"),
            ("mass.pitot", "pitot_mass"),
            ("damping.alpha", "damping_alpha"),
            ("damping.beta", "damping_beta"),
        ):
            assert float(start[variable]) == made.result.mean(entry)
        shutil.unpack_archive(fmus[0], tmp_path / name, "zip")
        record = json.loads((tmp_path / name / "resources" / "calibration.json").read_text(encoding="utf-8"))
        assert record["asset"] == name
        assert record["state"]["servo_mass"]["standard_deviation"] == pytest.approx(
            made.result.standard_deviation("servo_mass")
        )
        with FmiAsset(fmus[0], "scenarios/bindings/uav_wing.toml", isolated=False) as asset:
            seen = asset.step({"load_factor": 3.0}, {"z1": 0.0, "z2": 0.0})
        strain[name], tip[name] = seen.values, seen.extra["tip_displacement"]
    assert guid["soft"] != guid["stiff"]
    ratio = strain["soft"] / strain["stiff"]
    assert np.all(ratio > 1.0)
    assert tip["soft"] > tip["stiff"]
    calibrated = wings["stiff"].result.mean("young_modulus_factor")
    assert 1.0 < np.median(ratio) < calibrated / wings["soft"].result.mean("young_modulus_factor") * 1.01


@pytest.fixture
def no_report(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("twin_master.workflow._report", lambda folder: (folder / "report.html").touch())


def short_scenario(file: Path, *, parameters: bool = True) -> Path:
    """The paper's mission of a few turns, with the parameters of its wing or none."""
    text = re.sub(
        r"(?m)^steps = .*$", "steps = 3", scenario_files()["level_turns"].read_text(encoding="utf-8")
    )
    file.write_text(text if parameters else re.sub(r"(?m)^parameters = .*$", "", text), encoding="utf-8")
    return file


@pytest.mark.long
@pytest.mark.usefixtures("no_report")
def test_two_wings_are_two_flights(wings: dict[str, Tailored], tmp_path: Path) -> None:
    """Without a truth of its own in the scenario, each wing is flown as it was calibrated."""
    scenario = short_scenario(tmp_path / "mine.toml", parameters=False)
    predicted, true = {}, {}
    for name, made in wings.items():
        out = tmp_path / name
        file = made.out / "calibration.nc"
        said("run", scenario, "--calibration", file, "--out", out, "-q")
        assert (out / "asset" / "calibration.nc").read_bytes() == file.read_bytes()
        config = json.loads((out / "config.json").read_text(encoding="utf-8"))
        assert config["inputs"]["design"] == made.result.design_hash
        assert "calibration" in config["inputs"]
        assert str(tmp_path) not in json.dumps(config)
        with xr.open_datatree(out / "run.nc", engine="h5netcdf") as tree:
            tree.load()
        draws = tree["calibration"]["draw_value"].values
        assert set(draws.tolist()) <= set(made.result.draws_of("young_modulus_factor").tolist())
        predicted[name] = tree["predicted"]["quantity_mean"].values[0, 0]
        width = tree["filtered"]["quantity_upper"].values[0] - tree["filtered"]["quantity_lower"].values[0]
        assert np.all(width > 0.0)  # the samples' uncertainty is in the bands
        true[name] = tree["truth"]["strain"].values[0]
        figures = json.loads((out / "summary.json").read_text(encoding="utf-8"))["figures"]
        shown = {figure["key"]: figure["value"] for figure in figures}
        assert shown["young_modulus_factor_mean"] == pytest.approx(made.result.mean("young_modulus_factor"))
    assert np.all(predicted["soft"] > predicted["stiff"])
    assert np.all(true["soft"] > true["stiff"])


@pytest.mark.long
@pytest.mark.usefixtures("no_report")
def test_the_truth_of_the_scenario_stays_and_is_told(
    wings: dict[str, Tailored],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    true = {}
    scenario = short_scenario(tmp_path / "mine.toml")
    for name, made in wings.items():
        file, out = made.out / "calibration.nc", tmp_path / name
        assert call(monkeypatch, "run", scenario, "--calibration", file, "--out", out) == 0
        error = capsys.readouterr().err.replace("\n", " ")
        off = abs(1.0073 - made.result.mean("young_modulus_factor"))
        far = off > 3.0 * made.result.standard_deviation("young_modulus_factor")
        assert ("true Young modulus factor of the asset flown is 1.0073" in " ".join(error.split())) == far
        assert far or name == "stiff"  # at least the soft wing is another one
        with xr.open_datatree(out / "run.nc", engine="h5netcdf") as tree:
            true[name] = tree["truth"]["strain"].values[0].copy()
    np.testing.assert_array_equal(true["soft"], true["stiff"])


@pytest.mark.long
@pytest.mark.usefixtures("no_report")
def test_a_run_with_a_calibration_needs_nothing_but_its_folder(
    wings: dict[str, Tailored],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    die_after_turn: Callable[..., None],
) -> None:
    file = tmp_path / "elsewhere" / "wing.nc"
    file.parent.mkdir()
    shutil.copy(wings["soft"].out / "calibration.nc", file)
    scenario = short_scenario(tmp_path / "mine.toml")
    said("run", scenario, "--calibration", file, "--out", tmp_path / "whole", "-q")
    with monkeypatch.context() as patch:
        die_after_turn(patch, 2)
        arguments = ["run", scenario, "--calibration", file, "--out", tmp_path / "part", "-q"]
        assert call(patch, *arguments) == 130
    shutil.rmtree(file.parent)
    moved = (tmp_path / "part").rename(tmp_path / "moved")
    said("run", "--resume", moved, "-q")
    for name in ("run.nc", "config.json", "summary.json", "calibration.json", "asset/asset.fmu", "wing.vtu"):
        assert (moved / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), name
    (moved / "run.nc").unlink()  # of a finished run nothing is computed again
    copy = moved / "asset" / "calibration.nc"
    copy.write_bytes((wings["stiff"].out / "calibration.nc").read_bytes())
    with pytest.raises(NotResumableError, match=r"calibration.* changed since the run"):
        resume_run(moved)


# ---------------------------------------------------------------------------- parts of a folder


def test_missing_steps_are_told_and_a_full_disk_leaves_nothing(
    wings: dict[str, Tailored], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The published frequencies ask the softer wing for masses beyond the model.
    lab = tmp_path / "lab"
    shutil.copytree(wings["stiff"].lab / "step2", lab / "step2")
    replace, count = Path.replace, 0

    def full(self: Path, target: Path) -> Path:
        nonlocal count
        count += 1
        if count > 1:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", full)
    arguments = ["--data", lab, "--procedure", "paper", "--out", tmp_path / "out", "--no-report"]
    done = command("calibrate", *arguments)
    lines = done.stdout.splitlines()
    assert lines[0] == "Step 1: not measured; published lengths (Kapteyn et al. 2021, Table 1)."
    assert lines[1] == "Step 2: step2/load_displacement_measurements.csv read, 8 pairs."
    assert lines[2].startswith("Step 3: published frequencies and damping ratios")
    assert "modulus factor e" in done.stdout
    assert done.returncode == 1
    assert "No space is left on the disk" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["lab"]


@pytest.mark.long
def test_records_may_be_left_aside(wings: dict[str, Tailored]) -> None:
    out = said("calibrate", "--data", wings["stiff"].lab, "--published", "--procedure", "paper")
    assert "Nothing was written" in out.splitlines()[-1]
    assert "Step 3: records left aside as asked; published" in out
    assert re.search(r"frequency_1 +Hz +5\.649 ±", out)


def measured_planform(folder: Path, semi_span: float) -> Path:
    """A laboratory folder with nothing but lengths, semi-span in mm."""
    file = folder / "lab" / "step1" / "geometry_data.csv"
    file.parent.mkdir(parents=True)
    rows = f"length,1828.8,{semi_span}\nchord_{{root}},435.61,433\nchord_{{tip}},261.112,260\n"
    file.write_text("parameter,designed,manufactured\n" + rows, encoding="utf-8")
    return folder / "lab"


@pytest.mark.long
def test_the_model_follows_the_measured_planform(tmp_path: Path) -> None:
    """The tailored wing is shorter and stiffer than the one on the drawing (a coarse mesh, for speed)."""
    text = SHIPPED_DESIGN.read_text(encoding="utf-8")
    coarse = tmp_path / "coarse.toml"
    coarse.write_text(re.sub(r"(?m)^refinement = .*$", "refinement = 0.25", text), encoding="utf-8")
    out = tmp_path / "out"
    lab = measured_planform(tmp_path, 1818.0)
    arguments = ["--data", lab, "--design", coarse, "--out", out, "--asset", "short wing", "--no-report"]
    said("calibrate", *arguments)
    result = load_calibration(out / "calibration.nc")
    assert result.design.planform.semi_span == 1.8181  # prior and measurement together, to 0.1 mm
    assert result.mean_state().geometry.semi_span == 1.8181
    model = reduced_model(result.design)
    assert model.design_hash == result.design_hash
    assert result.prior_moments("tip_stiffness")[0] == pytest.approx(model.tip_stiffness(1.0), rel=1e-3)
    # against the full model of the wing as drawn, by the beam's k ~ 1 / L^3
    expected = (1.828 / 1.8181) ** 3 * tip_stiffness(assemble(load_design(coarse)))
    assert model.tip_stiffness(1.0) == pytest.approx(expected, rel=5e-3)


def test_a_design_that_the_measured_planform_spoils_is_refused(tmp_path: Path) -> None:
    text = SHIPPED_DESIGN.read_text(encoding="utf-8")
    design = tmp_path / "design.toml"
    last = text.rindex("span_end = ")
    changed = text[:last] + re.sub(r"^span_end = .*", "span_end = 1.825", text[last:])
    design.write_text(changed, encoding="utf-8")
    lab = measured_planform(tmp_path, 1815.0)
    arguments = ["--data", lab, "--design", design, "--out", tmp_path / "out"]
    error = refused("calibrate", *arguments)
    assert "defects[1] ends 1.825 m from the root, off the wing of 1.8151 m" in error
    assert not (tmp_path / "out").exists()


# ---------------------------------------------------------------------------- what is refused


def spoil(kind: str, lab: Path) -> None:
    """Make a laboratory folder wrong in one way."""
    lengths = lab / "step1" / "geometry_data.csv"
    pairs = lab / "step2" / "load_displacement_measurements.csv"
    record = lab / "step3" / "initialconditiondata_1.DAT"
    table = np.loadtxt(record)
    time, signal = table[:, 0], table[:, 1]

    def edit(file: Path, change: Callable[[str], str]) -> None:
        text = file.read_text(encoding="utf-8")
        assert change(text) != text
        file.write_text(change(text), encoding="utf-8")

    def rewrite(values: np.ndarray) -> None:  # type: ignore[type-arg]
        np.savetxt(record, np.column_stack([time, values, 0.0 * time]), fmt="%.9e")

    if kind == "renamed column":
        edit(pairs, lambda text: text.replace("load,", "force,"))
    elif kind == "missing column of lengths":
        edit(lengths, lambda text: text.replace("manufactured", "built"))
    elif kind == "load in kgf":
        rows = [line.split(",") for line in pairs.read_text(encoding="utf-8").splitlines()[1:]]
        text = "\n".join(f"{float(load) / 9.80665},{displacement}" for load, displacement in rows)
        pairs.write_text(f"load,displacement\n{text}\n", encoding="utf-8")
    elif kind == "lengths in m":
        edit(lengths, lambda text: text.replace("1828.8,1828", "1.8288,1.828"))
    elif kind == "lost value":
        edit(pairs, lambda text: text.replace(text.splitlines()[3], "nan,7.3"))
    elif kind == "empty pairs":
        pairs.write_text("", encoding="utf-8")
    elif kind == "empty record":
        record.write_text("", encoding="utf-8")
    elif kind == "record that does not decay":
        rewrite(0.01 * np.cos(2 * np.pi * 5.65 * time) + 0.003 * np.cos(2 * np.pi * 29.9 * time))
    elif kind == "clipped record":
        rewrite(np.clip(signal, -0.3 * np.abs(signal).max(), 0.3 * np.abs(signal).max()))
    elif kind == "one mode":
        rewrite(0.01 * np.exp(-0.9 * time) * np.cos(2 * np.pi * 5.65 * time))
    elif kind == "record with a gap":
        signal[200] = np.nan
        rewrite(signal)
    elif kind == "masses that cannot be":
        (lab / "step3" / "weighed_mass.csv").write_text("mass,standard_deviation\n950,1\n", encoding="utf-8")
    elif kind == "no step":
        for step in (1, 2, 3):
            shutil.rmtree(lab / f"step{step}")
    elif kind == "renamed file":
        pairs.rename(pairs.with_name("pairs.csv"))
    elif kind == "a file":
        shutil.rmtree(lab)
        lab.write_text("load,displacement\n", encoding="utf-8")


SENTENCES = {
    "renamed column": "no column 'load', which a load test needs",
    "missing column of lengths": "no column 'manufactured', which the measured planform needs",
    "load in kgf": "looks like kgf: give it in N",
    "lengths in m": "looks like m: give it in mm",
    "lost value": "line 4: column 'load' holds nan, and a finite number is needed",
    "empty pairs": "is empty",
    "empty record": "is empty",
    "record that does not decay": "decay",
    "clipped record": "clipped",
    "one mode": "two spectral peaks are needed",
    "record with a gap": "line 201: column 'spanwise' holds nan, and a finite number is needed",
    "masses that cannot be": "cannot weigh 0.95 kg",
    "no step": "holds none of the folders step1, step2 and step3",
    "renamed file": "does not hold step2/load_displacement_measurements.csv",
    "a file": "is no folder",
}


@pytest.mark.parametrize(
    "kind",
    [  # masses are looked for after all else was read; test_procedure.py has their refusal, too
        pytest.param(kind, marks=pytest.mark.long if kind == "masses that cannot be" else ())
        for kind in sorted(SENTENCES)
    ],
)
def test_a_wrong_folder_is_one_sentence_and_leaves_nothing(
    kind: str, wings: dict[str, Tailored], tmp_path: Path
) -> None:
    lab, out = tmp_path / "lab", tmp_path / "out"
    shutil.copytree(wings["soft"].lab, lab)
    spoil(kind, lab)
    error = refused("calibrate", "--data", lab, "--out", out)
    last = [line for line in error.splitlines() if line.strip()][-1]
    assert SENTENCES[kind] in last
    assert "Traceback" not in error
    assert not out.exists()


def test_other_refusals(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "lab" / "step1").mkdir(parents=True)
    (tmp_path / "a file").write_text("x", encoding="utf-8")
    for arguments, word, code in (
        (["--data", tmp_path / "nowhere"], "is not there; give the folder", 1),
        (["--data", tmp_path / "lab"], "does not hold step1/geometry_data.csv", 1),
        (["--out", tmp_path / "a file"], "exists and is no folder", 1),
        (["--asset", "a\nb"], "printable characters", 1),
        (["--measured"], "--measured needs --data", 2),
        (["--fitted"], "--fitted needs --data", 2),
        (["--procedure", "other"], "other", 2),
        (["--seed", "1", "simulate"], "options go behind the command", 2),
        (["--seed", "0", "simulate"], "options go behind the command", 2),
        (["--data", tmp_path, "ringdown"], "options go behind the command", 2),
    ):
        assert call(monkeypatch, "calibrate", *arguments) == code, arguments
        error = capsys.readouterr().err
        assert word in " ".join(error.replace("│", " ").split()), error
        assert "Traceback" not in error
    assert call(monkeypatch, "fmu", "build", "--calibration", "x.nc", "--design", "y.toml") == 2
    assert (
        call(monkeypatch, "fmu", "build", "--calibration", tmp_path / "x.nc", "--out", tmp_path / "x.fmu")
        == 1
    )
    assert "cannot be read as NetCDF" in refused(
        "run", "level_turns", "--calibration", tmp_path / "a file", "--out", tmp_path / "r"
    )
    assert not (tmp_path / "x.fmu").exists()
    assert not (tmp_path / "r").exists()
