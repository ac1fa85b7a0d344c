"""A wing as its calibration describes it: what its FMU carries, and the record of a run."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from calibration.samples.moments import drawn_record, moments, sampled_record
from calibration.wing.result import STATE, CalibrationResult
from calibration.wing.result_file import result_bytes
from fe.runtime.state import DigitalState
from reporting.provenance import hash_bytes

RESOURCE_NAME = "calibration.json"
"""The file among the FMU's resources that says what the wing was calibrated with."""

SCHEMA = "uav-twin calibrated wing 1"


@dataclass(frozen=True)
class WingTailoring:
    """What an FMU takes of the calibration of a wing.

    Attributes
    ----------
    state : DigitalState
        Means of the samples of e, masses and damping.
    note : str
        Name of the wing and the standard deviations, for the description.
    resources : dict of str to bytes
        `RESOURCE_NAME`: the figures with intervals and correlations.
    """

    state: DigitalState
    note: str
    resources: Mapping[str, bytes]


def tailoring(calibration: CalibrationResult) -> WingTailoring:
    """Return what the FMU of a calibrated wing carries; equal input gives equal bytes."""
    text = json.dumps(
        calibrated_wing(calibration), indent=1, sort_keys=True, ensure_ascii=False, allow_nan=False
    )
    record = {RESOURCE_NAME: f"{text}\n".encode()}
    return WingTailoring(calibration.mean_state(), description(calibration), record)


def description(calibration: CalibrationResult) -> str:
    """Return one sentence with the name of the wing and its figures, mean and standard deviation."""
    figures = ", ".join(
        f"{entry.name} {calibration.mean(entry.name):.6g} +- {calibration.standard_deviation(entry.name):.3g}"
        + ("" if entry.unit == "1" else f" {entry.unit}")
        for entry in STATE
    )
    return f"Calibrated for the wing '{calibration.asset}' (mean +- standard deviation): {figures}."


def calibrated_wing(calibration: CalibrationResult) -> dict[str, Any]:
    """Return the figures of a calibration as plain data, ready for JSON."""
    return {
        "schema": SCHEMA,
        "asset": calibration.asset,
        "procedure": calibration.procedure,
        "seed": calibration.seed,
        "samples": len(calibration.samples),
        "design_hash": calibration.design_hash,
        "calibration_sha256": hash_bytes(result_bytes(calibration)),
        **sampled_record(calibration),
        "geometry_m": {
            length.name: {
                "mean": length.posterior.mean,
                "standard_deviation": length.posterior.standard_deviation,
            }
            for length in calibration.geometry.lengths
        },
        "sources": {
            "geometry": calibration.geometry.source,
            "load_test": calibration.pairs.source,
            "ring_down": calibration.modal.source,
        },
    }


def run_record(calibration: CalibrationResult, parameter: str) -> dict[str, Any]:
    """Return what `calibration.json` of a run folder holds: the wing, and the parameter drawn by the twin."""
    stiffness = calibration.draws_of("tip_stiffness")
    return {
        **calibrated_wing(calibration),
        **drawn_record(calibration, parameter),
        "tip_stiffness": {"unit": "N/m", **moments(stiffness)},
        "data": {
            "source": calibration.pairs.source,
            "load_N": calibration.pairs.load.tolist(),
            "displacement_m": calibration.pairs.displacement.tolist(),
        },
    }
