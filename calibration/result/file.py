"""The file of a calibration: NetCDF-4 in the layout of ArviZ, sufficient by itself.

Groups `posterior` and `prior` hold samples of each figure by (chain, draw) with its unit, `observed_data`
readings that are more than one number; the root's attributes hold priors, readings, residuals, findings,
provenance and, of a wing, its tailored design.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import fields
from functools import lru_cache
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
import xarray as xr
from pydantic import TypeAdapter

from calibration.errors import CalibrationError, CalibrationRecordError, said
from calibration.result.record import FROM_CAMPAIGN, FROM_LABORATORY, STATE, Calibration
from reporting.arrays import Float
from reporting.errors import DamagedFileError, FileNotWrittenError
from reporting.files import atomic_write_bytes, hash_bytes
from reporting.netcdf import read_groups
from reporting.words import one_line

FILE_NAME = "calibration.nc"
SCHEMA = "uav-twin calibration 2"
"""Value of the attribute `schema` of the root."""

_HASH = "content_sha256"
_WORDS = ("asset", "model", "model_hash", "design_hash", "procedure", "source", "seed")
_IN_GROUPS = ("samples", "prior_samples", "measured")
_AS_JSON = {
    item.name: TypeAdapter(get_type_hints(Calibration)[item.name])
    for item in fields(Calibration)
    if item.name not in (*_WORDS, *_IN_GROUPS)
}
"""What writes and reads the fields of a calibration that are no words, no seed and no array."""

Groups = Mapping[str, xr.Dataset]
Root = Mapping[str, Any]


def save_calibration(calibration: Calibration, path: Path | str) -> Path:
    """Write a calibration, whole or not at all; equal calibrations give equal bytes.

    Raises
    ------
    reporting.errors.FileNotWrittenError
        If the file cannot be written.
    """
    return atomic_write_bytes(Path(path), result_bytes(calibration))


def result_bytes(calibration: Calibration) -> bytes:
    """Return the content of the file of a calibration."""
    groups = {
        "prior": _samples(calibration, calibration.prior_samples, "prior sample"),
        "posterior": _samples(calibration, calibration.samples, "posterior sample"),
        "observed_data": calibration.measured,
    }
    root = {
        "schema": SCHEMA,
        "title": f"Calibration of {calibration.asset}",
        **{name: getattr(calibration, name) for name in _WORDS},
        **{
            name: _json(adapter.dump_python(getattr(calibration, name), mode="json"))
            for name, adapter in _AS_JSON.items()
        },
    }
    attributes = {**root, _HASH: _content_hash(groups, root)}
    tree = xr.DataTree.from_dict({"/": xr.Dataset(attrs=attributes), **groups})
    return bytes(tree.to_netcdf(engine="h5netcdf"))


def _samples(calibration: Calibration, values: Float, what: str) -> xr.Dataset:
    return xr.Dataset(
        {
            figure.name: (
                ("chain", "draw"),
                column[None],
                {"units": figure.unit, "long_name": f"{what} of {figure.title}"},
            )
            for figure, column in zip(calibration.figures, values.T, strict=True)
        }
    )


def load_calibration(path: Path | str) -> Calibration:
    """Read the calibration of a wing, or of the parameters of any model.

    Raises
    ------
    CalibrationRecordError
        If the file is missing, damaged, cut off, of another kind or of another schema; one sentence.
    """
    path = Path(path)
    groups, root = _read(path)
    came = root.get("schema")
    if came != SCHEMA:
        came = f"of the schema {str(came)!r}" if came else "no calibration file"
        raise CalibrationRecordError(said("file.version", path=path, came=came, schema=SCHEMA))
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
    try:
        found = load_calibration(kept)
    except CalibrationRecordError:
        return  # there is none, or what cannot be read is of no use to anyone
    if found.asset != asset:
        raise FileNotWrittenError(said("file.asset", kept=kept, found=found, asset=asset))
    if (found.design is not None) != wing:
        kept_one, wanted = (FROM_CAMPAIGN, FROM_LABORATORY) if wing else (FROM_LABORATORY, FROM_CAMPAIGN)
        raise FileNotWrittenError(
            said("file.another_kind", kept=kept, asset=asset, kept_one=kept_one, wanted=wanted)
        )


def _calibration(groups: Groups, root: Root) -> Calibration:
    head: dict[str, Any] = {name: adapter.validate_json(root[name]) for name, adapter in _AS_JSON.items()}
    names = [item.name for item in (*head["priors"], *head["quantities"])]
    samples, prior = (
        np.column_stack([groups[group][name].values[0] for name in names]) for group in ("posterior", "prior")
    )
    head |= {name: root[name] for name in _WORDS} | {"seed": int(root["seed"])}
    found = Calibration(**head, samples=samples, prior_samples=prior, measured=groups["observed_data"])
    if found.design is not None and found.design.hash != found.design_hash:
        raise CalibrationRecordError("its design does not match its hash")
    return found


def _read(path: Path) -> tuple[Groups, Root]:
    if not path.is_file():
        what = "no file" if path.exists() else "not there"
        raise CalibrationRecordError(said("file.absent", path=path, what=what, name=FILE_NAME))
    try:
        tree = _tree(path, hashlib.sha256(path.read_bytes()).digest())
    except DamagedFileError as error:
        raise CalibrationRecordError(said("file.damaged", path=path)) from error
    groups = {name: tree[name].to_dataset() for name in tree.children}
    return groups, {str(name): value for name, value in tree.attrs.items()}


@lru_cache(maxsize=8)
def _tree(path: Path, content: bytes) -> xr.DataTree:
    """Read a file of a content (its hash) once: a run asks for the same calibration some twenty times."""
    return read_groups(path)


def _json(content: object) -> str:
    """Return plain data as JSON, the same text for the same data."""
    return json.dumps(content, sort_keys=True, ensure_ascii=False)


def _content_hash(groups: Groups, root: Root) -> str:
    """Return a hash of all values and attributes, so that a flipped bit does not pass as a calibration."""
    digest = hashlib.sha256()
    for name in sorted(set(root) - {_HASH}):
        digest.update(f"{name}\0{root[name]}\0".encode())
    for group in sorted(groups):
        for label, variable in sorted(groups[group].variables.items(), key=lambda item: str(item[0])):
            values = np.asarray(variable.values)
            kind = "f" if values.dtype.kind == "f" else "i"
            digest.update(f"{group}/{label}\0{values.shape}\0{kind}\0".encode())
            digest.update(np.ascontiguousarray(values, "<f8" if kind == "f" else "<i8").tobytes())
            digest.update(_json({str(key): str(value) for key, value in variable.attrs.items()}).encode())
    return digest.hexdigest()


RESOURCE_NAME = "calibration.json"
"""The file among the FMU's resources that says what the wing was calibrated with."""

_GRID_POINTS = 401


def tailoring(calibration: Calibration) -> dict[str, Any]:
    """Return what the FMU of a calibrated wing carries, as options of `fmu_asset`'s `pack_wing`.

    It starts at the means of the samples of e, masses and damping; its description has the name of the wing
    and the standard deviations, and `RESOURCE_NAME` the figures with intervals and correlations. Equal input
    gives equal bytes.
    """
    text = json.dumps(
        plain_record(calibration), indent=1, sort_keys=True, ensure_ascii=False, allow_nan=False
    )
    resources = {RESOURCE_NAME: f"{text}\n".encode()}
    return {"state": calibration.mean_state(), "note": description(calibration), "resources": resources}


def description(calibration: Calibration) -> str:
    """Return one sentence with the name of the wing and its figures, mean and standard deviation."""
    figures = ", ".join(
        f"{name} {calibration.mean(name):.6g} +- {calibration.standard_deviation(name):.3g} "
        f"{figure.shown_unit}".rstrip()
        for figure in calibration.figures
        if (name := figure.name) in STATE
    )
    return f"Calibrated for the wing '{calibration.asset}' (mean +- standard deviation): {figures}."


def plain_record(calibration: Calibration) -> dict[str, Any]:
    """Return the figures of a calibration with intervals, and the correlation of its parameters."""
    figures = {
        figure.name: {
            "title": figure.title,
            "unit": figure.unit,
            "mean": calibration.mean(figure.name),
            "standard_deviation": calibration.standard_deviation(figure.name),
            "interval_95": list(calibration.interval(figure.name, 0.95)),
        }
        for figure in calibration.figures
    }
    parameters = [prior.name for prior in calibration.priors]
    quantities = [figure.name for figure in calibration.quantities]
    words = ("asset", "procedure", "seed", "model", "design_hash")
    return {
        "schema": SCHEMA,
        **{name: getattr(calibration, name) for name in words},
        "samples": len(calibration.samples),
        "calibration_sha256": hash_bytes(result_bytes(calibration)),
        "campaign" if calibration.design is None else "laboratory": calibration.source,
        "findings": list(calibration.findings),
        "state": {name: figures[name] for name in parameters},
        "quantities": {name: figures[name] for name in quantities},
        "correlation": {"names": parameters, "matrix": calibration.correlation.tolist()},
        # JSON is written with sorted keys, and pages list the quantities in the order of the calibration
        "names": {"quantities": quantities},
    }


def run_record(calibration: Calibration, parameter: str) -> dict[str, Any]:
    """Return what `calibration.json` of a run folder holds, with the parameter that the twin draws."""
    mean, deviation = calibration.prior_moments(parameter)
    prior: dict[str, Any] = {"mean": mean, "standard_deviation": deviation}
    for item in (item for item in calibration.priors if item.name == parameter):
        prior = {"mean": item.mean, "standard_deviation": item.deviation, "range": [item.low, item.high]}
    measured = calibration.measured
    return {
        **plain_record(calibration),
        "parameter": parameter,
        "prior": prior,
        "posterior": _density(calibration.draws_of(parameter)),
        "data": {str(name): measured[name].values.tolist() for name in measured},
    }


def _density(values: Float) -> dict[str, list[float]]:
    """Return a Gaussian kernel density of samples; nothing if they do not vary."""
    spread = float(values.std())
    if spread <= 1e-12 * abs(float(values.mean())):
        return {}
    from scipy.stats import gaussian_kde  # takes a second to load

    grid = np.linspace(values.min() - spread, values.max() + spread, _GRID_POINTS)
    return {"grid": grid.tolist(), "density": gaussian_kde(values)(grid).tolist()}
