"""Scenario files of format 1, in which `[asset]` said both what flies and what the twin believes."""

from collections.abc import Mapping
from typing import Any

from twin_master.scenario.asset import CALIBRATED_DESIGN_NAME

_OF_SEVERAL = ("component", "connection", "algorithm", "iterations", "tolerance")
_OF_FMUS = ("binding", "isolated", "step_timeout", "parameters", "load", "seeds")


def from_format_1(table: Mapping[str, Any]) -> dict[str, Any]:
    """Return a table of format 1 as one of format 2; what is wrong with it stays wrong."""
    given = table.get("asset")
    if not isinstance(given, Mapping):
        return {**table, "format": 2}
    asset = {key: value for key, value in given.items() if value not in (None, [], (), {})}
    believed, library = asset.pop("observation_model", None), asset.pop("library", None)
    design, effects = asset.pop("design", None), asset.pop("model_patch", None)
    kind = asset.pop("kind", "fmu")
    flown: dict[str, Any] = {}
    if kind == "fmu":
        kind = "fmu" if "file" in asset else "script" if "script" in asset else "design"
        flown = _of_design(design) if kind == "design" else {}
    elif kind == "coupled" and "file" in asset:
        kind = "ssp"
    if kind not in ("coupled", "ssp"):
        asset = {key: value for key, value in asset.items() if key not in _OF_SEVERAL}
    if kind == "strain_library":
        asset = {key: value for key, value in asset.items() if key not in _OF_FMUS}
    belief: dict[str, Any] = {"kind": "asset"}
    if library is not None or believed == "library":
        belief = {"kind": "library", "file": library, "design": design}
    elif believed == "design" or (design is not None and believed is None):
        belief = _of_design(design)
    if effects is not None:
        belief["patch"] = effects
    return {**table, "format": 2, "asset": {"kind": kind} | asset | flown, "belief": belief}


def _of_design(design: object) -> dict[str, Any]:
    if design == CALIBRATED_DESIGN_NAME:
        return {"kind": "calibration"}
    return {"kind": "design"} | ({} if design is None else {"design": design})
