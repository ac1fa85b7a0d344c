"""The command line and the one name to import: what commands say and refuse, what `uav_twin` hands on."""

import ast
import contextlib
import inspect
import json
import os
import pydoc
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import uav_twin
from benchmarks import command_page
from fe.verification import wing_checks
from fe.verification.wing_checks import Check
from reporting import terminal
from scenarios import recording_files, scenario_files, structure_files
from tests.command_line import command, refused, said
from tests.conftest import synthetic_calibration
from tests.costs import once
from tests.discrepancy.rigs import measured
from tests.refusals import Inputs
from tests.twin_master.runs import text_of, written
from tests.uav_twin.test_discrepancy_import import TWO
from twin_master.errors import InvalidModelError, MissionInputError, NotResumableError, ScenarioError
from twin_master.mission.plant import Truth
from twin_master.network.graphical_model import build_graphical_model
from twin_master.workflow import check_scenario
from uav_twin import _HOMES, cli, load_design, load_scenario


def leaves(command: object, *words: str) -> list[tuple[tuple[str, ...], object]]:
    """Return every command with the words that call it."""
    found = [(words, command)]
    for name, inner in getattr(command, "commands", {}).items():
        found += leaves(inner, *words, name)
    return found


def test_the_version_is_that_of_the_package():
    assert said("--version") == f"uav-twin {version('uav-twin')}\n"


def test_every_command_has_help_and_the_common_options():
    commands = leaves(terminal.with_common_options(cli.app))
    assert len(commands) > 25
    for words, leaf in commands:
        options = [option for parameter in leaf.params for option in parameter.opts]  # type: ignore[attr-defined]
        for common in ("--quiet", "-q", "--verbose", "-v"):
            assert options.count(common) == 1, (words, common)
        assert leaf.help, words  # type: ignore[attr-defined]


@pytest.fixture(scope="module")
def level_turns(
    library_file: Path, no_report: None, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, tuple[object, ...], str]:
    """The folder of a run, the words of its command, and what the command printed."""
    out = tmp_path_factory.mktemp("level_turns") / "run"
    words = ("run", "level_turns", "--out", out, "--strain-library", library_file)
    return out, words, said(*words, "--seed", "3")


def test_run_prints_figures_and_report(level_turns):
    out, _, text = level_turns
    assert re.search(r"policy changes from 3g to 2g +60 % +60 % \(1\)", " ".join(text.split()))
    assert "(1) Kapteyn et al. 2021\n" in text
    assert f"Report: {out / 'report.html'}" in text


def test_a_run_is_replaced_only_on_demand(level_turns):
    _, words, _ = level_turns
    assert "holds a run already" in refused(*words)
    done = command(*words, "--replace", "--quiet")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_a_run_without_a_report_is_printed_as_data(level_turns):
    out, words, _ = level_turns
    said("run", "--resume", out, "--quiet")
    (out / "report.html").unlink(missing_ok=True)
    record = json.loads(said(*words, "--replace", "--json", "--no-report"))
    keys = {figure["key"] for figure in record["figures"]}
    assert (record["folder"], record["report"], record["scenario"]) == (str(out), None, "level_turns")
    assert keys >= {"fallback_delay", "policy_switch_damage"}
    assert not (out / "report.html").exists()


@pytest.mark.usefixtures("no_report")
def test_a_scenario_without_references_has_no_column_for_them(tmp_path, library_file):
    text = said("run", "growing_damage", "--out", tmp_path / "run", "--strain-library", library_file)
    assert "rms error of the estimated stiffness loss of region 1" in " ".join(text.split())
    assert "reference" not in text


def test_the_traceback_is_told_where_it_is_asked_for():
    sentence = refused("scenario", "check", "nowhere")
    told = command("scenario", "check", "nowhere", "-v").stderr
    assert "Traceback" in told
    assert told.strip().endswith(sentence)


def test_an_error_that_is_not_ours_is_not_hidden(monkeypatch):
    def broken() -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(terminal, "with_common_options", lambda _app: lambda **_: broken())
    monkeypatch.setattr(sys, "argv", ["uav-twin"])
    with pytest.raises(ZeroDivisionError):
        cli.main()
    assert issubclass(ScenarioError, ValueError)


def test_ctrl_c_ends_every_command_alike_and_says_how_to_go_on(monkeypatch, tmp_path, library_file):
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("twin_master.workflow._fly", interrupted)
    monkeypatch.setattr("fe.wing.design.load_design", interrupted)
    words = ("run", "level_turns", "--out", tmp_path / "run", "--strain-library", library_file, "-q")
    assert f"--resume {tmp_path / 'run'}" in refused(*words, code=130)
    assert refused("wing", code=130) == "Interrupted."


def test_the_master_script_is_the_same_command(tmp_path):
    line = [sys.executable, "-m", "twin_master", "--resume", str(tmp_path / "nothing")]
    environment = os.environ | {"COLUMNS": "200"}
    done = subprocess.run(line, capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 1
    assert "there is no run folder" in done.stderr


FLIGHT = (  # `run --no-report`
    "twin_master.workflow, twin_master.assets.design_source, calibration.static.load_test, "
    "calibration.static.errors_in_variables, calibration.static.experiments, calibration.static.posterior"
)


@pytest.mark.parametrize(
    ("modules", "heavy"),
    [
        ("uav_twin", "numpy fe"),
        ("uav_twin.cli", "numpy scipy skfem pymor fmpy xarray matplotlib numba pydantic pint openpyxl"),
        (FLIGHT, "xarray pandas dask distributed zarr matplotlib bokeh skfem pymor meshio scipy.interpolate "
                 "scipy.optimize scipy.sparse"),
        ("twin_master.watch.workflow, twin_master.fleet.engine",
         "xarray pandas dask distributed zarr matplotlib bokeh"),
    ],
)  # fmt: skip
def test_start_up_is_lazy(modules, heavy):
    """A name from Python imports no package, `--help` nothing that only a flight needs, a run no more."""
    code = f"import sys, {modules}\nprint(sorted(set('{heavy}'.split()) & set(sys.modules)))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout == "[]\n"


def test_the_page_of_commands_is_that_of_the_commands():
    """If this fails: python -m benchmarks.command_page."""
    text = command_page.PAGE.read_text(encoding="utf-8")
    assert command_page.page(text) == text
    assert command_page.page(text.replace("uav-twin scenarios\n", "")) == text


SHAPES = {
    "bracket": (81, 40, 4),
    "stiffened_panel": (64, 40, 6),
    "three_regions": (125, 50, 24),
    "pump_wear": (25, 60, 4),
    "inspected_wing": (25, 120, 24),
    "watched_wing": (25, 60, 24),
}
"""States, steps and sensors, where they are not those of the paper's mission."""


NEEDS_LIBRARY = "model_mismatch"
"""The scenario that names no strain library of its own."""


def test_a_scenario_without_a_strain_library_says_what_it_needs():
    with pytest.raises(MissionInputError, match="--strain-library FILE"):
        check_scenario(load_scenario(NEEDS_LIBRARY))


@once
def checked_scenario(name: str, library: Path) -> dict[str, Any]:
    """Return what the check of a shipped scenario finds."""
    options = {"strain_library": library} if name == NEEDS_LIBRARY else {}
    return check_scenario(load_scenario(name), options)


@pytest.mark.parametrize("name", sorted(scenario_files()))
def test_every_shipped_scenario_can_be_flown(name, library_file):
    record = checked_scenario(name, library_file)
    shape = SHAPES.get(name, (25, 50, 24))
    assert (record["states"], record["steps"], record["sensors"]) == shape
    assert record["name"] == name


@pytest.mark.parametrize("name", sorted(scenario_files()))
def test_the_memory_of_a_scenario_is_at_least_that_of_predictions_and_transitions(name, library_file):
    """Predictions are an array of draws, states, controls and sensors; transitions of controls and states."""
    record = checked_scenario(name, library_file)
    states, _, sensors = SHAPES.get(name, (25, 50, 24))
    numbers_of_a_control = record["draws"] * states * sensors + states**2
    assert record["memory"] > 8 * len(record["controls"]) * numbers_of_a_control


@pytest.mark.parametrize("name", sorted(scenario_files()))
def test_the_graphical_model_of_a_scenario_has_its_shape(name):
    scenario = load_scenario(name).scenario
    model = build_graphical_model(scenario)
    steps_and_sensors = Truth(scenario, model, 0).noise.shape
    assert (model.states.size, *steps_and_sensors) == SHAPES.get(name, (25, 50, 24))


def test_the_watched_wing_watches_the_shipped_recording():
    recording = load_scenario("watched_wing").scenario.watch.recording
    assert recording == recording_files()["watched_wing"]


@pytest.mark.parametrize(("old", "new", "sentence"), Inputs(__file__).table("changed.toml")["scenario"])
def test_a_fault_is_one_sentence(old, new, sentence, tmp_path):
    path = written(tmp_path, text_of("level_turns", (old, new)))
    done = command("scenario", "check", path)
    assert (done.returncode, done.stdout) == (1, "")
    assert sentence in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


@pytest.fixture
def sound_checks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the command find checks of a wing that are kept, as running them takes a minute."""
    checks = [Check("patch test", "strain", 1e-15, 1e-12), Check("mesh", "order", float("nan"))]
    monkeypatch.setattr(wing_checks, "all_checks", lambda *_, **__: checks)


@pytest.mark.usefixtures("sound_checks")
def test_checks_of_a_wing_are_listed():
    text = said("wing", "verify")
    assert "patch test" in text
    assert "kept" in text


@pytest.mark.usefixtures("sound_checks")
def test_checks_of_a_wing_are_written(tmp_path):
    said("wing", "verify", "--out", tmp_path / "out")
    record = json.loads((tmp_path / "out" / "verification.json").read_text())
    assert [check["passed"] for check in record["checks"]] == [True, True]
    assert record["checks"][1]["value"] is None
    assert record["design_hash"] == load_design().hash


@pytest.mark.usefixtures("sound_checks")
def test_checks_of_a_wing_are_not_written_over_others(tmp_path):
    said("wing", "verify", "--out", tmp_path / "out")
    assert "not an empty folder" in refused("wing", "verify", "--out", tmp_path / "out")


def test_broken_checks_of_a_wing_are_named(monkeypatch):
    checks = [Check("wing", "mass", 1e-3, 1e-10), Check("wing", "energy", float("nan"), 1e-5)]
    monkeypatch.setattr(wing_checks, "all_checks", lambda *_, **__: checks)
    done = command("wing", "verify")
    assert (done.returncode, done.stdout.count("BROKEN")) == (1, 2)
    assert "2 of 2 checks exceeded their limits: wing, mass; wing, energy." in done.stderr


INPUTS = Inputs(__file__)
RIG = "--model single_mass_rig"
STRUCTURAL = INPUTS.refused("structural")
ROWS = [row for name in INPUTS.table("refused.toml") if name != "structural" for row in INPUTS.refused(name)]
ROWS += [*STRUCTURAL[::7], *((f"{line} --in-process", *rest) for line, *rest in STRUCTURAL)]
TOLD = INPUTS.table("told.toml")["rows"]


@pytest.fixture(scope="module")
def folder(
    tmp_path_factory: pytest.TempPathFactory, foreign_fmu: Callable[..., Path], library_file: Path
) -> Path:
    """The files that the table names."""
    place = tmp_path_factory.mktemp("refused")
    for name in ("filled", "none", "lab/step1", "pairs/step2"):
        (place / name).mkdir(parents=True)
    library = f'[asset]\nkind = "strain_library"\nfile = "{library_file}"\n\n[belief]\nkind = "asset"\n\n'
    text = text_of("level_turns")
    flown = text[text.index("[asset]") : text.index("[calibration]")]
    for name, content in {
        "a file": "x", "filled/mine.txt": "mine", "pairs/step2/pairs.csv": "x", "broken.toml": "format = 3",
        "bad.ssp": "nothing", "bar.inp": INPUTS.text("bar.inp"), "bar.toml": INPUTS.text("bar.toml"),
        "library.toml": text.replace(flown, library), "pull.csv": TWO["pull.csv"].decode(),
        "filled/pull.csv": TWO["pull.csv"].decode(),
        "run.nc": "", "misspelt.csv": "step,strian_24\n0,1e-4\n", "lines.csv": "\n",
        "torn.toml": "mass = [", "half.toml": "name = 'half a wing'",
        "hole.csv": "F [N];Weg [mm]\n1;0,5\n;0,75\n3;0,8\n",
        "back.csv": "t [ms];Weg [mm]\n" + "".join(f"{t};1,5\n" for t in (0, 2, 4, 6, 5, 8, 10, 12, 14)),
        "room.toml": INPUTS.text("room.toml"), "cold.csv": "time,outside\n120,5\n180,-41\n",
        "my_part.toml": structure_files()["bracket"].read_text(encoding="utf-8"),
    }.items():  # fmt: skip
        (place / name).write_text(content, encoding="utf-8")
    for name, model in (("ball", "ball2"), ("sized", "resize3"), ("room", "room2")):
        shutil.copy(foreign_fmu(model), place / f"{name}.fmu")
    said("discrepancy", "example", "static", place / "campaign", *RIG.split(), "--seed", "3")
    return place


@pytest.mark.parametrize(("line", "sentence", "code"), ROWS, ids=[" ".join(row[:2]) for row in ROWS])
def test_what_is_wrong_is_one_sentence_with_its_exit_code(
    folder, heat_exchanger, monkeypatch, line, sentence, code
):
    monkeypatch.chdir(folder)
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    line = line.replace("RIG", RIG).replace("FOULING", shlex.quote(str(heat_exchanger / "fouling.toml")))
    assert sentence in refused(*shlex.split(line), code=code)
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before


@pytest.mark.parametrize(("line", "words"), TOLD, ids=[row[0] for row in TOLD])
def test_what_is_said(folder, monkeypatch, line, words):
    monkeypatch.chdir(folder)
    text = said(*shlex.split(line))
    assert [word for word in words if word not in text] == []


ROOT = Path(__file__).parents[2]


def names_for_type_checkers() -> dict[str, str | None]:
    """Return the modules of the names that the package hands on to type checkers."""
    tree = ast.parse(Path(uav_twin.__file__).read_text(encoding="utf-8"))
    block = next(node for node in tree.body if isinstance(node, ast.If))
    modules: dict[str, str | None] = {}
    for line in block.body:
        assert isinstance(line, ast.ImportFrom)
        (alias,) = line.names
        assert alias.asname == alias.name  # which type checkers take as handed on
        modules[alias.name] = line.module
    return modules


def test_type_checkers_see_the_names_of_the_package():
    assert names_for_type_checkers() == _HOMES


def test_completion_offers_the_names_of_the_package():
    assert 15 <= len(uav_twin.__all__) <= 60
    assert set(uav_twin.__all__) == set(dir(uav_twin))


def test_no_module_of_the_command_line_is_named_like_a_name_of_the_package():
    """The import of such a module would take the place of the name."""
    modules = {path.stem for path in Path(uav_twin.__file__).parent.glob("*.py")}
    assert not modules & {*uav_twin.__all__}


@pytest.mark.parametrize("name", uav_twin.__all__)
def test_every_name_of_the_package_can_be_called_under_its_own_name(name):
    function_or_class = getattr(uav_twin, name)
    assert (callable(function_or_class), function_or_class.__name__) == (True, name)


@pytest.mark.parametrize("name", uav_twin.__all__)
def test_every_name_of_the_package_is_documented(name):
    function_or_class = getattr(uav_twin, name)
    page = (ROOT / "docs" / "reference" / "python.md").read_text(encoding="utf-8")
    text = pydoc.plaintext.document(function_or_class)
    assert function_or_class.__doc__
    assert f"`{name}`" in page
    assert f"class {name}" in text or f"{name}(" in text


def test_a_name_that_the_package_does_not_have_is_refused_with_those_that_it_has():
    with pytest.raises(AttributeError, match=r"no attribute 'simulate_fmu'.*load_design"):
        uav_twin.simulate_fmu  # noqa: B018


MODULE = "import uav_twin; uav_twin.load_design()"
NAME = "from uav_twin import load_design; load_design()"


def refusal_of_hidden_package(folder: Path, hidden: str, *words: str) -> subprocess.CompletedProcess[str]:
    """Run Python with some words in a folder in which a file hides a package, or may hide it."""
    (folder / hidden).parent.mkdir(exist_ok=True)
    (folder / hidden).write_text("", encoding="utf-8")
    program = [sys.executable, *words]
    return subprocess.run(program, cwd=folder, check=False, capture_output=True, text=True)


def check_hidden_package(done: subprocess.CompletedProcess[str], path: Path, package: str) -> None:
    """Check that the last line of a process names the file that hides a package."""
    last = done.stderr.strip().splitlines()[-1]
    assert (done.returncode, done.stdout) == (1, "")
    assert f"{path} hides the package `{package}` of uav-twin" in last
    assert "rename it" in last


@pytest.mark.parametrize(
    ("hidden", "code"), [("fe.py", MODULE), ("scenarios/__init__.py", NAME), ("scenarios/mine.txt", MODULE)]
)
def test_a_file_that_hides_a_package_from_python_is_named(hidden, code, tmp_path):
    """A folder without `__init__.py` hides ours in editable installs only; else it is left in peace."""
    done = refusal_of_hidden_package(tmp_path, hidden, "-c", code)
    if hidden == "scenarios/mine.txt" and not done.returncode:
        return
    *traceback, last = done.stderr.strip().splitlines()
    first_part = Path(hidden).parts[0]
    check_hidden_package(done, tmp_path / first_part, first_part.removesuffix(".py"))
    assert last.startswith("uav_twin.shadowing.ShadowedPackageError: ")
    assert traceback


def test_a_file_that_hides_a_package_from_the_command_is_named_in_one_sentence(tmp_path):
    done = refusal_of_hidden_package(tmp_path, "fe.py", "-m", "uav_twin", "wing")
    check_hidden_package(done, tmp_path / "fe.py", "fe")
    assert len(done.stderr.strip().splitlines()) == 1


@pytest.fixture(scope="module")
def shown_records(library_file: Path) -> list[tuple[object, tuple[str, ...]]]:
    """Records of all packages, and words that a notebook shows of each."""
    from calibration.wing.calibrate import WingCalibration
    from discrepancy.document import Origin
    from discrepancy.files.verdict import StoredVerdict
    from discrepancy.verdict import Verdict, VerdictKind
    from discrepancy.workflow import Investigation
    from twin_master.assets.asset_source import AssetAndModel
    from twin_master.store.writing import RunOutcome

    campaign, model = measured()
    verdict = Verdict(VerdictKind.NOTHING_MISSING, "Nothing.", 0.9, 0.0)
    wing = synthetic_calibration()
    knowledge = uav_twin.prepare_twin("level_turns", {"strain_library": library_file})
    origin = AssetAndModel("an FMU", "a model", differ=False)
    control = "left 3g for 2g at step 31"
    flown = RunOutcome(Path("runs/mine"), None, (), {}, origin, "step", control, ("Gauge 4 is off.",))
    return [
        (campaign, (campaign.name, "trials=", "channels=")),
        (model, ("LumpedModel", "parameters=")),
        (verdict, ("nothing missing", "0.9")),
        (Investigation(campaign, model, (), verdict), ("Verdict(", model.name)),
        (StoredVerdict(verdict, None, Origin("A rig", "A model", *[""] * 3, {})), ("Verdict(", "A rig")),
        (wing, (wing.asset, "samples=40")),
        (WingCalibration(wing, *[None] * 3), ("Calibration(", wing.asset)),  # type: ignore[arg-type]
        (uav_twin.load_scenario("level_turns"), ("level_turns.toml",)),
        (knowledge, ("level_turns", "GraphicalModel(", "GaussianSensorModel(")),
        (knowledge.model, ("states=", "controls=2 (2g, 3g)")),
        (knowledge.sensor_model, ("draws=", "sensors=")),
        (knowledge.twin(), ("steps=0", "GraphicalModel(")),
        (uav_twin.load_design(), ("regions=2 (z1, z2)", "gauges=24")),
        (flown, ("folder=runs/mine", "left 3g for 2g at step 31", "notices=1")),
    ]


def test_records_show_themselves_in_a_few_words(shown_records):
    for record, _ in shown_records:
        text = repr(record)
        assert text.startswith(f"{type(record).__name__}(")
        assert len(text) < 400
        assert "array(" not in text


def test_records_show_what_tells_them_apart(shown_records):
    for record, words in shown_records:
        text = repr(record)
        assert [word for word in words if word not in text] == [], text


def test_models_of_wings_and_fmus_show_themselves_as_all_models_do():
    from discrepancy.fmu_models.model import FmuModel
    from discrepancy.system.interface import Model
    from discrepancy.system.wing_model import WingModel

    assert FmuModel.__repr__ is WingModel.__repr__ is Model.__repr__


class GentleRun:
    """A run under a policy of one's own, which always flies the first control; it has no report."""

    def __init__(self, library: Path, folder: Path) -> None:
        self.folder = folder
        self.options = {"strain_library": library}
        self.known = uav_twin.prepare_twin("level_turns", self.options)
        self.policy = np.zeros((self.known.model.states.size, len(self.known.model.controls)))
        self.policy[:, 0] = 1.0
        with without_report():
            uav_twin.fly("level_turns", folder, self.options, policy=self.policy, report=False)
        self.store = uav_twin.open_run(folder)


@contextmanager
def without_report() -> Iterator[None]:
    """Let a run fail if it draws a report, which it must not where none is asked for."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("twin_master.workflow._write_report", None)
        yield


@pytest.fixture(scope="module")
def gentle_run(library_file: Path, tmp_path_factory: pytest.TempPathFactory) -> GentleRun:
    return GentleRun(library_file, tmp_path_factory.mktemp("gentle") / "run")


def test_a_policy_of_another_shape_and_a_misspelt_key_are_refused_and_write_nothing(tmp_path, library_file):
    folder = tmp_path / "run"
    policy = np.ones((3, 1))
    with pytest.raises(InvalidModelError, match="a policy must have the shape"):
        uav_twin.fly("level_turns", folder, {"strain_library": library_file}, policy=policy)
    with pytest.raises(MissionInputError, match="'sead' is not a key"):
        uav_twin.fly("level_turns", folder, {"sead": 1})
    assert not folder.exists()


def test_a_policy_of_ones_own_is_kept(gentle_run):
    np.testing.assert_array_equal(np.load(gentle_run.folder / "policy.npy"), gentle_run.policy)
    assert not gentle_run.store["policy"]["control_index"].values.any()


def test_a_policy_of_ones_own_is_flown_after_the_first_step(gentle_run):
    first, *others = gentle_run.store["observed"]["control_index"].values.tolist()
    known = gentle_run.known
    assert first == known.model.controls.index(known.scenario.mission.first_control)
    assert others == [0] * (known.scenario.mission.steps - 1)


def test_a_finished_run_with_a_policy_of_ones_own_is_not_flown_again(gentle_run):
    store_before = (gentle_run.folder / "run.nc").read_bytes()
    with without_report():
        uav_twin.resume(gentle_run.folder, report=False)
    assert (gentle_run.folder / "run.nc").read_bytes() == store_before


def test_a_run_whose_policy_was_changed_is_not_resumed(gentle_run, tmp_path):
    folder = shutil.copytree(gentle_run.folder, tmp_path / "run")
    (folder / "run.nc").unlink()
    np.save(folder / "policy.npy", gentle_run.policy[:, ::-1])
    with without_report(), pytest.raises(NotResumableError, match="policy changed"):
        uav_twin.resume(folder, report=False)


PACKAGES = ("calibration", "discrepancy", "fe", "fmu_asset", "reporting", "twin_master", "uav_twin")


@once
def classes_of_packages() -> dict[str, bool]:
    """Return the public classes of the packages by name, and whether each is a protocol."""
    classes = {}
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                    is_protocol = any(ast.unparse(base) == "Protocol" for base in node.bases)
                    classes[node.name] = is_protocol or classes.get(node.name, False)
    return classes


def test_protocols_that_a_page_names_can_be_imported_from_uav_twin():
    protocols = {name for name, is_protocol in classes_of_packages().items() if is_protocol}
    named = {}
    for page in (ROOT / "README.md", *(ROOT / "docs").rglob("*.md")):
        if page.name == "architecture.md":  # names protocols of the packages, for who changes them
            continue
        for name in re.findall(r"`(?:uav_twin\.)?([A-Z]\w+)[`(]", page.read_text(encoding="utf-8")):
            named.setdefault(name, page)
    assert {*named} & protocols >= {"SensorModel", "Estimator", "CauseSearch"}
    missing = {name: str(page) for name, page in named.items() if name in protocols - {*uav_twin.__all__}}
    assert missing == {}


@pytest.mark.parametrize(
    "function", ["fly", "resume", "fly_fleet", "watch", "Twin", "ExactFilter", "WatchfulEstimator"]
)
def test_what_a_function_takes_can_be_imported_from_uav_twin_or_is_what_another_returns(function):
    returned = set()
    for name in uav_twin.__all__:
        text = pydoc.getdoc(getattr(uav_twin, name))
        returned |= {*re.findall(r"[A-Z]\w+", text.partition("Returns\n-------\n")[2].partition(":")[0])}
    parameters = pydoc.getdoc(getattr(uav_twin, function)).partition("Parameters\n")[2].partition("\n\n")[0]
    types = " ".join(re.findall(r"^\w[\w, ]* : (.*)$", parameters, re.MULTILINE))
    classes = {*re.findall(r"\b[A-Z]\w+", types)} & {*classes_of_packages()}
    assert classes - {*uav_twin.__all__} - returned - {"LoadedScenario", "Fleet"} == set()


def test_help_shows_types_by_their_names_and_not_the_unions_that_numpy_makes_of_them():
    """As annotations are written, `ArrayLike` and `Float`; numpy spells them out in hundreds of letters."""
    spelt_out = []
    for name in uav_twin.__all__:
        public = getattr(uav_twin, name)
        functions = {name: public}
        if inspect.isclass(public):
            for member, function in inspect.getmembers(public, inspect.isfunction):
                if member == "__init__" or not member.startswith("_"):
                    functions[f"{name}.{member}"] = function
        for title, function in functions.items():
            with contextlib.suppress(ValueError):  # of a protocol or record without a signature
                if "numpy." in str(inspect.signature(function)):
                    spelt_out.append(title)
    assert spelt_out == []
