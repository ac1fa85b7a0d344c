"""A calibration of either kind, read from its file, and what the record of a run keeps of it."""

from pathlib import Path
from typing import Any

from calibration.parameters import result_file as of_parameters
from calibration.parameters.result import ParameterCalibration
from calibration.samples.file import check_schema, read_file
from calibration.samples.moments import drawn_record, sampled_record
from calibration.wing import result_file as of_wing
from calibration.wing.result import CalibrationResult
from calibration.wing.wing_record import run_record as wing_run_record


def load_calibration(path: Path | str) -> CalibrationResult | ParameterCalibration:
    """Read the `calibration.nc` of a wing, or of the parameters of any model.

    Raises
    ------
    CalibrationRecordError
        If the file is missing, damaged, cut off, of another kind or of another schema; one sentence.
    """
    path = Path(path)
    _, root = read_file(path)
    check_schema(path, root, of_wing.SCHEMA, of_parameters.SCHEMA)
    if root["schema"] == of_wing.SCHEMA:
        return of_wing.load_calibration(path)
    return of_parameters.load_parameters(path)


def run_record(calibration: CalibrationResult | ParameterCalibration, parameter: str) -> dict[str, Any]:
    """Return what `calibration.json` of a run folder holds, with the parameter that the twin draws."""
    if isinstance(calibration, CalibrationResult):
        return wing_run_record(calibration, parameter)
    return {
        "schema": of_parameters.SCHEMA,
        "asset": calibration.asset,
        "procedure": calibration.procedure,
        "seed": calibration.seed,
        "samples": len(calibration.samples),
        "model": calibration.model,
        "campaign": calibration.source,
        "findings": list(calibration.findings),
        **sampled_record(calibration),
        **drawn_record(calibration, parameter),
    }
