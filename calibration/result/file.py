"""The file of a calibration: self-contained NetCDF-4 in the layout of ArviZ.

The groups `posterior` and `prior` hold samples of each quantity by (chain, draw) with its unit, and
`observed_data` the measurements that are arrays. The attributes of the root hold priors, readings,
residuals, findings, provenance and, for a wing, its tailored design.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import fields
from functools import lru_cache
from pathlib import Path
from typing import Any, TypedDict, get_type_hints

import numpy as np
import xarray as xr
from pydantic import TypeAdapter

from calibration.errors import CalibrationError, CalibrationRecordError
from calibration.result.record import FROM_CAMPAIGN, FROM_LABORATORY, STATE, Calibration
from fe.runtime.state import DigitalState
from reporting.arrays import Float
from reporting.errors import DamagedFileError, FileNotWrittenError
from reporting.files import atomic_write_bytes, hash_bytes
from reporting.formats.netcdf import read_groups
from reporting.words import one_line

FILE_NAME = "calibration.nc"
SCHEMA = "uav-twin calibration 2"
"""Value of the attribute `schema` of the root."""

_HASH = "content_sha256"
_PLAIN_FIELDS = ("asset", "model", "model_hash", "design_hash", "procedure", "source", "seed")
"""Fields of a calibration that are stored as attributes of the root without conversion."""
_ARRAY_FIELDS = ("samples", "prior_samples", "measured")
"""Fields of a calibration that are stored in groups."""
_JSON_FIELDS = {
    field.name: TypeAdapter(get_type_hints(Calibration)[field.name])
    for field in fields(Calibration)
    if field.name not in (*_PLAIN_FIELDS, *_ARRAY_FIELDS)
}
"""The other fields, with their pydantic adapters; they are stored as attributes in JSON."""
_NEWER_FIELDS = ("sensors",)
"""Fields that files of earlier versions lack; they then have their default."""

Groups = Mapping[str, xr.Dataset]
Root = Mapping[str, Any]


def save_calibration(calibration: Calibration, path: Path | str) -> Path:
    """Write the file of a calibration atomically; equal calibrations give equal bytes.

    Raises
    ------
    reporting.errors.FileNotWrittenError
        If the file cannot be written.
    """
    return atomic_write_bytes(Path(path), result_bytes(calibration))


def result_bytes(calibration: Calibration) -> bytes:
    """Return a calibration as the bytes of its NetCDF file, with a hash of its content."""
    groups = {
        "prior": _samples(calibration, calibration.prior_samples, "prior sample"),
        "posterior": _samples(calibration, calibration.samples, "posterior sample"),
        "observed_data": calibration.measured,
    }
    root = {"schema": SCHEMA, "title": f"Calibration of {calibration.asset}"}
    for name in _PLAIN_FIELDS:
        root[name] = getattr(calibration, name)
    for name, adapter in _JSON_FIELDS.items():
        root[name] = _json(adapter.dump_python(getattr(calibration, name), mode="json"))
    attributes = {**root, _HASH: _content_hash(groups, root)}
    tree = xr.DataTree.from_dict({"/": xr.Dataset(attrs=attributes), **groups})
    return bytes(tree.to_netcdf(engine="h5netcdf"))


def _samples(calibration: Calibration, values: Float, what: str) -> xr.Dataset:
    """Return samples (N, F) of all quantities as a dataset in the layout of ArviZ."""
    return xr.Dataset(
        {
            quantity.name: (
                ("chain", "draw"),
                column[None],
                {"units": quantity.unit, "long_name": f"{what} of {quantity.title}"},
            )
            for quantity, column in zip(calibration.all_quantities, values.T, strict=True)
        }
    )


def load_calibration(path: Path | str) -> Calibration:
    """Read a calibration, of a wing or of any model's parameters, from its file.

    Raises
    ------
    CalibrationRecordError
        If the file is missing, damaged, truncated, of another kind or of another schema.
    """
    path = Path(path)
    groups, root = _read(path)
    schema = root.get("schema")
    if schema != SCHEMA:
        kind = f"of the schema {str(schema)!r}" if schema else "not a calibration file"
        raise CalibrationRecordError(
            f"{path} is {kind}, but {SCHEMA!r} is needed; calibrate again with this version."
        )
    try:
        if root[_HASH] != _content_hash(groups, root):
            raise CalibrationRecordError("its content does not match its hash")
        return _calibration(groups, root)
    except CalibrationError as error:
        reason = str(error).rstrip(".")
    except (KeyError, TypeError, AttributeError, ValueError, IndexError) as error:
        reason = f"{type(error).__name__}: {one_line(error)}"
    raise CalibrationRecordError(f"{path} is damaged ({reason}); calibrate again.")


def check_folder(folder: Path, asset: str, *, wing: bool) -> None:
    """Check that a new calibration may be written to a folder, before its work begins.

    A file that is not a calibration may be replaced. `wing` says whether the new calibration is
    that of a wing from its laboratory.

    Raises
    ------
    FileNotWrittenError
        If the path is not a folder, or the folder holds the calibration of another asset or of
        another kind.
    """
    if folder.exists() and not folder.is_dir():
        raise FileNotWrittenError(f"{folder} exists and is not a folder: choose another --out.")
    file = folder / FILE_NAME
    try:
        existing = load_calibration(file)
    except CalibrationRecordError:
        return  # there is none, or it cannot be read by anyone
    if existing.asset != asset:
        raise FileNotWrittenError(
            f"{file} is the calibration of {existing.asset}, not of {asset}: "
            "choose another --out, one for each asset."
        )
    existing_is_wing = existing.design is not None
    if existing_is_wing != wing:
        existing_kind = FROM_LABORATORY if existing_is_wing else FROM_CAMPAIGN
        new_kind = FROM_LABORATORY if wing else FROM_CAMPAIGN
        raise FileNotWrittenError(
            f"{file} is the calibration of {asset} {existing_kind}, but one {new_kind} was asked "
            "for: choose another --out, one for each kind of calibration."
        )


def _calibration(groups: Groups, root: Root) -> Calibration:
    """Build a calibration from the groups and the root attributes of a file."""
    values: dict[str, Any] = {}
    for name, adapter in _JSON_FIELDS.items():
        if name in root or name not in _NEWER_FIELDS:
            values[name] = adapter.validate_json(root[name])
    for name in _PLAIN_FIELDS:
        values[name] = root[name]
    values["seed"] = int(root["seed"])
    names = [quantity.name for quantity in (*values["priors"], *values["quantities"])]
    calibration = Calibration(
        **values,
        samples=_sample_columns(groups["posterior"], names),
        prior_samples=_sample_columns(groups["prior"], names),
        measured=groups["observed_data"],
    )
    design = calibration.design
    if design is not None and design.hash != calibration.design_hash:
        raise CalibrationRecordError("its design does not match its hash")
    return calibration


def _sample_columns(group: xr.Dataset, names: list[str]) -> Float:
    """Return the samples (N, F) of named quantities in a group."""
    return np.column_stack([group[name].values[0] for name in names])


def _read(path: Path) -> tuple[Groups, Root]:
    """Return the groups and the root attributes of a calibration file."""
    if not path.is_file():
        state = "not a file" if path.exists() else "missing"
        raise CalibrationRecordError(
            f"{path} is {state}; give the {FILE_NAME} that `uav-twin calibrate --out DIR` leaves."
        )
    try:
        tree = _tree(path, hashlib.sha256(path.read_bytes()).digest())
    except DamagedFileError as error:
        raise CalibrationRecordError(
            f"{path} is damaged or is not a calibration file: it cannot be read as NetCDF; "
            "calibrate again."
        ) from error
    groups = {name: tree[name].to_dataset() for name in tree.children}
    return groups, {str(name): value for name, value in tree.attrs.items()}


@lru_cache(maxsize=8)
def _tree(path: Path, content: bytes) -> xr.DataTree:
    """Read the groups of a file, cached by path and SHA-256 of the content.

    A run reads the same calibration some twenty times.
    """
    return read_groups(path)


def _json(content: object) -> str:
    """Return plain data as JSON with sorted keys."""
    return json.dumps(content, sort_keys=True, ensure_ascii=False)


def _content_hash(groups: Groups, root: Root) -> str:
    """Return a SHA-256 of all values and attributes of a calibration file, to detect damage."""
    digest = hashlib.sha256()
    for name in sorted(set(root) - {_HASH}):
        digest.update(f"{name}\0{root[name]}\0".encode())
    for group in sorted(groups):
        for label, variable in sorted(
            groups[group].variables.items(), key=lambda item: str(item[0])
        ):
            values = np.asarray(variable.values)
            kind = "f" if values.dtype.kind == "f" else "i"
            digest.update(f"{group}/{label}\0{values.shape}\0{kind}\0".encode())
            digest.update(np.ascontiguousarray(values, "<f8" if kind == "f" else "<i8").tobytes())
            digest.update(
                _json({str(key): str(value) for key, value in variable.attrs.items()}).encode()
            )
    return digest.hexdigest()


RESOURCE_NAME = "calibration.json"
"""The file among the FMU's resources that describes the calibration of the wing."""

_GRID_POINTS = 401


class Tailoring(TypedDict, total=False):
    """Arguments of `pack_wing` (`fmu_asset`) for the FMU of a calibrated wing."""

    state: DigitalState
    note: str
    resources: Mapping[str, bytes]


def tailoring(calibration: Calibration) -> Tailoring:
    """Return the arguments of `pack_wing` (`fmu_asset`) for the FMU of a calibrated wing.

    The FMU starts at the posterior means of e, masses and damping. Its description contains the
    name of the wing and the standard deviations. Its file `RESOURCE_NAME` contains all quantities
    with intervals and correlations. Equal calibrations give equal bytes.
    """
    record_text = json.dumps(
        plain_record(calibration), indent=1, sort_keys=True, ensure_ascii=False, allow_nan=False
    )
    resources = {RESOURCE_NAME: f"{record_text}\n".encode()}
    return {
        "state": calibration.mean_state(),
        "note": description(calibration),
        "resources": resources,
    }


def description(calibration: Calibration) -> str:
    """Return a sentence with the wing's name, and means and standard deviations of its state."""
    texts = []
    for quantity in calibration.all_quantities:
        if quantity.name in STATE:
            mean = calibration.mean(quantity.name)
            deviation = calibration.standard_deviation(quantity.name)
            text = f"{quantity.name} {mean:.6g} +- {deviation:.3g} {quantity.printed_unit}"
            texts.append(text.rstrip())
    all_texts = ", ".join(texts)
    return (
        f"Calibrated for the wing '{calibration.asset}' (mean +- standard deviation): {all_texts}."
    )


def plain_record(calibration: Calibration) -> dict[str, object]:
    """Return a calibration as plain data: quantities with intervals, and correlations.

    The key `state` has the calibrated parameters, which have priors; `quantities` has the further
    quantities, which follow from them. `CalibrationRecord` describes all keys.
    """
    record_of_quantity = {
        quantity.name: {
            "title": quantity.title,
            "unit": quantity.unit,
            "mean": calibration.mean(quantity.name),
            "standard_deviation": calibration.standard_deviation(quantity.name),
            "interval_95": list(calibration.interval(quantity.name, 0.95)),
        }
        for quantity in calibration.all_quantities
    }
    # `all_quantities` are the parameters, then the quantities
    parameters = [prior.name for prior in calibration.priors]
    quantities = [quantity.name for quantity in calibration.quantities]
    field_names = ("asset", "procedure", "seed", "model", "design_hash")
    return {
        "schema": SCHEMA,
        **{name: getattr(calibration, name) for name in field_names},
        "samples": len(calibration.samples),
        "calibration_sha256": hash_bytes(result_bytes(calibration)),
        "campaign" if calibration.design is None else "laboratory": calibration.source,
        "findings": list(calibration.findings),
        "state": {name: record_of_quantity[name] for name in parameters},
        "quantities": {name: record_of_quantity[name] for name in quantities},
        "correlation": {"names": parameters, "matrix": calibration.correlation.tolist()},
        # JSON is written with sorted keys; pages list the quantities in the order of the
        # calibration.
        "names": {"quantities": quantities},
    }


def run_record(calibration: Calibration, parameter: str) -> dict[str, object]:
    """Return the content of `calibration.json` of a run folder.

    `parameter` is the parameter or quantity of which the twin has several values.
    """
    measured_tables = calibration.measured
    return {
        **plain_record(calibration),
        "parameter": parameter,
        "prior": _prior_record(calibration, parameter),
        "posterior": _density(calibration.draws_of(parameter)),
        "data": {str(name): measured_tables[name].values.tolist() for name in measured_tables},
    }


def _prior_record(calibration: Calibration, name: str) -> dict[str, object]:
    """Return the stated prior of a parameter, or the moments of a quantity in the prior samples."""
    for prior in calibration.priors:
        if prior.name == name:
            return {
                "mean": prior.mean,
                "standard_deviation": prior.deviation,
                "range": [prior.low, prior.high],
            }
    mean, deviation = calibration.prior_moments(name)
    return {"mean": mean, "standard_deviation": deviation}


def _density(values: Float) -> dict[str, list[float]]:
    """Return a Gaussian kernel density of samples (N,); empty if they do not vary."""
    deviation = float(values.std())
    if deviation <= 1e-12 * abs(float(values.mean())):
        return {}
    from scipy.stats import gaussian_kde  # takes a second to import

    grid = np.linspace(values.min() - deviation, values.max() + deviation, _GRID_POINTS)
    return {"grid": grid.tolist(), "density": gaussian_kde(values)(grid).tolist()}
