"""The file of a calibration of parameters: NetCDF-4, sufficient by itself.

Groups `prior` and `posterior` hold the samples of each parameter with its unit; the root's attributes hold
priors, residuals, findings and provenance.
"""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from calibration.errors import CalibrationError, CalibrationRecordError
from calibration.parameters.result import ChannelFit, ParameterCalibration, ParameterPrior
from calibration.samples.file import (
    PRIOR_SAMPLE,
    SAMPLE,
    check_content,
    check_schema,
    file_bytes,
    json_text,
    read_file,
    samples_dataset,
    samples_of,
)
from reporting.record_json import record_of

SCHEMA = "uav-twin parameter calibration 1"
"""Value of the attribute `schema` of the root."""


def result_bytes(result: ParameterCalibration) -> bytes:
    """Return the content of the file of a calibration; equal calibrations give equal bytes."""
    table = result.calibrated
    groups = {
        "prior": samples_dataset(table.figures, table.prior, PRIOR_SAMPLE, "prior sample of "),
        "posterior": samples_dataset(table.figures, table.samples, SAMPLE, "posterior sample of "),
    }
    root: dict[str, Any] = {
        "schema": SCHEMA,
        "title": f"Calibration of {result.asset}",
        "asset": result.asset,
        "model": result.model,
        "model_hash": result.model_hash,
        "design_hash": result.design_hash,
        "procedure": result.procedure,
        "explained": json_text(result.explained),
        "campaign": result.source,
        "seed": result.seed,
        "parameters": json_text([asdict(item) for item in result.priors]),
        "channels": json_text([asdict(item) for item in result.channels]),
        "findings": json_text(list(result.findings)),
        "provenance": json_text(dict(result.provenance)),
    }
    return file_bytes(groups, root)


def load_parameters(path: Path | str) -> ParameterCalibration:
    """Read the calibration that `result_bytes` made.

    Raises
    ------
    CalibrationRecordError
        If the file is missing, damaged, cut off, of another kind or of another schema; one sentence.
    """
    path = Path(path)
    groups, root = read_file(path)
    check_schema(path, root, SCHEMA)
    try:
        check_content(groups, root)
        priors = tuple(record_of(ParameterPrior, item) for item in json.loads(root["parameters"]))
        figures = tuple(item.figure for item in priors)
        return ParameterCalibration(
            asset=str(root["asset"]),
            model=str(root["model"]),
            model_hash=str(root["model_hash"]),
            procedure=root["procedure"],
            priors=priors,
            samples=samples_of(groups["posterior"], figures),
            prior_samples=samples_of(groups["prior"], figures),
            explained=json.loads(root["explained"]),
            findings=tuple(json.loads(root["findings"])),
            channels=tuple(record_of(ChannelFit, item) for item in json.loads(root["channels"])),
            source=str(root["campaign"]),
            seed=int(root["seed"]),
            provenance=json.loads(root["provenance"]),
            design_hash=str(root["design_hash"]),
        )
    except CalibrationError as error:
        reason = str(error).rstrip(".")
    except (KeyError, TypeError, AttributeError, ValueError, IndexError) as error:
        reason = f"{type(error).__name__}: {error}"
    raise CalibrationRecordError(f"{path} is damaged ({reason}); calibrate again.")
