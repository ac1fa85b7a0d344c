"""Sound files of every format that users hand to the program, made by the program itself."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import meshio

from discrepancy.system.lumped_file import SHIPPED_MODELS
from fe.wing.design import SHIPPED_DESIGN, load_design
from scenarios import binding_files, scenario_files, structure_files

DOCS = Path(__file__).parents[1] / "docs"
INPUTS = Path(__file__).parents[1] / "tests" / "fe" / "structure" / "inputs"
REFERENCE = Path(__file__).parents[1].parent / "shared" / "reference"
CONFIG_HASH = "0" * 64
"""Of the configuration that the kept checkpoint belongs to."""

EFFECT = """\
[[effect]]
id = "rubber_buffer"
name = "rubber buffer"
family = "stiffness |x|^n, one- or two-sided"
equation = "F = s k |x / A|^n on one side"
signature = "stiffer upwards"
reference = "none"
acts_on = ["static", "ringdown"]
places = "ports"

[[effect.parameters]]
name = "share"
symbol = "s"
unit = "1"
description = "of the force at the largest motion"
prior = { shape = "log_normal", low = 0.01, high = 0.1 }
magnitude = true

[[effect.primitives]]
kind = "power_stiffness"
port = "place"
coefficient = "share * port_stiffness * port_displacement"
exponent = 2.0
side = 1
reference_displacement = "port_displacement"
"""


def make_files(folder: Path) -> Path:
    """Make the files that are not there yet; a second call takes no time. Returns the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    _texts(folder)
    for name, make in (
        ("structure", _structure),
        ("campaign", _campaign),
        ("verdict", _verdict),
        ("laboratory", _laboratory),
        ("run", _run),
        ("checkpoint", _checkpoint),
        ("static", _static),
        ("calibrated", _calibration),
        ("library.nc", _library),
        ("system.ssp", _ssp),
        ("reduced.npz", _reduced),
    ):
        if not (folder / name).exists():
            print(f"makes {name}", flush=True)
            make(folder)
    return folder


def _command(*arguments: object) -> None:
    subprocess.run([sys.executable, "-m", "uav_twin", *map(str, arguments), "-q"], check=True)


def _block(page: str, opening: str) -> str:
    """Return the TOML block of a page that holds a text."""
    blocks = re.findall(r"```toml\n(.*?)```", (DOCS / page).read_text("utf-8"), re.DOTALL)
    return next(block for block in blocks if opening in block)


def _texts(folder: Path) -> None:
    shutil.copy(scenario_files()["level_turns"], folder / "scenario.toml")
    shutil.copy(binding_files()["uav_wing"], folder / "binding.toml")
    shutil.copy(SHIPPED_DESIGN, folder / "design.toml")
    shutil.copy(SHIPPED_MODELS / "three_mass_chain.toml", folder / "lumped.toml")
    (folder / "fmu_model.toml").write_text(_block("fmu_models.md", 'kind = "fmu"'), "utf-8")
    (folder / "effects.toml").write_text(EFFECT, "utf-8")
    rows = "".join(f"{step}.0,{2 + step % 2}\n" for step in range(20))
    (folder / "histories.csv").write_text("time,control.load_factor\n" + rows, "utf-8")
    library = REFERENCE / "uav_digital_twin" / "UAVconfig.json"
    if library.is_file():
        shutil.copy(library, folder / "strains.json")


def _structure(folder: Path) -> None:
    place = folder / "structure"
    place.mkdir()
    for file in structure_files().values():
        for part in file.parent.glob(f"{file.stem}.*"):
            shutil.copy(part, place)
    shutil.copy(INPUTS / "pieces.bdf", place)
    meshio.read(place / "bracket.inp").write(folder / "bracket.vtu", binary=False)


def _campaign(folder: Path) -> None:
    _command("discrepancy", "example", "laboratory", folder / "campaign", "--model", "single_mass_rig")


def _verdict(folder: Path) -> None:
    rig = ("--model", "single_mass_rig")
    hidden = folder / "hidden"
    _command("discrepancy", "example", "static", hidden, *rig, "--effect", "seating_offset")
    _command("discrepancy", "run", hidden, *rig, "--out", folder / "verdict", "--no-report")


def _laboratory(folder: Path) -> None:
    _command("calibrate", "simulate", "--out", folder / "laboratory", "--sampling-rate", 1000)
    published = REFERENCE / "uav_experimental_calibration" / "step3" / "ringdown_trial1_digitised.csv"
    if published.is_file():
        shutil.copy(published, folder / "laboratory" / "digitised.csv")


def _run(folder: Path) -> None:
    text = scenario_files()["pump_wear"].read_text("utf-8")
    (folder / "short.toml").write_text(re.sub(r"(?m)^steps = \d+", "steps = 6", text), "utf-8")
    _command("run", folder / "short.toml", "--no-report", "--out", folder / "run")


def _checkpoint(folder: Path) -> None:
    """Keep the journal of the run, as that of a configuration that is known."""
    from twin_master.mission.journal import JOURNAL_NAME, JournalFile, records_backwards

    place = folder / "checkpoint"
    place.mkdir()
    steps = [record for record, *_ in records_backwards(folder / "run" / JOURNAL_NAME)][-2::-1]
    with JournalFile(place, CONFIG_HASH) as file:
        for record in steps:
            file.append(record)


def _static(folder: Path) -> None:
    _command("calibrate", "static", "--out", folder / "static")


def _calibration(folder: Path) -> None:
    _command("calibrate", "--out", folder / "calibrated", "--no-report")


def _library(folder: Path) -> None:
    fmu = folder / "pump.fmu"
    _command("fmu", "build", "--script", "gear_pump", "--out", fmu)
    grid = ("wear=0,0.3", "clogging=0,0.6", "speed=1000", "pressure=100:140:2")
    options = [part for item in grid for part in ("--grid", item)]
    sample = ("library", "sample", "--fmu", fmu, "--binding", binding_files()["gear_pump"], *options)
    _command(*sample, "--out", folder / "library.nc")


def _ssp(folder: Path) -> None:
    _command("ssp", "export", "three_fmus", "--out", folder / "system.ssp")


def _reduced(folder: Path) -> None:
    from fe.reduction.model_cache import build_patch_arrays, reduced_model

    design = load_design().changed(mesh={"refinement": 0.25})
    (folder / "patched.npz").write_bytes(build_patch_arrays(design).to_bytes())
    (folder / "reduced.npz").write_bytes(reduced_model(design).to_bytes())
