"""The calibration by the published static test, made once for a model and a seed and kept between runs.

A million particles take a second or two; a run that is flown again finds its record.
"""

import json
from collections.abc import Mapping
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

from fe.reduction.built_once import built_once, cache_folder
from fe.runtime.errors import ReducedModelFileError
from fe.runtime.kept_arrays import write_bytes_atomically
from fe.runtime.reduced import ReducedModel
from reporting.provenance import collect_provenance, hash_bytes, hash_record

MOST_KEPT = 32
"""Records of half a megabyte on disk; the oldest make way."""


def static_record(model: ReducedModel | None, seed: int) -> Mapping[str, Any]:
    """Return what `StaticCalibration.to_dict` says of the published test, bit for bit.

    Parameters
    ----------
    model : ReducedModel or None
        The model whose stiffness curve is used; None for the published line.
    seed : int
        Seed of the particle filter.

    Raises
    ------
    CalibrationError
        See `calibrate_static`.
    """
    return _record(None if model is None else model.to_bytes(), seed)


@lru_cache(maxsize=2)  # missions of one seed that follow each other in a process
def _record(model: bytes | None, seed: int) -> Mapping[str, Any]:
    code = collect_provenance(packages=("fe", "calibration"), distributions=("numpy", "scipy")).as_dict()
    key = hash_record([None if model is None else hash_bytes(model), seed, code])
    path = cache_folder() / f"static-{key[:32]}.json"
    return built_once(
        path,
        load=lambda: _read(path),
        build=lambda: _calibrate(model, seed),
        keep=lambda record: _keep(path, record),
    )


def _calibrate(model: bytes | None, seed: int) -> Mapping[str, Any]:
    # Where a record is kept, none of this is loaded.
    from .stiffness import calibrate_static
    from .stiffness_curve import PUBLISHED_LINE, stiffness_curve_of

    curve = PUBLISHED_LINE if model is None else stiffness_curve_of(ReducedModel.from_bytes(model))
    return calibrate_static(curve, seed=seed).to_dict()


def _keep(path: Path, record: Mapping[str, Any]) -> None:
    content = json.dumps(record, allow_nan=False).encode()
    write_bytes_atomically(path, hash_bytes(content).encode() + b"\n" + content)
    with suppress(OSError):  # another process removes them as well
        others = sorted(path.parent.glob("static-*.json"), key=lambda file: file.stat().st_mtime_ns)
        for old in others[:-MOST_KEPT]:
            old.unlink()
            old.with_suffix(".lock").unlink(missing_ok=True)


def _read(path: Path) -> Mapping[str, Any]:
    digest, _, content = path.read_bytes().partition(b"\n")
    if digest != hash_bytes(content).encode():
        raise ReducedModelFileError(f"{path} does not match its hash.")
    record: Mapping[str, Any] = json.loads(content)
    return record
