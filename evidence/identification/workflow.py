"""Identification from the two published folders to a design file, a record and a report."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fe.wing.design import WingDesign, load_design
from reporting.errors import FileNotWrittenError
from reporting.files import atomic_write_text
from reporting.json_file import plain
from reporting.progress import Progress, SilentProgress
from reporting.provenance import collect_provenance

from .comparison import Outputs, compare, outputs
from .design_file import design_toml
from .errors import IdentificationError
from .identifiability import analyse, profile
from .identified import Identification, RemeshedComparison
from .least_squares import CONVERGED, identify
from .local_model import build_local_model
from .parameters import deviations, prior_means, with_values
from .report import report_page
from .targets import NO_LOSS, Targets, Weights, read_targets
from .wing_parameters import fixed_parameters, wing_parameters

RECORD_NAME = "identification.json"
DESIGN_NAME = "uav_wing.toml"
REPORT_NAME = "report.html"
PROFILED = ("web shear modulus", "transverse root spring", "net lift at 3g")
"""Numbers whose profile is drawn; each can stand for the others."""


class IdentificationFiles(NamedTuple):
    """Files that an identification writes."""

    record: Path
    design: Path
    report: Path


def result_files(out: Path) -> IdentificationFiles:
    """Return the paths that `write_identification` writes in the folder `out`."""
    return IdentificationFiles(out / RECORD_NAME, out / DESIGN_NAME, out / REPORT_NAME)


def run_identification(
    data: Path,
    start: WingDesign | None = None,
    weights: Weights | None = None,
    *,
    from_prior: bool = False,
    largest_count: int = 15,
    refinements: Sequence[float] = (),
    progress: Progress | None = None,
) -> Identification:
    """Read the published outputs, fit, compare and analyse.

    Parameters
    ----------
    data : Path
        Folder that holds the authors' two repositories.
    start : WingDesign, optional
        Design at which the fit begins; the shipped wing by default.
    weights : Weights, optional
        Standard deviations of the residuals.
    from_prior : bool
        Whether the fit begins with every free number at its prior mean.
    largest_count : int
        Largest number of full models.
    refinements : sequence of float
        Meshes on which the result is evaluated again, relative to that of the design.
    progress : Progress, optional
        Receives a note on each step.

    Raises
    ------
    CalibrationError
        If the published files cannot be read, or the start cannot be identified.
    fe.runtime.errors.FiniteElementError
        If a mesh cannot be built or solved.
    """
    progress = progress or SilentProgress()
    weights = weights or Weights()
    targets = read_targets(data)
    design = load_design() if start is None else start
    parameters = wing_parameters(design)
    _check_gauge_count(design, targets)
    if from_prior:
        design = with_values(design, parameters, prior_means(parameters))
    for (
        refinement
    ) in refinements:  # a mesh that cannot be built is refused before the minutes of the fit
        _refined(design, refinement)
    progress.note(f"{len(parameters)} free numbers")
    fit = identify(
        design, parameters, targets, weights, largest_count=largest_count, progress=progress
    )
    outputs_after = outputs(fit.model, targets)
    outputs_before = outputs_after
    if np.any(fit.values != fit.start):
        outputs_before = outputs(build_local_model(design, ()), targets)
    with progress.stage("Analysing"):
        analysis = analyse(fit, targets, weights, fixed_parameters())
        profiles = tuple(profile(fit, targets, weights, analysis, name) for name in PROFILED)
    return Identification(
        fit=fit,
        targets=targets,
        weights=weights,
        comparison=compare(outputs_after, targets),
        before=compare(outputs_before, targets),
        outputs=outputs_after,
        outputs_before=outputs_before,
        analysis=analysis,
        profiles=profiles,
        remeshed=_remeshed(fit.design, outputs_after, targets, refinements, progress),
    )


def _check_gauge_count(design: WingDesign, targets: Targets) -> None:
    """Raise `IdentificationError` if a design has not as many gauges as the published library."""
    gauge_count = targets.strain.shape[2]
    if len(design.gauges.positions) != gauge_count:
        raise IdentificationError(
            f"the start has {len(design.gauges.positions)} gauges, but the published library "
            f"{gauge_count}."
        )


def _refined(design: WingDesign, refinement: float) -> WingDesign:
    """Return a design with a mesh refined relative to its own."""
    return design.changed(mesh={"refinement": design.mesh.refinement * refinement})


def _remeshed(
    design: WingDesign,
    outputs_on_own_mesh: Outputs,
    targets: Targets,
    refinements: Sequence[float],
    progress: Progress,
) -> tuple[RemeshedComparison, ...]:
    """Compare the identified wing on its own mesh and on others; nothing without refinements.

    Parameters
    ----------
    design : WingDesign
        The identified wing.
    outputs_on_own_mesh : Outputs
        Outputs of the wing on its own mesh.
    targets : Targets
        Published outputs.
    refinements : sequence of float
        Refinements of the other meshes, relative to that of the design.
    progress : Progress
        Receives a note on each mesh.
    """
    comparisons = []
    if refinements:
        rows = compare(outputs_on_own_mesh, targets)
        comparisons.append(RemeshedComparison(1.0, outputs_on_own_mesh.unknowns, rows))
    with progress.stage("Remeshing", total=len(refinements), unit="meshes") as stage:
        for refinement in refinements:
            model = build_local_model(_refined(design, refinement), ())
            outputs_on_mesh = outputs(model, targets)
            rows = compare(outputs_on_mesh, targets)
            comparisons.append(RemeshedComparison(refinement, outputs_on_mesh.unknowns, rows))
            stage.advance()
    return tuple(comparisons)


def write_identification(result: Identification, out: Path) -> IdentificationFiles:
    """Write design, report and record into a folder; the record last, to vouch for the others.

    Raises
    ------
    reporting.errors.FileNotWrittenError
        If a file cannot be written.
    """
    if out.exists() and not out.is_dir():
        raise FileNotWrittenError(f"{out} exists and is not a folder: choose another --out.")
    files = result_files(out)
    texts = {
        files.design: design_toml(result.fit.design, identified_places(result)),
        files.report: report_page(result),
        files.record: json.dumps(record(result), indent=1, allow_nan=False) + "\n",
    }
    for path, text in texts.items():
        atomic_write_text(path, text)
    return files


def identified_places(result: Identification) -> dict[str, str]:
    """Return the remark beside each identified number of the design, by its dotted place."""
    return {parameter.place: "identified" for parameter in result.fit.parameters}


def record(result: Identification) -> dict[str, object]:
    """Return the identification as plain dictionaries and lists, ready for JSON."""
    fit = result.fit
    analysis = result.analysis
    weak_directions = np.flatnonzero(analysis.singular_values < 1.0).tolist()
    provenance = collect_provenance(
        None,
        input_hashes=result.targets.sources,
        packages=("calibration", "evidence.identification", "fe", "reporting"),
    )
    return {
        "design": {"name": fit.design.name, "hash": fit.design.hash},
        "converged": fit.converged,
        "tolerance": CONVERGED,
        "largest_change": result.largest_change,
        "unknowns": fit.model.unknowns,
        "frequencies_hz": fit.model.frequency.tolist(),
        "weights": asdict(result.weights),
        "parameters": _parameter_records(result),
        "iterations": plain(fit.iterations),
        "comparison": [{**asdict(row), "reached": row.reached} for row in result.comparison],
        "comparison_of_the_start": [asdict(row) for row in result.before],
        "healthy_strain": result.outputs.healthy_strain.tolist(),
        "limiting_gauge_strain": result.outputs.strain[:, NO_LOSS].max(axis=1).tolist(),
        "singular_values": analysis.singular_values.tolist(),
        "effective_count": analysis.effective_count,
        "weak_directions": [analysis.describe(number) for number in weak_directions],
        "correlated": [list(pair) for pair in analysis.pairs()],
        "imitated": [list(pair) for pair in analysis.fixed],
        "profiles": plain(result.profiles),
        "remeshed": _remeshed_records(result.remeshed),
        "provenance": provenance.as_dict(),
    }


def _parameter_records(result: Identification) -> list[dict[str, object]]:
    """Return each free number with its prior and its fit, ready for JSON."""
    fit = result.fit
    deviations_after = result.analysis.width * deviations(fit.parameters)
    records = []
    for number, parameter in enumerate(fit.parameters):
        parameter_record: dict[str, object] = {
            "name": parameter.name,
            "unit": parameter.unit,
            "place": parameter.place,
            "prior_mean": parameter.mean,
            "prior_standard_deviation": parameter.standard_deviation,
            "bounds": [parameter.lower, parameter.upper],
            "start": float(fit.start[number]),
            "value": float(fit.values[number]),
            "standard_deviation": float(deviations_after[number]),
            "why": parameter.why,
        }
        records.append(parameter_record)
    return records


def _remeshed_records(remeshed: Sequence[RemeshedComparison]) -> list[dict[str, object]]:
    """Return the comparisons on several meshes, ready for JSON."""
    records = []
    for mesh in remeshed:
        mesh_record: dict[str, object] = {
            "refinement": mesh.refinement,
            "unknowns": mesh.unknowns,
            "comparison": [asdict(row) for row in mesh.comparison],
        }
        records.append(mesh_record)
    return records
