"""A predictive structural digital twin of a UAV wing: the one name to import.

Each name comes from the package that holds it, and is imported when it is used, so that
`import uav_twin` takes no time. `docs/reference/python.md` shows all of them at work; the command
line is `uav-twin`.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from uav_twin.shadowing import refuse_shadowing

if TYPE_CHECKING:  # the names as type checkers and editors read them
    from calibration.dynamics.modal_identification import identify_modes as identify_modes
    from calibration.result.file import load_calibration as load_calibration
    from calibration.wing.calibrate import calibrate as calibrate
    from discrepancy.application import apply_verdict as apply_verdict
    from discrepancy.campaign.reading import read_campaign as read_campaign
    from discrepancy.files.verdict import read_verdict as read_verdict
    from discrepancy.model_choice import load_model as load_model
    from discrepancy.parameters.calibration import calibrate_parameters as calibrate_parameters
    from discrepancy.pictures import plot_missing_force as plot_missing_force
    from discrepancy.workflow import investigate as investigate
    from fe.reduction.model_cache import reduced_model as reduced_model
    from fe.structure.affine import natural_frequencies as natural_frequencies
    from fe.structure.affine import static_response as static_response
    from fe.structure.affine import static_responses as static_responses
    from fe.wing.design import load_design as load_design
    from fe.wing.operators import assemble as assemble
    from fe.wing.operators import flapwise_bending_modes as flapwise_bending_modes
    from fmu_asset.client.session import FmiAsset as FmiAsset
    from fmu_asset.packing.structure_fmu import build_fmu as build_fmu
    from reporting.progress import Progress as Progress
    from scenarios import structure_files as structure_files
    from twin_master.assets.resolution import Overrides as Overrides
    from twin_master.environment import ScenarioEnvironment as ScenarioEnvironment
    from twin_master.fleet.engine import Engine as Engine
    from twin_master.fleet.flight import fly_fleet as fly_fleet
    from twin_master.fleet.learning.learn import learn_from_fleet as learn_from_fleet
    from twin_master.fleet.plan import ensemble as ensemble
    from twin_master.fleet.reading import open_fleet as open_fleet
    from twin_master.gauges.gauge_watch import WatchfulEstimator as WatchfulEstimator
    from twin_master.mission.preparation import prepare_twin as prepare_twin
    from twin_master.network.estimator import Carried as Carried
    from twin_master.network.estimator import Estimate as Estimate
    from twin_master.network.estimator import Estimator as Estimator
    from twin_master.network.estimator import Learnt as Learnt
    from twin_master.network.estimator import Notice as Notice
    from twin_master.network.estimator import NoticeWording as NoticeWording
    from twin_master.network.estimator import SensorModel as SensorModel
    from twin_master.network.graphical_model import GraphicalModel as GraphicalModel
    from twin_master.network.inference import ExactFilter as ExactFilter
    from twin_master.network.inference import filter_sequence as filter_sequence
    from twin_master.network.planner import BeliefPolicy as BeliefPolicy
    from twin_master.network.planner import Hold as Hold
    from twin_master.network.planner import RiskPolicy as RiskPolicy
    from twin_master.network.planner import value_iteration as value_iteration
    from twin_master.network.sensor_model import GaussianSensorModel as GaussianSensorModel
    from twin_master.network.twin import Twin as Twin
    from twin_master.pictures import plot_belief as plot_belief
    from twin_master.pictures import plot_residuals as plot_residuals
    from twin_master.report.page import report_figures as report_figures
    from twin_master.report.page import write_report as write_report
    from twin_master.scenario.reading import load_scenario as load_scenario
    from twin_master.scenario.tables import Noticing as Noticing
    from twin_master.watch.cause_search import CauseSearch as CauseSearch
    from twin_master.watch.cause_search import RunningSearch as RunningSearch
    from twin_master.watch.cause_search import SearchRequest as SearchRequest
    from twin_master.watch.workflow import open_run as open_run
    from twin_master.workflow import fly as fly
    from twin_master.workflow import resume as resume
    from uav_twin.watching import watch as watch

_HOMES = {
    "identify_modes": "calibration.dynamics.modal_identification",
    "load_calibration": "calibration.result.file",
    "calibrate": "calibration.wing.calibrate",
    "apply_verdict": "discrepancy.application",
    "read_campaign": "discrepancy.campaign.reading",
    "read_verdict": "discrepancy.files.verdict",
    "load_model": "discrepancy.model_choice",
    "calibrate_parameters": "discrepancy.parameters.calibration",
    "plot_missing_force": "discrepancy.pictures",
    "investigate": "discrepancy.workflow",
    "reduced_model": "fe.reduction.model_cache",
    "natural_frequencies": "fe.structure.affine",
    "static_response": "fe.structure.affine",
    "static_responses": "fe.structure.affine",
    "load_design": "fe.wing.design",
    "assemble": "fe.wing.operators",
    "flapwise_bending_modes": "fe.wing.operators",
    "FmiAsset": "fmu_asset.client.session",
    "build_fmu": "fmu_asset.packing.structure_fmu",
    "Progress": "reporting.progress",
    "structure_files": "scenarios",
    "Overrides": "twin_master.assets.resolution",
    "ScenarioEnvironment": "twin_master.environment",
    "Engine": "twin_master.fleet.engine",
    "fly_fleet": "twin_master.fleet.flight",
    "learn_from_fleet": "twin_master.fleet.learning.learn",
    "ensemble": "twin_master.fleet.plan",
    "open_fleet": "twin_master.fleet.reading",
    "WatchfulEstimator": "twin_master.gauges.gauge_watch",
    "prepare_twin": "twin_master.mission.preparation",
    "Carried": "twin_master.network.estimator",
    "Estimate": "twin_master.network.estimator",
    "Estimator": "twin_master.network.estimator",
    "ExactFilter": "twin_master.network.inference",
    "Learnt": "twin_master.network.estimator",
    "Notice": "twin_master.network.estimator",
    "NoticeWording": "twin_master.network.estimator",
    "SensorModel": "twin_master.network.estimator",
    "GraphicalModel": "twin_master.network.graphical_model",
    "filter_sequence": "twin_master.network.inference",
    "BeliefPolicy": "twin_master.network.planner",
    "Hold": "twin_master.network.planner",
    "RiskPolicy": "twin_master.network.planner",
    "value_iteration": "twin_master.network.planner",
    "GaussianSensorModel": "twin_master.network.sensor_model",
    "Twin": "twin_master.network.twin",
    "plot_belief": "twin_master.pictures",
    "plot_residuals": "twin_master.pictures",
    "report_figures": "twin_master.report.page",
    "write_report": "twin_master.report.page",
    "load_scenario": "twin_master.scenario.reading",
    "Noticing": "twin_master.scenario.tables",
    "CauseSearch": "twin_master.watch.cause_search",
    "RunningSearch": "twin_master.watch.cause_search",
    "SearchRequest": "twin_master.watch.cause_search",
    "open_run": "twin_master.watch.workflow",
    "fly": "twin_master.workflow",
    "resume": "twin_master.workflow",
    "watch": "uav_twin.watching",
}
"""The module of each public name; a test compares these names with the imports above."""

__all__ = list(_HOMES)


def __dir__() -> list[str]:
    """Return the public names, so that completion in a notebook offers nothing else."""
    return sorted(__all__)


if not TYPE_CHECKING:  # so that type checkers report names that do not exist

    def __getattr__(name: str) -> Any:
        """Return the object with a public name, importing its module at the first use."""
        if name not in _HOMES:
            raise AttributeError(
                f"module 'uav_twin' has no attribute {name!r}; it has {', '.join(__all__)}"
            )
        refuse_shadowing()
        return getattr(import_module(_HOMES[name]), name)
