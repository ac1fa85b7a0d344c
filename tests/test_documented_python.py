"""The Python of README and docs runs as it is printed: the blocks of a page one after the other.

Notebooks are pages like others. Each page has a namespace and a folder of its own, which holds what the page
says that the reader has by then.
"""

import ast
import contextlib
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest

from calibration.result.file import save_calibration
from tests import command_line
from tests.conftest import REFERENCE, synthetic_calibration
from tests.fmu_asset.making import has_compiler
from tests.meshes import box
from tests.refusals import Inputs

ROOT, INPUTS = Path(__file__).parents[1], Inputs(__file__)
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
BLOCK = re.compile(r"^```(?:\{code-cell\} )?(\w+)\n(.*?)^```", re.MULTILINE | re.DOTALL)


def blocks(page: Path, language: str) -> list[str]:
    """Return the fenced blocks of a page in one language."""
    found = BLOCK.findall(page.read_text(encoding="utf-8"))
    return [text for kind, text in found if kind == language]


WITH_PYTHON = {str(page.relative_to(ROOT)): page for page in PAGES if blocks(page, "python")}


def linked(place: str, target: Path) -> Callable[[Path], None]:
    """Return what puts a link to a folder, or to a file, at a place in the reader's folder."""

    def link(folder: Path) -> None:
        if not target.exists():
            pytest.skip(f"{target} is not there")
        (folder / place).parent.mkdir(parents=True, exist_ok=True)
        (folder / place).symlink_to(target)

    return link


def patch_file(folder: Path) -> None:
    """The patch that the page shows."""
    (patch,) = (
        text for text in blocks(ROOT / "docs" / "reference" / "fmu.md", "json") if "uav-twin patch" in text
    )
    (folder / "patch.json").write_text(patch, encoding="utf-8")


def command(folder: Path, *words: str) -> None:
    with contextlib.chdir(folder):
        command_line.said(*words)


def converted_wing(folder: Path) -> None:
    """The first three seconds of three ring-downs: the search in all of them takes longer still."""
    published = REFERENCE / "uav_experimental_calibration" / "step3"
    if not published.is_dir():
        pytest.skip(f"the authors' published data are not at {published}")
    short = folder / "UAV-Experimental-Calibration" / "step3"
    short.mkdir(parents=True)
    for trial in (1, 2, 3):
        name = f"ringdown_trial{trial}_digitised.csv"
        lines = (published / name).read_text(encoding="utf-8").splitlines(keepends=True)
        (short / name).write_text("".join(lines[:371]), encoding="utf-8")
    command(folder, "discrepancy", "convert", "real_wing", "--data", "UAV-Experimental-Calibration")


def bracket(folder: Path) -> None:
    """Write the structure of the page, and a mesh with its sets."""
    text, *_ = blocks(ROOT / "docs" / "how_to" / "structures.md", "toml")  # the others are of scenarios
    (folder / "bracket.toml").write_text(text, encoding="utf-8")
    points, cells = box("hexahedron", (12, 2, 2))
    length, _, height = points.T
    millimetres = points * [120, 20, 20] - [0, 10, 0]
    cell_sets = {"BODY": [np.arange(48)], "LUG": [np.arange(8)]}
    mesh = meshio.Mesh(millimetres, [("hexahedron", cells)], cell_sets=cell_sets)
    mesh.point_sets = {"ROOT": np.flatnonzero(length == 0.0), "TOP": np.flatnonzero(height == 1.0)}
    mesh.write(folder / "bracket.inp")


def flown(name: str, steps: int, place: str) -> Callable[[Path], None]:
    """Return what makes a run folder of the first steps of a mission, without its report."""

    def fly(folder: Path) -> None:
        scenario = (ROOT / "scenarios" / f"{name}.toml").read_text(encoding="utf-8")
        text = re.sub(r"(?m)^steps = \d+", f"steps = {steps}", scenario)
        (folder / "short.toml").write_text(text, encoding="utf-8")
        command(folder, "run", "short.toml", "--no-report", "--out", place)

    return fly


def flown_fleet(folder: Path) -> None:
    """Fly the fleet of the page on fleets with four twins."""
    text, *_ = blocks(ROOT / "docs" / "how_to" / "fleets.md", "toml")
    (folder / "fleet.toml").write_text(text.replace("count = 40", "count = 4"), encoding="utf-8")
    command(folder, "fleet", "run", "fleet.toml", "--out", "runs/winter", "--workers", "0", "--no-report")


def calibrated_wing(folder: Path) -> None:
    save_calibration(synthetic_calibration(), folder / "calibrations/wing_7/calibration.nc")


WING_FMU = "fmu build --out wing.fmu"
VERDICT = (
    "discrepancy example static campaign --model single_mass_rig --effect load_cell",
    "discrepancy run campaign --model single_mass_rig --out verdict",
)
"""A verdict on a mass on a spring, its load cell with a tare."""

READER_HAS: dict[str, tuple[Callable[[Path], None] | str, ...]] = {
    "docs/how_to/another_asset.md": ("library sample pump_wear --out pump.nc",),
    "docs/how_to/calibrate_a_wing.md": (calibrated_wing,),
    "docs/explanation/calibration.md": (
        linked("UAV-Experimental-Calibration", REFERENCE / "uav_experimental_calibration"),
    ),
    "docs/reference/campaign.md": ("discrepancy example static my_campaign --seed 1",),
    "docs/tutorials/cart_in_ten_minutes.md": (lambda folder: (folder / "my_cart").mkdir(),),
    # Each step has damage of its own in the search for an effect.
    "docs/explanation/discrepancy_missions.md": (flown("growing_damage", 12, "runs/mission"),),
    "docs/how_to/fmu_models.md": (WING_FMU, linked("rig.toml", INPUTS.folder / "rig.toml")),
    "docs/reference/fmu.md": (
        linked("scenarios", ROOT / "scenarios"),
        patch_file,
        "fmu build --patch patch.json --out wing_with_effects.fmu",
    ),
    "docs/explanation/inference.md": (linked("path/to/UAV-Digital-Twin", REFERENCE / "uav_digital_twin"),),
    "docs/explanation/locating.md": (
        "discrepancy example laboratory demo --model three_mass_chain --effect coulomb_friction@joint=0.004",
    ),
    # The page packs the FMU itself.
    "docs/reference/python.md": (
        "fmu build --out drafted.fmu",
        "fmu bind drafted.fmu --out wing.toml",
        *VERDICT,
    ),
    "docs/explanation/real_wing.md": (converted_wing,),
    # With the step up to which the page reports, and one more.
    "docs/reference/report.md": (flown("level_turns", 22, "runs/level_turns"),),
    "docs/reference/run_folder.md": (flown("level_turns", 22, "runs/level_turns"),),
    "docs/reference/stores.md": (flown("level_turns", 22, "runs/level_turns"), flown_fleet),
    "docs/how_to/ssp.md": ("ssp export three_fmus --out three_fmus.ssp",),
    "docs/how_to/structures.md": (bracket,),
    "docs/how_to/use_the_wing_in.md": (WING_FMU, "fmu build --kind compiled --fmi 3 --out wing3.fmu"),
    "docs/reference/verdict.md": VERDICT,
}
"""What is in the reader's folder before the first block: commands that were run, and what makes more."""

TABLES = INPUTS.table("pages.toml")


@pytest.mark.parametrize("name", TABLES["minutes"])
def test_what_a_page_of_minutes_imports_is_there(name):
    for block in blocks(WITH_PYTHON[name], "python"):
        if not block.startswith("%%"):
            found = [node for node in ast.parse(block).body if isinstance(node, ast.Import | ast.ImportFrom)]
            exec(compile(ast.Module(found, []), name, "exec"), {})


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(page, marks=pytest.mark.long if page in TABLES["minutes"] else ())
        for page in sorted(WITH_PYTHON)
    ],
)
def test_the_blocks_of_a_page_run_as_printed(name, tmp_path, monkeypatch):
    for step in READER_HAS.get(name, ()):
        if isinstance(step, str):
            if "--kind compiled" in step and not has_compiler():
                pytest.skip("there is no C compiler, which the page's compiled FMU is built with")
            command(tmp_path, *step.split())
        else:
            step(tmp_path)
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {"__name__": "__main__"}
    for number, block in enumerate(blocks(WITH_PYTHON[name], "python"), 1):
        first, _, rest = block.partition("\n")
        if first.startswith("%%writefile "):
            Path(first.split()[1]).write_text(rest, encoding="utf-8")
            continue
        module = TABLES["modules"].get(name)
        if module and module in block:
            pytest.importorskip(module)
        exec(compile(block, f"{name}, block {number}", "exec"), names)
