"""A calibration of either kind: reading, the folder that it is written to, and the record of a run."""

from pathlib import Path
from typing import Any

from calibration.errors import CalibrationRecordError
from calibration.parameters import result_file as of_parameters
from calibration.parameters.result import ParameterCalibration
from calibration.samples.file import FILE_NAME, check_schema, read_file
from calibration.samples.moments import drawn_record, sampled_record
from calibration.wing import result_file as of_wing
from calibration.wing.result import CalibrationResult
from calibration.wing.wing_record import run_record as wing_run_record
from reporting.errors import FileNotWrittenError

AnyCalibration = CalibrationResult | ParameterCalibration

_PROCEDURES: dict[type[AnyCalibration], str] = {
    CalibrationResult: "from the laboratory of a wing (`uav-twin calibrate`)",
    ParameterCalibration: "from a campaign (`uav-twin calibrate campaign`)",
}


def load_calibration(path: Path | str) -> AnyCalibration:
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


def check_folder(folder: Path, asset: str, kind: type[AnyCalibration]) -> None:
    """Look at the place where a calibration of `asset` is to be written, before the work begins.

    Raises
    ------
    FileNotWrittenError
        If it is no folder, or holds the calibration of another asset or of another kind. A file that is no
        calibration of either kind may be replaced.
    """
    if folder.exists() and not folder.is_dir():
        raise FileNotWrittenError(f"{folder} exists and is no folder: choose another --out.")
    kept = folder / FILE_NAME
    if not kept.exists():
        return
    try:
        found = load_calibration(kept)
    except CalibrationRecordError:
        return  # what cannot be read is of no use to anyone
    if found.asset != asset:
        raise FileNotWrittenError(
            f"{kept} is the calibration of {found.asset}, not of {asset}: choose another --out, one for each "
            "asset."
        )
    if not isinstance(found, kind):
        raise FileNotWrittenError(
            f"{kept} is the calibration of {asset} {_PROCEDURES[type(found)]}, and one "
            f"{_PROCEDURES[kind]} was asked for: choose another --out, one for each kind of calibration."
        )


def run_record(calibration: AnyCalibration, parameter: str) -> dict[str, Any]:
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
        "design_hash": calibration.design_hash,
        "campaign": calibration.source,
        "findings": list(calibration.findings),
        **sampled_record(calibration),
        **drawn_record(calibration, parameter),
        "prior": next(
            {"mean": item.mean, "standard_deviation": item.deviation, "range": [item.low, item.high]}
            for item in calibration.priors
            if item.name == parameter
        ),
    }
