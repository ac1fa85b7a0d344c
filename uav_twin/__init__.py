"""A predictive structural digital twin of a UAV wing: the one name to import.

Each name below comes from the package that holds it, and is imported when it is first used. `docs/python.md`
shows all of them at work; the command line is `uav-twin`.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # what type checkers and editors read; `_HOMES` says the same when it runs
    from calibration.dynamics.modal_identification import identify_modes
    from calibration.result.file import load_calibration
    from calibration.wing.calibrate import calibrate_wing as calibrate
    from discrepancy.application import apply_verdict
    from discrepancy.campaign.reading import read_campaign
    from discrepancy.files.verdict import read_verdict_folder as read_verdict
    from discrepancy.model_choice import load_model
    from discrepancy.workflow import investigate
    from fe.reduction.model_cache import reduced_model, reduced_structure
    from fe.structure.field import natural_frequencies, static_responses
    from fe.structure.operators import load_any as assemble_structure
    from fe.wing.design import load_design
    from fe.wing.operators import assemble
    from fe.wing.responses import eigenmodes, solve_static
    from fmu_asset.door.session import FmiAsset
    from fmu_asset.packing.structure_fmu import build_fmu
    from scenarios import structure_files
    from twin_master.environment import ScenarioEnvironment
    from twin_master.fleet.flight import fly_fleet
    from twin_master.fleet.lessons import learn_from_fleet
    from twin_master.fleet.reading import fleet_groups as open_fleet
    from twin_master.learning.monitor import WatchfulEstimator
    from twin_master.mission.preparation import prepare_twin
    from twin_master.network.estimator import Carried, Estimate, ExactFilter
    from twin_master.network.graphical_model import GraphicalModel
    from twin_master.network.inference import filter_sequence
    from twin_master.network.planner import value_iteration
    from twin_master.network.sensor_model import GaussianSensorModel
    from twin_master.network.twin import Twin
    from twin_master.report.page import report_figures, write_report
    from twin_master.scenario.reading import load_scenario
    from twin_master.watch.opening import open_run, watch
    from twin_master.workflow import new_run as fly
    from twin_master.workflow import resume_run as resume

__all__ = [
    "Carried",
    "Estimate",
    "ExactFilter",
    "FmiAsset",
    "GaussianSensorModel",
    "GraphicalModel",
    "ScenarioEnvironment",
    "Twin",
    "WatchfulEstimator",
    "apply_verdict",
    "assemble",
    "assemble_structure",
    "build_fmu",
    "calibrate",
    "eigenmodes",
    "filter_sequence",
    "fly",
    "fly_fleet",
    "identify_modes",
    "investigate",
    "learn_from_fleet",
    "load_calibration",
    "load_design",
    "load_model",
    "load_scenario",
    "natural_frequencies",
    "open_fleet",
    "open_run",
    "prepare_twin",
    "read_campaign",
    "read_verdict",
    "reduced_model",
    "reduced_structure",
    "report_figures",
    "resume",
    "solve_static",
    "static_responses",
    "structure_files",
    "value_iteration",
    "watch",
    "write_report",
]

_HOMES = {
    "Carried": "twin_master.network.estimator",
    "Estimate": "twin_master.network.estimator",
    "ExactFilter": "twin_master.network.estimator",
    "FmiAsset": "fmu_asset.door.session",
    "GaussianSensorModel": "twin_master.network.sensor_model",
    "GraphicalModel": "twin_master.network.graphical_model",
    "ScenarioEnvironment": "twin_master.environment",
    "Twin": "twin_master.network.twin",
    "WatchfulEstimator": "twin_master.learning.monitor",
    "apply_verdict": "discrepancy.application",
    "assemble": "fe.wing.operators",
    "assemble_structure": "fe.structure.operators:load_any",
    "build_fmu": "fmu_asset.packing.structure_fmu",
    "calibrate": "calibration.wing.calibrate:calibrate_wing",
    "eigenmodes": "fe.wing.responses",
    "filter_sequence": "twin_master.network.inference",
    "fly": "twin_master.workflow:new_run",
    "fly_fleet": "twin_master.fleet.flight",
    "identify_modes": "calibration.dynamics.modal_identification",
    "investigate": "discrepancy.workflow",
    "learn_from_fleet": "twin_master.fleet.lessons",
    "load_calibration": "calibration.result.file",
    "load_design": "fe.wing.design",
    "load_model": "discrepancy.model_choice",
    "load_scenario": "twin_master.scenario.reading",
    "natural_frequencies": "fe.structure.field",
    "open_fleet": "twin_master.fleet.reading:fleet_groups",
    "open_run": "twin_master.watch.opening",
    "prepare_twin": "twin_master.mission.preparation",
    "read_campaign": "discrepancy.campaign.reading",
    "read_verdict": "discrepancy.files.verdict:read_verdict_folder",
    "reduced_model": "fe.reduction.model_cache",
    "reduced_structure": "fe.reduction.model_cache",
    "report_figures": "twin_master.report.page",
    "resume": "twin_master.workflow:resume_run",
    "solve_static": "fe.wing.responses",
    "static_responses": "fe.structure.field",
    "structure_files": "scenarios",
    "value_iteration": "twin_master.network.planner",
    "watch": "twin_master.watch.opening",
    "write_report": "twin_master.report.page",
}
"""Module of each name; behind a colon what it is called there, where that differs."""


def __getattr__(name: str) -> Any:
    """Import a name of `__all__` when it is first used."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; it has {', '.join(__all__)}")
    from uav_twin.shadowing import refuse_shadowing

    refuse_shadowing()
    module, _, own_name = _HOMES[name].partition(":")
    found = globals()[name] = getattr(import_module(module), own_name or name)
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
