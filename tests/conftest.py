"""What several packages' tests share."""

from __future__ import annotations

import os

# Two workers on two cores: threads of BLAS that wait for each other cost more than they bring, and sums of
# one thread repeat. Before NumPy is imported.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import gc
import json
import shutil
import sys
from collections import Counter, defaultdict
from collections.abc import Callable, Generator, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from _pytest.assertion import rewrite
from hypothesis import settings
from threadpoolctl import threadpool_limits

from tests import costs
from tests.kept import FE, ROOT, exported, kept, remove_old
from tests.refusals import Inputs

if TYPE_CHECKING:
    from calibration.result.record import Calibration
    from fe.reduction.reduced_basis import Reduction
    from fe.runtime.patch_arrays import PatchArrays
    from fe.runtime.reduced import ReducedModel
    from fe.structure.operators import Structure
    from fe.wing.design import WingDesign
    from fe.wing.operators import AffineOperators

# No search for garbage while modules are imported and tests collected, which would take a fifth of that time.
gc.disable()

LEVELS = (0, 20, 40, 60, 80)

# The same examples in every run of continuous integration; new ones at each run of a developer. No test is an
# assertion on seconds.
settings.register_profile("ci", derandomize=True, deadline=None)
settings.register_profile("developer", deadline=None)
settings.load_profile("ci" if os.environ.get("CI") else "developer")


SHARED = ("coarse_reduction", "coarse_patch_arrays", "virtual_model", "beam_reduction")
"""Fixtures of several files that take three to ten seconds each."""

LARGEST, COMPILING = "wing", "compiling"
"""The group of tests that takes longest, and the one that compiles loops, which takes more than a minute."""

COMPILED = ("benchmarks", "discrepancy", "portable", "twin_master", "uav_twin", "test_documented_python.py")
"""Folders and a file whose tests need loops: they come once the workers of the first two groups have compiled
them."""

MACHINE_CODE = "test_machine_code.py"
"""The file whose tests compile the loops of missions anew, and share them with all others."""

LONG = "takes minutes of processor time; set UAV_TWIN_LONG_TESTS to run it"

NOT_QUICK = Path(__file__).with_name("not_quick.txt")
"""Functions whose tests were not quick, the last time that they were listed (`tests.costs`)."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add what `make test-quick` asks for, and what renews its list."""
    parser.addoption("--quick", action="store_true", help="only tests of a fraction of a second")
    parser.addoption("--list-not-quick", action="store_true", help=f"write {NOT_QUICK.name} anew")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Let one worker run all tests that share what is made once.

    That is all tests of a file, of all files that use a fixture of `SHARED`, and of all files in which a test
    names the same group. The largest group comes first and begins with the tests of `MACHINE_CODE`, and last
    come those of `COMPILED`; among each of them slow ones, then those with many tests that are not quick: at
    the end a long one would keep one worker alone. Tests marked `long` are skipped unless they are asked for.
    """
    if not os.environ.get("UAV_TWIN_LONG_TESTS"):
        for item in items:
            if item.get_closest_marker("long"):
                item.add_marker(pytest.mark.skip(LONG))
    listed = set(NOT_QUICK.read_text("utf-8").split())
    if config.getoption("quick"):
        left_out = {item for item in items if item.nodeid.partition("[")[0] in listed}
        left_out |= {item for item in items if item.get_closest_marker("slow")}
        config.hook.pytest_deselected(items=[*left_out])
        items[:] = [item for item in items if item not in left_out]
    if not getattr(config.option, "loadgroup", False):  # not in a worker of `--dist loadgroup`
        return
    group = {item.path: str(item.path.relative_to(config.rootpath)) for item in items}
    shared = {item: getattr(item, "fixturenames", ()) for item in items}
    group |= {item.path: name for item in items for name in SHARED[::-1] if name in shared[item]}
    group |= {item.path: mark.args[0] for item in items for mark in item.iter_markers("xdist_group")}
    slow = {group[item.path] for item in items if item.get_closest_marker("slow")}
    waiting = {group[item.path] for item in items if set(COMPILED) & set(item.path.parts)}
    long = Counter(group[item.path] for item in items if item.nodeid.partition("[")[0] in listed)
    items.sort(
        key=lambda item: (
            group[item.path] != LARGEST,
            group[item.path] != COMPILING,
            item.path.name != MACHINE_CODE,
            group[item.path] in waiting,
            group[item.path] not in slow,
            -long[group[item.path]],
            item.path,  # workers find the files in an order of their own
        )
    )
    for item in items:
        if not item.get_closest_marker("xdist_group"):
            item.add_marker(pytest.mark.xdist_group(group[item.path]))
        # pytest-xdist hands groups over as an ending of the node's name, and pytest 9.2 has it elsewhere than
        # pytest-xdist 3.8 writes to (pytest-xdist, issue 1386): without this no group is kept together.
        if hasattr(item, "_id"):
            item._id = type(item._id).parse(f"{item.nodeid}@{group[item.path]}")


def pytest_sessionstart(session: pytest.Session) -> None:
    """Let one process do what each worker would do: remove what nobody reads, rewrite assertions."""
    if not hasattr(session.config, "workerinput"):
        remove_old()
        if getattr(session.config.option, "numprocesses", None):
            rewrite_assertions(session.config)
            gc.enable()  # the workers collect the tests


def rewrite_assertions(config: pytest.Config) -> None:
    """Rewrite the assertions of all test files that have changed, before the workers read these files.

    The workers begin with the same file at the same time, so that each would rewrite nearly all of them.
    """
    state = config.stash[rewrite.assertstate_key]
    for file in sorted(Path(__file__).parent.rglob("*.py")):
        if file.name.startswith("test_") or file.name == "conftest.py":
            folder = rewrite.get_cache_dir(file)
            rewritten = folder / f"{file.stem}{rewrite.PYC_TAIL}"
            if not sys.dont_write_bytecode and rewrite._read_pyc(file, rewritten) is None:
                folder.mkdir(parents=True, exist_ok=True)
                fingerprint, code = rewrite._rewrite_test(file, config)
                rewrite._write_pyc(state, code, fingerprint, rewritten)


def pytest_collection_finish(session: pytest.Session) -> None:
    """Take what all modules hold out of every later search for garbage, and search less often.

    Both were a tenth of the processor time. Until here there was no search.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 50)
    gc.enable()


_costs: defaultdict[str, list[costs.TestCost]] = defaultdict(list)
_name_of_fixture: dict[str, str] = {}


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_logstart() -> None:
    """Begin to count what a test costs."""
    costs.begin_test()


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup(
    fixturedef: pytest.FixtureDef[object], request: pytest.FixtureRequest
) -> Iterator[None]:
    """Count a fixture that several tests share for all of them."""
    if fixturedef.scope == "function":
        return (yield)
    name = f"{request.node.nodeid} {fixturedef.argname} {getattr(request, 'param_index', '')}"
    _name_of_fixture[fixturedef.argname] = name
    with costs.shared_by_tests(name):
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Report what a test cost once it has ended; pytest-xdist hands the attributes of a report over."""
    report = yield
    if call.when == "teardown":
        fixtures = {_name_of_fixture.get(name) for name in getattr(item, "fixturenames", ())}
        used = (fixtures | costs.running.shared_used) & costs.seconds_of_shared.keys()
        report.own_seconds = costs.running.own_seconds
        report.shared_seconds = {name: costs.seconds_of_shared[name] for name in used if name}
    return report


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Collect the costs of each function's tests."""
    if report.when == "teardown":
        function = report.nodeid.partition("[")[0].partition("@")[0]
        _costs[function].append(costs.TestCost(report.own_seconds, report.shared_seconds))


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Renew the list of what is not quick, where that is asked for; with warm caches.

    Beside `--quick`, what is no longer quick is added to it.
    """
    if session.config.getoption("list_not_quick") and not hasattr(session.config, "workerinput"):
        listed = set(NOT_QUICK.read_text("utf-8").split()) if session.config.getoption("quick") else set()
        names = sorted(listed | costs.slow_functions(_costs))
        NOT_QUICK.write_text("".join(f"{name}\n" for name in names), "utf-8")


LONGEST_COMPARED = 10_000
"""Items of a sequence; pytest looks for hours for the differences of two files of a megabyte."""


def pytest_assertrepr_compare(op: str, left: object, right: object) -> list[str] | None:
    """Say where two long sequences begin to differ, and no more."""
    for kind in (bytes, str, list, tuple):
        if op == "==" and isinstance(left, kind) and isinstance(right, kind):
            if max(len(left), len(right)) <= LONGEST_COMPARED:
                return None
            same = next(
                (k for k, (one, other) in enumerate(zip(left, right, strict=False)) if one != other),
                min(len(left), len(right)),
            )
            return [f"{len(left)} and {len(right)} items of {kind.__name__} differ from item {same} on"]
    return None


@pytest.fixture(scope="session")
def library_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A strain library in the published format, of a wing that never was: 24 gauges, 5 draws of e."""
    row = np.linspace(2910.0, 450.0, 16)
    healthy = np.concatenate([row, 1.06 * row[4:12] + 400.0])
    place = np.concatenate([np.linspace(0.0, 1.0, 16), np.linspace(0.27, 0.73, 8)])
    first = 0.12 + 0.32 * np.exp(-(((place - 0.27) / 0.12) ** 2))
    second = 0.02 + 0.33 * np.exp(-(((place - 0.62) / 0.12) ** 2))
    factors = (0.994, 1.0, 1.004, 1.008, 1.014)
    observations: dict[str, object] = {}
    for z1 in LEVELS:
        observations[str(z1)] = {}
        for z2 in LEVELS:
            strain = healthy / ((1.0 - first * z1 / 100.0) * (1.0 - second * z2 / 100.0))
            entry = {}
            for control, load in (("2g", 2.0), ("3g", 3.0)):
                draws = {"mean": (load / 3.0 * strain / 1.0**0.85).tolist()}
                draws |= {str(e): (load / 3.0 * strain / e**0.85).tolist() for e in factors}
                entry[control] = draws
            observations[str(z1)][str(z2)] = entry  # type: ignore[index]
    library = {
        "states": [list(LEVELS), list(LEVELS)],
        "controls": ["2g", "3g"],
        "gamma": 0.6,
        "transition_probabilities": {"2g": 0.05, "3g": 0.1},
        "observations": observations,
    }
    path = tmp_path_factory.mktemp("library") / "UAVconfig.json"
    path.write_text(json.dumps(library), encoding="utf-8")
    return path


def synthetic_calibration(
    count: int = 40, seed: int = 1, asset: str = "Wing 7 (é)", young_modulus_factor: float = 1.01
) -> Calibration:
    """A calibration drawn from Gaussians, for a design 2 mm longer than the shipped one, on a coarse mesh."""
    import xarray as xr

    from calibration.joint.wing_table import QUANTITIES, wing_priors
    from calibration.result.record import Calibration, QuantityReading
    from fe.wing.design import load_design

    generator = np.random.default_rng(seed)
    mean = np.array([young_modulus_factor, 0.17, 0.132, 1.05, 7.6e-4])
    spread = np.array([0.01, 0.004, 0.008, 0.1, 1e-4])
    quantity = np.array([682.0, 5.65, 28.6, 0.028, 0.07, 0.472])
    validity = {"young_modulus_factor": (0.9, 1.1), "servo_mass": (0.05, 0.3), "pitot_mass": (0.0, 0.3)}

    def drawn(rows: int, wider: float) -> np.ndarray[Any, np.dtype[np.float64]]:
        state = mean + wider * spread * generator.normal(size=(rows, 5))
        return np.hstack([state, quantity * (1.0 + 0.01 * wider * generator.normal(size=(rows, 6)))])

    design = load_design().changed(planform={"semi_span": 1.83}, mesh={"refinement": 0.25})
    samples = drawn(count, 1.0)
    return Calibration(
        asset=asset,
        model=design.name,
        model_hash=design.hash,
        procedure="joint",
        priors=wing_priors(validity),
        samples=samples,
        prior_samples=drawn(count + 3, 3.0),
        explained=None,
        findings=("The wing is drawn.",),
        channels=(),
        source="nowhere",
        seed=5,
        provenance={"versions": {"numpy": "2"}, "input_hashes": {}},
        design_hash=design.hash,
        quantities=QUANTITIES,
        readings=(QuantityReading("tip_stiffness", "load test", 682.1, 6.5),),
        measured=xr.Dataset(
            {
                name: ("pair", np.array(values), {"units": unit, "long_name": f"{name} of the test"})
                for name, unit, values in (("load", "N", [2.5, 5.0]), ("displacement", "m", [0.004, 0.007]))
            }
        ),
        design=design,
    )


@pytest.fixture(scope="session")
def make_calibration() -> Callable[..., Calibration]:
    """What makes a calibration without a wing."""
    return synthetic_calibration


@pytest.fixture(scope="module")
def no_report() -> Iterator[None]:
    """The report of a run has tests of its own and takes seconds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("twin_master.workflow._write_report", lambda folder: (folder / "report.html").touch())
        yield


@pytest.fixture(scope="session")
def shipped_design() -> WingDesign:
    from fe.wing.design import load_design

    return load_design()


@pytest.fixture(scope="session")
def coarse_design(shipped_design: WingDesign) -> WingDesign:
    return shipped_design.changed(mesh={"refinement": 0.25})


@pytest.fixture(scope="session")
def shipped_operators(shipped_design: WingDesign) -> AffineOperators:
    from fe.wing.operators import assemble

    return assemble(shipped_design)


@pytest.fixture(scope="session")
def coarse_operators(coarse_design: WingDesign) -> AffineOperators:
    from fe.wing.operators import assemble

    with threadpool_limits(1):  # as `fe.reduction.model_cache` builds, so that their bytes can be compared
        return assemble(coarse_design)


@pytest.fixture(scope="session")
def wing() -> ReducedModel:
    """The shipped wing, from the cache if an earlier test or run built it."""
    from fe.reduction.model_cache import reduced_model

    return reduced_model()


@pytest.fixture(scope="session")
def coarse_patch_arrays(coarse_design: WingDesign) -> PatchArrays:
    """That wing for patches, on the coarse mesh."""
    from fe.reduction.model_cache import build_patch_arrays

    return kept("coarse-patches", lambda: build_patch_arrays(coarse_design), FE, coarse_design.hash)


REFERENCE = ROOT.parent / "shared" / "reference"


@pytest.fixture(scope="session")
def published_library() -> Path:
    """Path of the authors' published strain library; skips where it is not at hand."""
    path = REFERENCE / "uav_digital_twin" / "UAVconfig.json"
    if not path.is_file():
        pytest.skip(f"the published strain library is not at {path}")
    return path


@pytest.fixture(scope="session")
def reference() -> Path:
    """The authors' calibration folder; skips where it is not at hand."""
    path = REFERENCE / "uav_experimental_calibration"
    if not path.is_dir():
        pytest.skip(f"the authors' calibration folder is not at {path}")
    return path


@pytest.fixture(scope="session")
def heat_exchanger(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with an FMU of a heat exchanger, its binding and its scenario."""
    source = ROOT / "tests" / "twin_master" / "assets" / "heat_exchanger"
    folder = tmp_path_factory.mktemp("heat_exchanger")
    shutil.copytree(source, folder, dirs_exist_ok=True)
    exported(folder / "HeatExchanger.py")
    return folder


@pytest.fixture(scope="session")
def foreign_fmu(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Build FMUs of other conventions and misbehaviours from C: `foreign_fmu("ball2")` is a path."""
    from tests.fmu_asset.making import Workshop

    return Workshop(tmp_path_factory.mktemp("foreign"))


INPUTS = Inputs(__file__)
BEAM = INPUTS.text("beam.toml")


@pytest.fixture(scope="session")
def write_beam() -> Callable[..., Path]:
    """A writer of a structure file with its mesh: regions, a parameter, a free mass, two controls, gauges.

    It takes the folder, texts to exchange in the file, and the number of 20-node hexahedra along the beam.
    """
    import meshio

    from tests.meshes import box

    def write(folder: Path, changes: Mapping[str, str] | None = None, cells: int = 4) -> Path:
        points, numbers = box("hexahedron20", (cells, 1, 1))
        mesh = meshio.Mesh(points * [100.0, 20.0, 10.0], [("hexahedron20", numbers)])
        meshio.write(folder / "beam.vtu", mesh)
        text = BEAM
        for old, new in (changes or {}).items():
            assert old in text
            text = text.replace(old, new)
        file = folder / "beam.toml"
        file.write_text(text, encoding="utf-8")
        return file

    return write


@pytest.fixture(scope="session")
def beam(write_beam: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> Structure:
    """The full model of the beam."""
    from fe.structure.operators import load_and_assemble

    return load_and_assemble(write_beam(tmp_path_factory.mktemp("beam")))


@pytest.fixture(scope="session")
def beam_reduction(beam: Structure) -> Reduction:
    """Its reduction."""
    from fe.reduction.reduced_basis import reduce_structure

    return reduce_structure(beam)
