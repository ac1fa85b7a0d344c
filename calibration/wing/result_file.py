"""The file of a calibration: NetCDF-4, one for each wing, sufficient by itself.

Groups `prior`, `posterior`, `geometry`, `quantity_of_interest` and `measured` hold labelled arrays with
units; the root's attributes hold the name of the wing, the tailored design, the steps and the provenance.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from calibration.errors import CalibrationError, CalibrationRecordError
from calibration.geometry import LENGTH_NAMES, GeometryCalibration, MeasuredLength
from calibration.joint import ModalMeasurement, WeighedMass
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
    variable,
)
from calibration.static.experiments import LoadDisplacementData
from fe.runtime.errors import InvalidDesignError
from fe.wing.design import parse_design
from reporting.files import atomic_write_bytes
from reporting.record_json import record_of

from .result import QUANTITIES, STATE, CalibrationResult
from .steps import CalibrationStep

SCHEMA = "uav-twin wing calibration 1"
"""Value of the attribute `schema` of the root."""

_MODES = ("first", "second")


def save_calibration(result: CalibrationResult, path: Path | str) -> Path:
    """Write a calibration, whole or not at all; equal calibrations give equal bytes.

    Raises
    ------
    reporting.errors.FileNotWrittenError
        If the file cannot be written.
    """
    return atomic_write_bytes(Path(path), result_bytes(result))


def result_bytes(result: CalibrationResult) -> bytes:
    """Return the content of the file of a calibration."""
    return file_bytes(*_content(result))


def load_calibration(path: Path | str) -> CalibrationResult:
    """Read the calibration that `save_calibration` wrote.

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
        return _result(groups, root)
    except (CalibrationError, InvalidDesignError) as error:
        reason = str(error).rstrip(".")
    except (KeyError, TypeError, AttributeError, ValueError, IndexError) as error:
        reason = f"{type(error).__name__}: {error}"
    raise CalibrationRecordError(f"{path} is damaged ({reason}); calibrate again.")


def _content(result: CalibrationResult) -> tuple[dict[str, xr.Dataset], dict[str, Any]]:
    groups = {
        "prior": samples_dataset(STATE, result.prior_samples, PRIOR_SAMPLE, "prior sample of the "),
        "posterior": samples_dataset(STATE, result.samples, SAMPLE, "posterior sample of the "),
        "geometry": _geometry(result.geometry),
        "quantity_of_interest": xr.merge(
            [
                samples_dataset(QUANTITIES, result.quantity_samples, SAMPLE, "at the posterior samples, "),
                samples_dataset(
                    QUANTITIES,
                    result.prior_quantity_samples,
                    PRIOR_SAMPLE,
                    "at the prior samples, ",
                    "prior_",
                ),
            ]
        ),
        "measured": _measured(result),
    }
    root: dict[str, Any] = {
        "schema": SCHEMA,
        "title": f"Calibration of {result.asset}",
        "asset": result.asset,
        "procedure": result.procedure,
        "seed": result.seed,
        "design_hash": result.design_hash,
        "design": json_text(result.design.model_dump(mode="json")),
        "geometry_source": result.geometry.source,
        "load_test_source": result.pairs.source,
        "ring_down_source": result.modal.source,
        "steps": json_text([asdict(step) for step in result.steps]),
        "provenance": json_text(dict(result.provenance)),
    }
    return groups, root


_LENGTH_FIGURES = {
    "designed": "length on the drawing, mean of the prior",
    "tolerance": "half-width of the 95 % interval of the prior",
    "measured": "length on the wing",
    "reading_uncertainty": "half-width of the 95 % interval of the measurement",
}


def _geometry(geometry: GeometryCalibration) -> xr.Dataset:
    lengths = geometry.lengths
    table = {
        name: variable("length", [getattr(length, name) for length in lengths], "m", title)
        for name, title in _LENGTH_FIGURES.items()
    }
    posterior = [length.posterior for length in lengths]
    table["mean"] = variable("length", [item.mean for item in posterior], "m", "posterior mean")
    table["standard_deviation"] = variable(
        "length", [item.standard_deviation for item in posterior], "m", "posterior standard deviation"
    )
    return xr.Dataset(table, coords={"length": list(LENGTH_NAMES)})


def _measured(result: CalibrationResult) -> xr.Dataset:
    pairs, modal = result.pairs, result.modal
    table: dict[str, tuple[Any, Any, dict[str, str]]] = {
        "load": variable("pair", pairs.load, "N", "tip load"),
        "displacement": variable("pair", pairs.displacement, "m", "tip displacement"),
        "run": variable("pair", pairs.run.astype(np.int64), "1", "loading run, from 0"),
        "load_standard_deviation": variable(
            "pair", np.full(pairs.count, pairs.load_standard_deviation), "N", "of a reading"
        ),
        "displacement_standard_deviation": variable(
            "pair", np.full(pairs.count, pairs.displacement_standard_deviation), "m", "of a reading"
        ),
    }
    mass = result.total_mass
    table["total_mass"] = (
        (),
        mass.mass,
        {"units": "kg", "long_name": "two servos and the pitot tube, weighed"},
    )
    table["total_mass_standard_deviation"] = (
        (),
        mass.standard_deviation,
        {"units": "kg", "long_name": "of the weighing"},
    )
    for name, unit in (("frequency", "Hz"), ("damping_ratio", "1")):
        title = name.replace("_", " ")
        table[name] = variable("mode", getattr(modal, name), unit, f"{title} of a flapwise bending mode")
        deviation = getattr(modal, f"{name}_standard_deviation")
        table[f"{name}_standard_deviation"] = variable("mode", deviation, unit, f"of the measured {title}")
    return xr.Dataset(table, coords={"mode": list(_MODES)})


def _result(groups: Mapping[str, xr.Dataset], root: Mapping[str, Any]) -> CalibrationResult:
    lengths, measured, quantities = groups["geometry"], groups["measured"], groups["quantity_of_interest"]
    design = parse_design(json.loads(root["design"]), "the design in it")
    if design.hash != root["design_hash"]:
        raise CalibrationRecordError("its design does not match its hash")
    figures = {name: lengths[name].values.tolist() for name in _LENGTH_FIGURES}
    span, root_chord, tip_chord = (
        MeasuredLength(name, **{key: values[index] for key, values in figures.items()})
        for index, name in enumerate(LENGTH_NAMES)
    )
    return CalibrationResult(
        asset=str(root["asset"]),
        design=design,
        geometry=GeometryCalibration(span, root_chord, tip_chord, source=str(root["geometry_source"])),
        procedure=root["procedure"],
        samples=samples_of(groups["posterior"], STATE),
        prior_samples=samples_of(groups["prior"], STATE),
        quantity_samples=samples_of(quantities, QUANTITIES),
        prior_quantity_samples=samples_of(quantities, QUANTITIES, "prior_"),
        pairs=LoadDisplacementData(
            load=measured["load"].values,
            displacement=measured["displacement"].values,
            run=measured["run"].values,
            load_standard_deviation=float(measured["load_standard_deviation"].values[0]),
            displacement_standard_deviation=float(measured["displacement_standard_deviation"].values[0]),
            source=str(root["load_test_source"]),
        ),
        total_mass=WeighedMass(
            float(measured["total_mass"]), float(measured["total_mass_standard_deviation"])
        ),
        modal=ModalMeasurement(
            frequency=_pair(measured["frequency"]),
            frequency_standard_deviation=_pair(measured["frequency_standard_deviation"]),
            damping_ratio=_pair(measured["damping_ratio"]),
            damping_ratio_standard_deviation=_pair(measured["damping_ratio_standard_deviation"]),
            source=str(root["ring_down_source"]),
        ),
        steps=tuple(record_of(CalibrationStep, step) for step in json.loads(root["steps"])),
        seed=int(root["seed"]),
        provenance=json.loads(root["provenance"]),
    )


def _pair(variable: xr.DataArray) -> tuple[float, float]:
    first, second = variable.values.tolist()
    return first, second
