"""The design of the wing, identified from published data: targets, free numbers, local models, the fit.

A virtual wing, a design on a coarse mesh, gives outputs that stand for the published ones.
"""

import json
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.errors import ExperimentDataError, ExperimentFileError
from evidence.identification.__main__ import main
from evidence.identification.comparison import NO_LIMITS, _row, outputs
from evidence.identification.design_file import HEADER, design_toml, rounded
from evidence.identification.errors import IdentificationError
from evidence.identification.identifiability import analyse, profile
from evidence.identification.least_squares import DesignFit, identify
from evidence.identification.local_model import LocalModel, build_local_model
from evidence.identification.parameters import deviations, scaled, values_of, with_values
from evidence.identification.targets import (
    LEVELS,
    MASS_TOTAL,
    REFERENCE_PITOT,
    Targets,
    Weights,
    fitted_states,
    read_targets,
)
from evidence.identification.wing_parameters import wing_parameters
from fe.structure.affine import natural_frequencies, static_response
from fe.wing.design import SHIPPED_DESIGN, WingDesign, load_design, parse_design
from fe.wing.operators import assemble, flapwise_bending_modes, point_masses, wing_values
from tests import command_line
from tests.kept import FE, ROOT, kept
from tests.wings import tip_stiffness

ROWS = 12
RESULTS = Path("calibration") / "step3" / "massoptimizationresults.csv"
LIBRARY = Path("library") / "UAVconfig.json"
SLOPES = "frequency_at_one", "frequency_slope", "mass_slope"
COLUMNS = (
    "e_sample,target_freq_1,target_freq_2,zeta_1,zeta_2,mass_servo_1,mass_servo_2,mass_pitot,freq_1,freq_2"
)


DESIGN = load_design()
PARAMETERS = wing_parameters(DESIGN)
VIRTUAL = DESIGN.changed(mesh={"refinement": 0.25, "span_size": 0.06, "chord_size": 0.2})
WIDE = ("skin modulus at 0", "flap root spring", "net lift at 3g", "skin density", "cluster 1 chord")
CHOSEN = {
    *WIDE, "skin shear ratio", "web shear modulus", "inner servo station", "defect 1 span end",
    "defect 2 chord end", "row A first",
}  # fmt: skip
SOME = tuple(p for p in wing_parameters(VIRTUAL) if p.name in CHOSEN)
"""One of each kind: skin, inside, root, mass, place, load, edge, gauges."""
FREE = tuple(
    replace(
        p,
        mean=float(values_of(VIRTUAL, [p])[0]),
        standard_deviation=10.0 * p.standard_deviation,
        lower=p.lower - 9.0 * p.standard_deviation,
        upper=p.upper + 9.0 * p.standard_deviation,
    )
    for p in SOME
    if p.name in WIDE
)
"""With priors so wide that the virtual data decide."""


@pytest.fixture(scope="session")
def virtual_model() -> LocalModel:
    made_from = (*FE, ROOT / "calibration", ROOT / "evidence", Path(__file__))
    return kept("local-model", lambda: build_local_model(VIRTUAL, SOME), made_from)


def rows() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    random = np.random.default_rng(5)
    pitot = random.uniform(0.11, 0.15, ROWS)
    return random.uniform(0.96, 1.06, ROWS), 0.5 * (MASS_TOTAL - pitot), pitot


@pytest.fixture(scope="session")
def virtual_targets(virtual_model: LocalModel) -> Targets:
    """Targets that this model meets exactly."""
    factor, servo, pitot = rows()
    blank = Targets(
        strain=np.ones((len(LEVELS), len(LEVELS), 24)),
        strain_slope=np.zeros(24),
        young_modulus_factor=factor,
        servo_mass=servo,
        pitot_mass=pitot,
        frequency=np.ones((ROWS, 2)),
        fitted_row=np.arange(ROWS) % 2 == 0,
        sources={},
        **{f"{kind}{name}": np.ones(2) for kind in ("", "all_") for name in SLOPES},
    )
    found = outputs(virtual_model, blank)
    own = ("strain", "tip_stiffness", "tip_stiffness_slope", "strain_slope", "frequency", *SLOPES)
    met = {name: getattr(found, name) for name in own}
    return replace(blank, **met, **{f"all_{name}": met[name] for name in SLOPES})


def write_published_folder(folder: Path, library_file: Path) -> Path:
    """Write a folder laid out as the two published ones, of a wing that never was.

    Step 3 has power laws in e and exponentials in the mass.
    """
    factor, servo, pitot = rows()
    first = 5.632 * factor**0.41 * np.exp(-0.5 * (pitot - REFERENCE_PITOT))
    second = 28.5 * factor**0.32 * np.exp(-0.3 * (pitot - REFERENCE_PITOT))
    for path in (RESULTS, LIBRARY):
        (folder / path).parent.mkdir(parents=True)
    targets = np.tile([5.6492, 29.9699, 0.0281, 0.0717], (ROWS, 1))
    table = np.column_stack((factor, targets, servo, servo, pitot, first, second))
    np.savetxt(folder / RESULTS, table, "%.17g", ",", header=COLUMNS, comments="")
    (folder / LIBRARY).write_bytes(library_file.read_bytes())
    return folder


@pytest.fixture
def published_folder(tmp_path: Path, library_file: Path) -> Path:
    """A folder laid out as the two published ones."""
    return write_published_folder(tmp_path, library_file)


# ---------------------------------------------------------------- published data


def test_a_folder_with_both_repositories_is_read(published_folder):
    targets = read_targets(published_folder)
    assert targets.strain.shape == (5, 5, 24)
    assert set(targets.sources) == {"UAVconfig.json", "massoptimizationresults.csv"}


def test_states_and_rows_that_are_fitted_are_told_from_those_that_are_held_out(published_folder):
    states = {(LEVELS[first], LEVELS[second]) for first, second in np.argwhere(fitted_states())}
    assert states == {(0.4, 0.0), (0.8, 0.0), (0.0, 0.4), (0.0, 0.8)}
    assert read_targets(published_folder).fitted_row.tolist() == [number % 2 == 0 for number in range(12)]


def test_the_laws_of_frequency_and_strain_are_found(published_folder):
    targets = read_targets(published_folder)
    assert targets.frequency_at_one == pytest.approx([5.632, 28.5], rel=1e-6)
    assert targets.frequency_slope == pytest.approx([0.41, 0.32], abs=1e-6)
    assert targets.strain_slope == pytest.approx(np.full(24, -0.85), abs=1e-9)


def test_the_law_of_the_mass_is_found(published_folder):
    assert read_targets(published_folder).all_mass_slope == pytest.approx([-0.5, -0.3], abs=1e-6)


def raise_first_frequency_of_held_out_rows(results):
    lines = results.read_text().splitlines()
    for number in range(2, len(lines), 2):
        *cells, first_frequency, second_frequency = lines[number].split(",")
        lines[number] = ",".join([*cells, str(1.05 * float(first_frequency)), second_frequency])
    results.write_text("\n".join(lines) + "\n")


def test_slopes_come_from_the_fitted_rows_alone(published_folder):
    before = read_targets(published_folder)
    raise_first_frequency_of_held_out_rows(published_folder / RESULTS)
    after = read_targets(published_folder)
    assert after.frequency_slope.tolist() == before.frequency_slope.tolist()
    assert after.all_frequency_slope.tolist() != before.all_frequency_slope.tolist()


@pytest.fixture(scope="module")
def published(published_library):
    return read_targets(published_library.parents[1])


def test_the_published_strain_is_read(published):
    largest = published.strain[:, 0, 16] * 1e6
    assert published.strain[0, 0].argmax() == 16
    assert largest == pytest.approx([3010, 3274, 3617, 4088, 4788], abs=1.0)
    assert published.strain_slope[16] == pytest.approx(-0.60, abs=0.01)


def test_the_published_frequencies_are_read(published):
    assert published.all_frequency_at_one == pytest.approx([5.632, 28.544], rel=1e-4)
    assert int(published.fitted_row.sum()) == 50


def test_a_folder_without_the_files_is_one_sentence(tmp_path, library_file):
    with pytest.raises(ExperimentFileError, match=r"holds 0 files UAVconfig\.json"):
        read_targets(tmp_path)
    (tmp_path / "UAVconfig.json").write_bytes(library_file.read_bytes())
    with pytest.raises(ExperimentFileError, match=r"holds 0 files step3/massoptimizationresults\.csv"):
        read_targets(tmp_path)


def strains(content: dict[str, Any]) -> list[float]:
    """The mean strains in a state."""
    return content["observations"]["20"]["0"]["3g"]["mean"]


@pytest.mark.parametrize(
    ("file", "change", "sentence"),
    [
        (RESULTS, lambda lines: lines.__delitem__(slice(6, None)), "holds 5 rows; at least 10"),
        (LIBRARY, lambda content: strains(content).insert(4, -strains(content).pop(4)),
         "must be positive"),
        (LIBRARY, lambda content: content["states"][0].pop(), "the levels of z1"),
        (LIBRARY, lambda content: content["controls"].pop(), "has no control 3g"),
    ],
)  # fmt: skip
def test_other_files_are_refused(published_folder, file, change, sentence):
    path = published_folder / file
    content = path.read_text().splitlines() if file is RESULTS else json.loads(path.read_text())
    change(content)
    path.write_text("\n".join(content) + "\n" if file is RESULTS else json.dumps(content))
    with pytest.raises(ExperimentDataError, match=sentence):
        read_targets(published_folder)


# ---------------------------------------------------------------- free numbers and files of designs


@settings(max_examples=20, deadline=None)
@given(st.lists(st.floats(-0.4, 0.4), min_size=len(PARAMETERS), max_size=len(PARAMETERS)))
def test_what_is_written_is_read_back(steps):
    values = values_of(DESIGN, PARAMETERS)
    lower = np.array([parameter.lower for parameter in PARAMETERS])
    upper = np.array([parameter.upper for parameter in PARAMETERS])
    wanted = np.clip(values + deviations(PARAMETERS) * np.array(steps), lower, upper)
    found = values_of(with_values(DESIGN, PARAMETERS, wanted), PARAMETERS)
    assert found == pytest.approx(wanted, rel=1e-9, abs=1e-12)


def test_a_start_laid_out_otherwise_or_outside_its_bounds_is_refused(virtual_targets):
    webs = [web.model_dump() for web in DESIGN.webs]
    webs[1]["shear_modulus"] *= 2.0
    with pytest.raises(
        IdentificationError, match=r"'web shear modulus' stands at webs\.\*\.shear_modulus .*differ"
    ):
        values_of(DESIGN.changed(webs=webs), PARAMETERS)
    bare: WingDesign = DESIGN.changed(added_density=[])
    with pytest.raises(IdentificationError, match="has nothing there"):
        values_of(bare, PARAMETERS)
    with pytest.raises(IdentificationError, match="24 gauges"):
        values_of(DESIGN.changed(gauges={"positions": DESIGN.gauges.positions[:8]}), PARAMETERS)
    with pytest.raises(IdentificationError, match="outside its bounds of 1 to 2"):
        identify(DESIGN, [replace(PARAMETERS[0], lower=1.0, upper=2.0)], virtual_targets)


@pytest.fixture
def named_design():
    return DESIGN.changed(name='a "wing" \\ of mine')


def test_a_written_design_is_read_back(named_design):
    design = parse_design(tomllib.loads(design_toml(named_design, {})))
    assert design == parse_design(rounded(named_design))
    assert design_toml(design, {}) == design_toml(named_design, {})


def test_a_written_design_has_comments_on_gauges_and_on_identified_numbers(named_design):
    comments = {"skin.stations.0.young_modulus": "identified", "webs.*.shear_modulus": "too"}
    text = design_toml(named_design, comments)
    assert parse_design(tomllib.loads(text)) == parse_design(rounded(named_design))
    assert sum(line.endswith("# too") for line in text.splitlines()) == len(named_design.webs)
    assert "row A is gauges 1-16, row B gauges 17-24" in text


def test_the_shipped_design_is_such_a_file():
    schema, _, shipped = SHIPPED_DESIGN.read_text(encoding="utf-8").partition("\n")
    header = "".join(f"# {line}".rstrip() + "\n" for line in HEADER)
    assert schema.startswith("#:schema ")
    assert shipped.startswith(header)
    assert parse_design(rounded(DESIGN)) == DESIGN


def test_the_first_gauge_is_gauge_1():
    difference = np.zeros((3, 24))
    difference[2, 0] = 1.0
    assert _row("strain", "%", difference, NO_LIMITS, True).where == "gauge 1"
    difference[1, 23] = -2.0
    assert _row("strain", "%", difference, NO_LIMITS, True).where == "gauge 24"


# ---------------------------------------------------------------- local models


@pytest.mark.long
def test_values_are_those_of_the_full_model(virtual_model):
    operators = assemble(VIRTUAL)
    wing = virtual_model.wing
    for loss in ((0.0, 0.0), (0.8, 0.0), (0.6, 0.0), (0.8, 0.8)):
        full = static_response(operators, wing_values(operators, 1.0073, loss, load_factor=3.0)).strain
        # States that are not in the basis are close, not exact.
        limit = 5e-5 if loss in {(0.0, 0.0), (0.8, 0.0)} else 2e-3
        assert wing.strain(1.0073, loss).value == pytest.approx(full, rel=limit)
    for factor in (0.97, 1.0, 1.04):
        assert wing.tip_stiffness(factor).value[0] == pytest.approx(
            tip_stiffness(operators, factor), rel=2e-5
        )
        values = wing_values(operators, factor, (0.0, 0.0), **point_masses(0.16, 0.14))
        modes = natural_frequencies(operators, 6, values)
        bending = flapwise_bending_modes(operators, modes)
        own = np.exp(wing.log_frequency(*(np.array([x]) for x in (factor, 0.16, 0.14))).value[0])
        assert own == pytest.approx(modes.frequency[bending], rel=1e-5)


def test_slopes_are_differences_of_values(virtual_model):
    wing, factor, h = virtual_model.wing, 1.0073, 1e-4
    for slope, value in (
        (wing.strain_slope(factor).value, lambda e: wing.strain(e, (0.0, 0.0)).value),
        (wing.tip_stiffness(factor).value[1:], lambda e: wing.tip_stiffness(e).value[:1]),
    ):
        difference = np.log(value(factor * np.exp(h)) / value(factor * np.exp(-h))) / (2.0 * h)
        assert slope == pytest.approx(difference, rel=1e-5)


def test_an_affine_step_is_exact(virtual_model):
    values = virtual_model.values.copy()
    for number, parameter in enumerate(SOME):
        if parameter.name in ("skin modulus at 0", "net lift at 3g"):
            values[number] *= 1.02
    full = assemble(with_values(VIRTUAL, SOME, values))
    found = virtual_model.at(values).strain(1.0073, (0.0, 0.0)).value
    # Only what the basis lacks of the moved solution is left: second order in the step.
    wanted = static_response(full, wing_values(full, 1.0073, (), load_factor=3.0)).strain
    assert found == pytest.approx(wanted, rel=1e-3)


# ---------------------------------------------------------------- the fit


@pytest.fixture(scope="module")
def recovered(virtual_targets: Targets) -> DesignFit:
    offset = np.array([0.05, -0.06, 0.1, -0.05, 0.06]) * deviations(FREE)
    start = with_values(VIRTUAL, FREE, values_of(VIRTUAL, FREE) + offset)
    return identify(start, FREE, virtual_targets, tolerance=2e-4)


@pytest.mark.long  # the fit takes a minute
def test_known_numbers_are_recovered(recovered):
    """From a start that is 4 % and more off."""
    error = scaled(FREE, recovered.values) - scaled(FREE, values_of(VIRTUAL, FREE))
    way = scaled(FREE, recovered.start) - scaled(FREE, recovered.values)
    assert np.abs(error).max() < 2e-3
    assert np.abs(way).max() > 0.04


@pytest.mark.long
def test_a_fit_converges_to_a_small_fraction_of_its_misfit(recovered):
    assert recovered.converged
    assert recovered.iterations[0].objective > 100.0 * recovered.iterations[-1].objective


@pytest.fixture(scope="module")
def fitted_again(recovered, virtual_targets):
    """A fit that begins with the numbers of another one."""
    return identify(recovered.design, FREE, virtual_targets, tolerance=2e-4)


@pytest.mark.long
def test_a_fit_that_begins_with_the_right_numbers_stays_there(fitted_again):
    assert fitted_again.converged
    assert len(fitted_again.iterations) == 1
    assert fitted_again.values.tolist() == fitted_again.start.tolist()


@pytest.mark.long
def test_a_fit_that_stays_has_the_misfit_of_the_first_one(fitted_again, recovered):
    objective = recovered.iterations[-1].objective
    assert fitted_again.iterations[-1].objective == pytest.approx(objective, abs=1e-6)


@pytest.fixture(scope="module")
def analysis(recovered, virtual_targets):
    return analyse(recovered, virtual_targets, Weights())


@pytest.mark.long
def test_the_analysis_has_the_widths_of_the_posterior(analysis):
    jacobian = analysis.singular_values[:, None] * analysis.directions
    covariance = np.linalg.inv(jacobian.T @ jacobian + np.eye(len(FREE)))
    assert analysis.width == pytest.approx(np.sqrt(np.diag(covariance)), rel=1e-8)


@pytest.mark.long
def test_the_analysis_tells_known_numbers(analysis):
    assert 0.0 < analysis.effective_count < len(FREE)
    assert np.all(analysis.width < 1.0)


@pytest.mark.long
def test_without_weights_the_analysis_tells_all_numbers_unknown(recovered, virtual_targets):
    blind = Weights(**dict.fromkeys(Weights.__dataclass_fields__, 1000000000.0))
    nothing = analyse(recovered, virtual_targets, blind)
    assert nothing.effective_count < 1e-6
    assert nothing.width == pytest.approx(np.ones(len(FREE)))


@pytest.mark.long
def test_the_profile_of_a_nearly_linear_number_is_a_parabola(recovered, virtual_targets, analysis):
    lift = profile(recovered, virtual_targets, Weights(), analysis, "net lift at 3g")
    assert lift.rise.min() == pytest.approx(0.0, abs=1e-3)
    assert lift.rise == pytest.approx(lift.linear, rel=0.1, abs=0.05)


@pytest.mark.long
def test_the_profile_of_an_unknown_number_is_refused(recovered, virtual_targets, analysis):
    with pytest.raises(IdentificationError, match="no free number 'lift'"):
        profile(recovered, virtual_targets, Weights(), analysis, "lift")


# ---------------------------------------------------------------- the command


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory):
    """The folder into which a run writes."""
    return tmp_path_factory.mktemp("run") / "out"


@pytest.fixture(scope="module")
def run_of_one_step(tmp_path_factory, library_file, run_folder):
    """A run of one step on the data of a wing that never was."""
    data = write_published_folder(tmp_path_factory.mktemp("data"), library_file)
    start = data / "start.toml"
    start.write_text(design_toml(VIRTUAL, {}))
    arguments = ("--data", data, "--design", start, "--out", run_folder, "--steps", "1")
    return command_line.command(*arguments, main=main)


@pytest.mark.long
def test_a_run_that_has_not_converged_says_so(run_of_one_step):
    """One model is not enough for such a wing; the result is written and the exit code says so."""
    assert run_of_one_step.returncode == 1
    assert "has not converged" in run_of_one_step.stderr
    assert "limiting gauge" in run_of_one_step.stdout


@pytest.mark.long
@pytest.mark.usefixtures("run_of_one_step")
def test_a_run_leaves_a_design_a_record_and_a_report(run_folder):
    names = sorted(path.name for path in run_folder.iterdir())
    design = parse_design(tomllib.loads((run_folder / "uav_wing.toml").read_text()))
    assert names == ["identification.json", "report.html", "uav_wing.toml"]
    assert design.mesh == VIRTUAL.mesh


@pytest.fixture
def record_of_run(run_of_one_step, run_folder):
    return json.loads((run_folder / "identification.json").read_text())


@pytest.mark.long
def test_the_record_of_a_run_has_its_sources_and_its_singular_values(record_of_run):
    assert record_of_run["converged"] is False
    assert "evidence.identification" in record_of_run["provenance"]["source_hashes"]
    assert len(record_of_run["parameters"]) == len(record_of_run["singular_values"])


@pytest.mark.long
def test_the_record_of_a_run_compares_what_was_not_fitted(record_of_run):
    held_out = {row["name"] for row in record_of_run["comparison"] if not row["fitted"]}
    assert held_out >= {"strain ratios at (80, 80)"}


@pytest.mark.long
@pytest.mark.usefixtures("run_of_one_step")
def test_the_page_of_a_run_has_three_figures_and_needs_no_network(run_folder):
    page = (run_folder / "report.html").read_text()
    assert page.count("<figure") == 3
    assert "http://" not in page.replace("http://www.w3.org", "")
