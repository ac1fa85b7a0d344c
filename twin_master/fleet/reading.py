"""What stands in the store of a fleet, as figures with their errors."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from twin_master.fleet.flight import fleet_config
from twin_master.fleet.outcome import FAILED, FLOWN
from twin_master.fleet.store import open_group
from twin_master.study import Estimated, Study

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["fleet_groups", "fleet_study", "group_figures"]

WITHIN = 2
"""Turns within which the fallback is to come."""


def fleet_groups(folder: Path) -> "dict[str, xr.Dataset]":
    """Return the groups of a fleet by their names.

    Raises
    ------
    RunFolderExistsError, FleetError
        The folder holds no fleet.
    """
    names = [group["name"] for group in fleet_config(folder)["fleet"]["groups"]]
    return {name: open_group(folder, name) for name in names}


def fleet_study(group: "xr.Dataset") -> Study:
    """Return the outcomes of the twins of a group that flew to their end."""
    flown = np.flatnonzero(group["status"].values == FLOWN)
    kept = {name: group[name].values[flown].astype(np.float64) for name in ("delay", "credible")}
    error = (group["mean"].values[flown] - group["state"].values[flown]).astype(np.float64)
    return Study(
        seeds=tuple(group["seed"].values[flown].tolist()),
        delay=kept["delay"],
        early=group["early"].values[flown].astype(bool),
        error=error.mean(axis=1),
        squared_error=(error**2).mean(axis=1),
        log_evidence=np.nanmean(group["log_evidence"].values[flown], axis=1, dtype=np.float64),
        credible=kept["credible"],
    )


def last_turns(group: "xr.Dataset") -> NDArray[np.int64]:
    """Return the last turn of each twin: that of a recording may come early."""
    last: NDArray[np.int64] = np.maximum((group["control_index"].values >= 0).sum(axis=1) - 1, 0)
    return last


def group_figures(group: "xr.Dataset") -> dict[str, Estimated | int]:
    """Return the figures of a group by their titles; a mean has its standard error over the twins."""
    status = group["status"].values
    found: dict[str, Estimated | int] = {
        "twins": len(status),
        "flown": int(np.sum(status == FLOWN)),
        "failed in flight": int(np.sum(status == FAILED)),
    }
    if not found["flown"]:
        return found
    study = fleet_study(group)
    if not len(study.error) or np.isnan(study.error).all():  # real assets: nobody knows the truth
        return found | {"log evidence of a step": study.evidence}
    called = bool(np.any(~np.isnan(study.delay)))
    step = f"{group.attrs['step_name']}s"
    if called:
        found[f"fallback within {WITHIN} {step}, of those called for"] = study.within(WITHIN)
    found["early fallback"] = study.early_fallback
    for number, name in enumerate(group.attrs["factors"]):
        found[f"filtered rms error of {name}"] = study.rms(number)
        found[f"bias of {name}"] = study.bias(number)
    found["log evidence of a step"] = study.evidence
    found["true state in the 90 % set"] = study.credible_share
    return found


def shown(figure: Estimated | int | None) -> str:
    """Return a figure for people."""
    if figure is None:
        return ""
    if isinstance(figure, int):
        return str(figure)
    error = f" ± {figure.error:.2g}" if np.isfinite(figure.error) else ""  # one twin has none
    return f"{figure.value:.4g}{error}"
