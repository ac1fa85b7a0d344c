"""Identification from the two published folders to a design file, a record and a report."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fe.wing.design import WingDesign, load_design
from reporting.errors import FileNotWrittenError
from reporting.files import atomic_write_text
from reporting.json_file import plain
from reporting.progress import Progress, SilentProgress
from reporting.provenance import collect_provenance

from .comparison import compare, outputs
from .design_file import design_toml
from .errors import IdentificationError
from .identifiability import analyse, profile
from .identified import Identification
from .least_squares import CONVERGED, identify
from .local_model import build_local_model
from .parameters import deviations, fixed_parameters, wing_parameters, with_values
from .report import report_page
from .targets import Weights, read_targets

RECORD_NAME = "identification.json"
DESIGN_NAME = "uav_wing.toml"
REPORT_NAME = "report.html"
PROFILED = ("web shear modulus", "transverse root spring", "net lift at 3g")
"""Numbers whose profile is drawn: those that stand for each other."""


class IdentificationFiles(NamedTuple):
    """What a workflow leaves in its folder."""

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
        Where to begin; the shipped wing by default.
    weights : Weights, optional
        What one unit of misfit is.
    from_prior : bool
        Begin with every free number at its prior mean.
    largest_count : int
        Largest number of full models.
    refinements : sequence of float
        Meshes on which the result is evaluated again, relative to that of the design.
    progress : Progress, optional
        Told of every step.

    Raises
    ------
    CalibrationError
        If the published files cannot be read, or the start cannot be identified.
    fe.runtime.errors.FiniteElementError
        If a mesh cannot be built or solved.
    """
    progress, weights = progress or SilentProgress(), weights or Weights()
    targets = read_targets(data)
    design = load_design() if start is None else start
    parameters = wing_parameters(design)
    if len(design.gauges.positions) != targets.strain.shape[2]:
        raise IdentificationError(
            f"the start has {len(design.gauges.positions)} gauges, but the published library "
            f"{targets.strain.shape[2]}."
        )
    if from_prior:
        design = with_values(design, parameters, np.array([parameter.mean for parameter in parameters]))
    for refinement in refinements:  # what cannot be meshed is said before the minutes of the fit
        design.changed(mesh={"refinement": design.mesh.refinement * refinement})
    progress.note(f"{len(parameters)} free numbers")
    fit = identify(design, parameters, targets, weights, largest_count=largest_count, progress=progress)
    moved = bool(np.any(fit.values != fit.start))
    found = outputs(fit.model, targets)
    first = outputs(build_local_model(design, ()), targets) if moved else found
    with progress.stage("Analysing"):
        analysis = analyse(fit, targets, weights, fixed_parameters())
        profiles = tuple(profile(fit, targets, weights, analysis, name) for name in PROFILED)
    remeshed = [(1.0, found.unknowns, compare(found, targets))] if refinements else []
    with progress.stage("Remeshing", total=len(refinements), unit="meshes") as stage:
        for refinement in refinements:
            finer = fit.design.mesh.refinement * refinement
            other = outputs(build_local_model(fit.design.changed(mesh={"refinement": finer}), ()), targets)
            remeshed.append((refinement, other.unknowns, compare(other, targets)))
            stage.advance()
    return Identification(
        fit=fit,
        targets=targets,
        weights=weights,
        comparison=compare(found, targets),
        before=compare(first, targets),
        outputs=found,
        outputs_before=first,
        analysis=analysis,
        profiles=profiles,
        remeshed=tuple(remeshed),
    )


def write_identification(result: Identification, out: Path) -> IdentificationFiles:
    """Write design, report and record into a folder; the record last, to vouch for the others.

    Raises
    ------
    reporting.errors.FileNotWrittenError
        If a file cannot be written.
    """
    if out.exists() and not out.is_dir():
        raise FileNotWrittenError(f"{out} exists and is no folder: choose another --out.")
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
    """Return the dotted places of the identified numbers, with what stands beside them in the design."""
    places = {}
    for parameter in result.fit.parameters:
        path = parameter.path or ("gauges", "positions")
        places[".".join(map(str, path))] = "identified"
    return places


def record(result: Identification) -> dict[str, Any]:
    """Return everything that is reported as plain dictionaries and lists, ready for JSON."""
    fit, analysis = result.fit, result.analysis
    width = analysis.width * deviations(fit.parameters)
    return {
        "design": {"name": fit.design.name, "hash": fit.design.hash},
        "converged": fit.converged,
        "tolerance": CONVERGED,
        "largest_change": result.largest_change,
        "unknowns": fit.model.unknowns,
        "frequencies_hz": fit.model.frequency.tolist(),
        "weights": asdict(result.weights),
        "parameters": [
            {
                "name": parameter.name,
                "unit": parameter.unit,
                "place": ".".join(map(str, parameter.path or ("gauges", "positions"))),
                "prior_mean": parameter.mean,
                "prior_standard_deviation": parameter.standard_deviation,
                "bounds": [parameter.lower, parameter.upper],
                "start": float(begin),
                "value": float(value),
                "standard_deviation": float(own),
                "why": parameter.why,
            }
            for parameter, begin, value, own in zip(fit.parameters, fit.start, fit.values, width, strict=True)
        ],
        "iterations": plain(fit.iterations),
        "comparison": [{**asdict(row), "reached": row.reached} for row in result.comparison],
        "comparison_of_the_start": [asdict(row) for row in result.before],
        "healthy_strain": result.outputs.strain[0, 0].tolist(),
        "limiting_gauge_strain": result.outputs.strain[:, 0].max(axis=1).tolist(),
        "singular_values": analysis.singular_values.tolist(),
        "effective_count": analysis.effective_count,
        "weak_directions": [
            analysis.describe(number)
            for number in range(len(analysis.singular_values))
            if analysis.singular_values[number] < 1.0
        ],
        "correlated": [list(pair) for pair in analysis.pairs()],
        "imitated": [list(pair) for pair in analysis.fixed],
        "profiles": plain(result.profiles),
        "remeshed": [
            {"refinement": refinement, "unknowns": unknowns, "comparison": [asdict(row) for row in rows]}
            for refinement, unknowns, rows in result.remeshed
        ],
        "provenance": collect_provenance(
            None,
            input_hashes=result.targets.sources,
            packages=("calibration", "evidence.identification", "fe", "reporting"),
        ).as_dict(),
    }
