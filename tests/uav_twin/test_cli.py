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
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

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
from tests.discrepancy.rigs import measured
from tests.refusals import Inputs
from tests.twin_master.runs import text_of, written
from tests.uav_twin.test_discrepancy import TWO
from twin_master.errors import MissionInputError, ScenarioError
from twin_master.mission.steps import Truth
from twin_master.network.twin import build_graphical_model
from twin_master.workflow import check_scenario
from uav_twin import _HOMES, cli, load_design, load_scenario


def leaves(command: object, *words: str) -> list[tuple[tuple[str, ...], object]]:
    """Return every command with the words that call it."""
    found = [(words, command)]
    for name, inner in getattr(command, "commands", {}).items():
        found += leaves(inner, *words, name)
    return found


def test_every_command_has_help_and_the_common_options():
    assert said("--version") == f"uav-twin {version('uav-twin')}\n"
    everything = leaves(terminal.with_common_options(cli.app))
    assert len(everything) > 25
    for words, leaf in everything:
        given = [option for parameter in leaf.params for option in parameter.opts]  # type: ignore[attr-defined]
        for option in ("--quiet", "-q", "--verbose", "-v"):
            assert given.count(option) == 1, (words, option)
        assert leaf.help, words  # type: ignore[attr-defined]


@pytest.mark.usefixtures("no_report")
def test_run_prints_figures_and_report(tmp_path, library_file):
    out = tmp_path / "run"
    words = ("run", "level_turns", "--out", out, "--strain-library", library_file)
    text = said(*words, "--seed", "3")
    assert re.search(r"policy changes from 3g to 2g +60 % +60 % \(1\)", " ".join(text.split()))
    assert all(part in text for part in ("(1) Kapteyn et al. 2021\n", f"Report: {out / 'report.html'}"))
    assert "holds a run already" in refused(*words)
    done = command(*words, "--replace", "--quiet")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    said("run", "--resume", out, "--quiet")
    (out / "report.html").unlink(missing_ok=True)
    record = json.loads(said(*words, "--replace", "--json", "--no-report"))
    assert (record["folder"], record["report"], record["scenario"]) == (str(out), None, "level_turns")
    assert {figure["key"] for figure in record["figures"]} >= {"fallback_delay", "policy_switch_damage"}
    assert not (out / "report.html").exists()
    text = said("run", "growing_damage", "--out", tmp_path / "other", "--strain-library", library_file)
    assert "rms error of the estimated stiffness loss of region 1" in " ".join(text.split())
    assert "reference" not in text  # the scenario has none, and no column for them


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
    "twin_master.workflow, twin_master.assets.design_source, calibration.paper.load_test, "
    "calibration.static.errors_in_variables, calibration.static.experiments, calibration.static.posterior"
)


@pytest.mark.parametrize(
    ("modules", "heavy"),
    [
        ("uav_twin", "numpy fe"),
        ("uav_twin.cli", "numpy scipy skfem pymor fmpy xarray matplotlib numba pydantic pint openpyxl"),
        (FLIGHT, "xarray pandas dask distributed zarr matplotlib bokeh skfem pymor meshio scipy.interpolate "
                 "scipy.optimize scipy.sparse"),
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


@pytest.mark.parametrize("name", sorted(scenario_files()))
def test_every_shipped_scenario_can_be_flown_or_says_what_it_needs(name, library_file):
    loaded, given = load_scenario(name), {}
    if name == "model_mismatch":  # it names no strain library of its own
        with pytest.raises(MissionInputError, match="--strain-library FILE"):
            check_scenario(loaded)
        given = {"strain_library": library_file}
    found, shape = check_scenario(loaded, given), SHAPES.get(name, (25, 50, 24))
    assert (found["states"], found["steps"], found["sensors"]) == shape
    assert found["name"] == name
    # at least predictions (E, S, U, G) and transitions (U, S, S)
    drawn, controls = found["draws"] * shape[0] * shape[2], len(found["controls"])
    assert found["memory"] > 8 * controls * (drawn + shape[0] ** 2)
    model = build_graphical_model(loaded.scenario)
    assert (model.states.size, *Truth(loaded.scenario, model, 0).noise.shape) == shape
    if name == "watched_wing":
        assert loaded.scenario.watch.recording == recording_files()[name]


@pytest.mark.parametrize(("old", "new", "sentence"), Inputs(__file__).table("changed.toml")["scenario"])
def test_a_fault_is_one_sentence(old, new, sentence, tmp_path):
    path = written(tmp_path, text_of("level_turns", (old, new)))
    done = command("scenario", "check", path)
    assert (done.returncode, done.stdout) == (1, "")
    assert sentence in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_checks_of_a_wing_are_listed_and_kept(monkeypatch, tmp_path):
    nan, out = float("nan"), tmp_path / "out"
    checks = [Check("patch test", "strain", 1e-15, 1e-12), Check("mesh", "order", nan)]
    monkeypatch.setattr(wing_checks, "all_checks", lambda *_, **__: checks)
    text = said("wing", "verify", "--out", out)
    assert "patch test" in text
    assert "kept" in text
    record = json.loads((out / "verification.json").read_text())
    assert [check["passed"] for check in record["checks"]] == [True, True]
    assert record["checks"][1]["value"] is None
    assert record["design_hash"] == load_design().hash
    assert "not an empty folder" in refused("wing", "verify", "--out", out)
    checks[:] = [Check("wing", "mass", 1e-3, 1e-10), Check("wing", "energy", nan, 1e-5)]
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
        "run.nc": "", "misspelt.csv": "step,strian_24\n0,1e-4\n", "lines.jsonl": "{}\n",
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


def test_every_name_is_there_under_its_own_name_and_documented():
    tree = ast.parse(Path(uav_twin.__file__).read_text(encoding="utf-8"))
    told = {}
    for_type_checkers = next(node for node in tree.body if isinstance(node, ast.If))
    for line in for_type_checkers.body:
        assert isinstance(line, ast.ImportFrom)
        (alias,) = line.names
        assert alias.asname == alias.name  # which type checkers take as handed on
        told[alias.name] = line.module
    assert told == _HOMES
    assert 15 <= len(uav_twin.__all__) <= 60
    assert set(uav_twin.__all__) == set(dir(uav_twin))  # what completion in a notebook offers
    # The import of a module of the command line would take the place of a name like it.
    assert not {path.stem for path in Path(uav_twin.__file__).parent.glob("*.py")} & {*uav_twin.__all__}
    page = (ROOT / "docs" / "reference" / "python.md").read_text(encoding="utf-8")
    for name in uav_twin.__all__:
        found = getattr(uav_twin, name)
        assert (callable(found), found.__name__) == (True, name)
        assert found.__doc__, name
        assert f"`{name}`" in page, name
        text = pydoc.plaintext.document(found)
        assert f"class {name}" in text or f"{name}(" in text
    with pytest.raises(AttributeError, match=r"no attribute 'simulate_fmu'.*load_design"):
        uav_twin.simulate_fmu  # noqa: B018


PACKAGES = ("calibration", "discrepancy", "fe", "fmu_asset", "reporting", "twin_master", "uav_twin")


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


MODULE, NAME = "import uav_twin; uav_twin.load_design()", "from uav_twin import load_design; load_design()"


@pytest.mark.parametrize(
    ("hidden", "words"),
    [
        ("fe.py", ("-c", MODULE)),
        ("scenarios/__init__.py", ("-c", NAME)),
        ("scenarios/mine.txt", ("-c", MODULE)),
        ("fe.py", ("-m", "uav_twin", "wing")),
    ],
)
def test_a_file_that_hides_a_package_is_named(hidden, words, tmp_path):
    """A folder without `__init__.py` hides ours in editable installs only; else it is left in peace."""
    (tmp_path / hidden).parent.mkdir(exist_ok=True)
    (tmp_path / hidden).write_text("", encoding="utf-8")
    line = [sys.executable, *words]
    found = subprocess.run(line, cwd=tmp_path, check=False, capture_output=True, text=True)
    if hidden == "scenarios/mine.txt" and not found.returncode:
        return
    assert found.returncode == 1
    *before, last = found.stderr.strip().splitlines()
    name, place = Path(hidden).parts[0].removesuffix(".py"), tmp_path / Path(hidden).parts[0]
    assert last.startswith("uav_twin.shadowing.ShadowedPackageError: ") or not before
    assert (found.stdout, bool(before)) == ("", "-c" in words)
    assert f"{place} hides the package `{name}` of uav-twin" in last
    assert "rename it" in last


def test_records_show_themselves_in_a_few_words(library_file):
    from calibration.wing.calibrate import WingCalibration
    from discrepancy.document import Origin
    from discrepancy.files.verdict import StoredVerdict
    from discrepancy.fmu_models.model import FmuModel
    from discrepancy.system.interface import Model
    from discrepancy.system.structures import WingModel
    from discrepancy.verdict import Verdict, VerdictKind
    from discrepancy.workflow import Investigation

    campaign, model = measured()
    verdict = Verdict(VerdictKind.NOTHING_MISSING, "Nothing.", 0.9, 0.0)
    wing = synthetic_calibration()
    knowledge = uav_twin.prepare_twin("level_turns", {"strain_library": library_file})
    shown: list[tuple[object, tuple[str, ...]]] = [
        (campaign, (campaign.name, "trials=", "channels=")),
        (model, ("LumpedModel", "parameters=")),
        (verdict, ("nothing missing", "0.9")),
        (Investigation(campaign, model, (), verdict), ("Verdict(", model.name)),
        (StoredVerdict(verdict, None, Origin("A rig", "A model", *[""] * 3, {})), ("Verdict(", "A rig")),
        (wing, (wing.asset, "samples=40")),
        (WingCalibration(wing, wing, "joint", *[None] * 4), ("Calibration(", "joint")),  # type: ignore[arg-type]
        (uav_twin.load_scenario("level_turns"), ("level_turns.toml",)),
        (knowledge, ("level_turns", "GraphicalModel(", "GaussianSensorModel(")),
        (knowledge.model, ("states=", "controls=2 (2g, 3g)")),
        (knowledge.sensor_model, ("draws=", "sensors=")),
        (knowledge.twin(), ("steps=0", "GraphicalModel(")),
        (uav_twin.load_design(), ("regions=2 (z1, z2)", "gauges=24")),
    ]
    for record, words in shown:
        text = repr(record)
        assert text.startswith(f"{type(record).__name__}(")
        assert len(text) < 400
        assert "array(" not in text
        for word in words:
            assert word in text, text
    assert FmuModel.__repr__ is WingModel.__repr__ is Model.__repr__


def test_a_policy_of_ones_own_is_flown_kept_and_resumed(tmp_path, library_file, monkeypatch):
    from twin_master.errors import InvalidModelError, MissionInputError, NotResumableError

    monkeypatch.setattr("twin_master.workflow._write_report", None)  # none is drawn where none is asked for
    flown = {"strain_library": library_file}
    known = uav_twin.prepare_twin("level_turns", flown)
    controls = known.model.controls
    gentle = np.zeros((known.model.states.size, len(controls)))
    gentle[:, 0] = 1.0
    folder = tmp_path / "run"
    with pytest.raises(InvalidModelError, match="expected a policy of shape"):
        uav_twin.fly("level_turns", folder, flown, policy=np.ones((3, 1)))
    with pytest.raises(MissionInputError, match="'sead' is not a key"):
        uav_twin.fly("level_turns", folder, {"sead": 1})
    assert not folder.exists()
    uav_twin.fly("level_turns", folder, flown, policy=gentle, report=False)
    run = uav_twin.open_run(folder)
    np.testing.assert_array_equal(np.load(folder / "policy.npy"), gentle)
    assert not run["policy"]["control_index"].values.any()
    first = int(run["observed"]["control_index"][0])
    assert run["observed"]["control_index"].values[1:].tolist() == [0] * (len(run["observed"]["step"]) - 1)
    assert first == controls.index(known.scenario.mission.first_control)
    before = (folder / "run.nc").read_bytes()
    uav_twin.resume(folder, report=False)
    assert (folder / "run.nc").read_bytes() == before
    (folder / "run.nc").unlink()  # a run that is finished is not flown again
    np.save(folder / "policy.npy", gentle[:, ::-1])
    with pytest.raises(NotResumableError, match="policy changed"):
        uav_twin.resume(folder, report=False)
