"""The run folder of a mission as a campaign: every step is a row of a flight, its health uncertain.

`docs/run_folder.md` describes the folder; it is read by its files alone.
"""

from itertools import product
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from calibration.errors import CalibrationError
from calibration.result.file import load_calibration
from discrepancy.campaign import records
from discrepancy.errors import CampaignDataError, CampaignFileError, DiscrepancyError, said
from discrepancy.system.structures import WingModel
from fmu_asset.client.binding import load_binding
from fmu_asset.errors import FmuError
from fmu_asset.packing.patch_file import load_patch
from reporting.errors import DamagedFileError
from reporting.files import hash_file
from reporting.folders import restore_folder
from reporting.json_file import read_json
from reporting.netcdf import read_groups
from reporting.words import counted

RUN_FILE, CONFIG_FILE = "run.nc", "config.json"
DESIGN_FILE, CALIBRATION_FILE = "asset/design.toml", "asset/calibration.nc"
BINDING_FILE, MODEL_PATCH_FILE = "asset/binding.toml", "asset/model_patch.json"
PATCH_NAME, PATCH_STEP = "model_patch", "model_patch_from_step"
"""Attributes of `run.nc` where a watch adopted a patch on the way: its file, and the first step with it."""
STRAIN = "strain"
TEMPERATURE = ("temperature_difference", "temperature")
"""Names under which a run may record the temperature: less the reference [K], or itself [degC]."""
REFERENCE_TEMPERATURE = 20.0
HEALTH_DEVIATION = 0.25
"""Least prior deviation of a stiffness loss in a step, about its smoothed belief. The belief was led astray
by what is looked for, and is much surer than it is right; 24 gauges tell the health of a step anyway."""
BLOCK, HELD_OUT_SHARE = 4, 0.2
"""Steps of a block that is held out; share of the steps that is, in whole blocks spread over the flight."""


def run_campaign(
    folder: Path | str,
    first_step: int | None = None,
    last_step: int | None = None,
    held_out_share: float = HELD_OUT_SHARE,
) -> records.Campaign:
    """Return the flight of a run folder as a campaign.

    Parameters
    ----------
    folder : path
        As `uav-twin run --out` leaves it.
    first_step, last_step : int, optional
        Steps that are read; by default from the first of the flight to its last.
    held_out_share : float
        Share of the steps that is held out.

    Returns
    -------
    Campaign
        Strain channels g1, g2, ...; flight trials whose rows are steps, some of them held out. The time of a
        step is that at its end, as the FMU has it. Health is uncertain in every step. Of the
        truth, only a temperature that the asset monitors and the scenario's noise of the gauges are read.

    Raises
    ------
    CampaignFileError
        If the folder is no run of a wing, or is not whole.
    CampaignDataError
        If nothing was observed, or a steady force acted beside the load factor.
    """
    folder = Path(folder)
    restore_folder(folder)
    try:
        return _campaign(folder, (first_step, last_step), held_out_share, _config(folder)["scenario"])
    except DiscrepancyError:
        raise
    except (KeyError, ValueError, TypeError, IndexError, AttributeError, OverflowError) as cause:
        reason = str(cause.args[0] if cause.args else cause).rstrip(".")
        raise CampaignFileError(said("runs.layout", file=folder / RUN_FILE, reason=reason)) from cause


def _campaign(
    folder: Path, steps: tuple[int | None, int | None], held_out_share: float, scenario: dict[str, Any]
) -> records.Campaign:
    states = {item["name"] for item in scenario["state"]}
    if scenario["observation"].get("role") != STRAIN or states != {*records.USUAL_REGIONS}:
        raise CampaignFileError(said("runs.no_wing", folder=folder))
    if force := (scenario["asset"].get("load") or {}).get("tip_force", 0.0):
        raise CampaignDataError(said("runs.force", force=force, folder=folder))
    run = _run(folder)
    # Steps before a patch that was adopted on the way were believed with another model.
    adopted = run.attrs.get(PATCH_STEP)
    since = slice(max((step for step in (adopted, steps[0]) if step is not None), default=None), steps[1])
    observed, smoothed = (run[name].to_dataset().sel(step=since) for name in ("observed", "smoothed"))
    if not observed.sizes["step"]:
        ends = zip(("from {} on", "up to {}"), steps, strict=True)
        wanted = ", ".join(text.format(step) for text, step in ends if step is not None)
        steps = np.asarray(run["observed"]["step"].values).tolist()
        has = f"{steps[0]} to {steps[-1]}" if steps else "none"
        raise CampaignDataError(f"{folder.name} has the steps {has}, and none {wanted}.")
    strain = np.asarray(observed[STRAIN].values, dtype=np.float64)
    used = np.isfinite(strain)
    if not used.any():
        raise CampaignDataError(f"No strain reached the twin in {folder}: there is nothing to compare.")
    size = len(strain)
    names = tuple(f"g{number}" for number in observed["sensor"].values.tolist())
    temperature, known = _temperature(run, since, size)
    noise, source = _noise(scenario)
    channels = {
        name: records.Channel(
            name, records.Quantity.STRAIN, f"strain[{name[1:]}]", records.NoiseRecord(noise, inf)
        )
        for name in names
    }
    whole = records.Trial.plain(
        "steps", records.TrialKind.FLIGHT, names, _ends(folder, observed["step"].values),
        values=np.where(used, strain, 0.0), used=used, temperature=temperature,
        load_factor=np.asarray(observed["load_factor"].values, dtype=np.float64),
        run=str(run.attrs.get("scenario", "run")), health=np.asarray(smoothed["mean"].values, dtype=float),
        health_deviation=np.maximum(smoothed["standard_deviation"].values, HEALTH_DEVIATION),
    )  # fmt: skip
    held = held_out_steps(size, BLOCK, held_out_share)
    trials = [whole.rows(~held)]
    if held.any():
        trials.append(whole.rows(held, name="steps held out", held_out=True))
    lost = int(used.size - used.sum())
    be = "was" if lost == 1 else "were"
    return records.Campaign(
        name=str(run.attrs.get("title", folder.name)),
        channels=channels,
        trials=tuple(trials),
        reference_temperature=REFERENCE_TEMPERATURE if known else None,
        parameters=_calibrated(run),
        data_hash=hash_file(folder / RUN_FILE),
        remarks=(
            f"Flight of {counted(size, 'step')} read from a run folder; health in each step: "
            f"belief with a deviation of {HEALTH_DEVIATION:g} or more.",
            f"Noise of a gauge: {1e6 * noise:.4g} microstrain, {source}.",
            *([f"{lost} of {used.size} readings {be} lost."] if lost else []),
        ),
    )


def run_model(folder: Path | str) -> tuple[WingModel, Path, Path | None]:
    """Return the model that the twin of a run believed, and the files of its wing and of its patch, if any.

    The wing is that of a calibration or a design. The whole patch of the twin's model is in it, sensors too:
    they act in `discrepancy.system.sensing.observe`.

    Raises
    ------
    CampaignFileError
        If the twin believed no design.
    ModelError
        If the wing cannot be modelled.
    """
    folder = Path(folder)
    _config(folder)
    wing = folder / (CALIBRATION_FILE if _is_calibrated_wing(folder) else DESIGN_FILE)
    if not wing.is_file():
        raise CampaignFileError(said("runs.no_design", folder=folder, file=DESIGN_FILE))
    model = WingModel.of_calibration(wing) if wing.suffix == ".nc" else WingModel.of_design(wing)
    run = _run(folder)
    file = folder / str(run.attrs.get(PATCH_NAME, MODEL_PATCH_FILE))  # of the last one
    patch = file if file.is_file() else None
    if patch is not None:
        with CampaignFileError.instead_of(FmuError, before="The patch of the twin's model cannot be read: "):
            sensors = len(run["observed"]["sensor"])
            effects = load_patch(patch).for_gauges(sensors).effects
        for effect in effects:
            model = model.patched(effect.patch)
    return model, wing, patch


def _is_calibrated_wing(folder: Path) -> bool:
    """Return whether a run flew with the calibration of a wing; one of a model's parameters has no design."""
    file = folder / CALIBRATION_FILE
    if not file.is_file():
        return False
    try:
        return load_calibration(file).design is not None
    except CalibrationError:  # said where it is used
        return True


def held_out_steps(count: int, block: int, share: float) -> NDArray[np.bool_]:
    """Return which of `count` steps are held out (count,): whole blocks, evenly spread, never the first."""
    blocks = count // block
    wanted = min(round(share * count / block), blocks - 1)
    chosen = np.linspace(1, blocks - 1, max(wanted, 0) + 1)[:-1].round()
    return np.isin(np.arange(count) // block, chosen)


# ---------------------------------------------------------------- parts


def _config(folder: Path) -> dict[str, Any]:
    with CampaignFileError.instead_of(CampaignFileError, before=f"{folder} is no run folder. "):
        config = read_json(folder / CONFIG_FILE, CampaignFileError)
    if not isinstance(config, dict) or not isinstance(config.get("scenario"), dict):
        raise CampaignFileError(f"{folder / CONFIG_FILE} is not that of a run: it has no `scenario`.")
    return config


def _run(folder: Path) -> xr.DataTree:
    path = folder / RUN_FILE
    try:
        run = read_groups(path)
    except DamagedFileError as cause:
        raise CampaignFileError(f"{cause}: it is not a whole run, resume the run or fly it again.") from cause
    if missing := {"observed", "smoothed", "calibration"} - {*run.children}:
        groups = ", ".join(sorted(missing))
        raise CampaignFileError(f"{path} lacks the groups {groups}: it is no run of a twin.")
    for name in (STRAIN, "load_factor"):
        if name not in run["observed"]:
            raise CampaignFileError(f"{path} lacks the observed {name!r}: it is no run of a wing.")
    return run


def _ends(folder: Path, steps: records.FloatArray) -> records.FloatArray:
    """Return when steps end [s]; each takes a second where the run has no binding of its own."""
    path = folder / BINDING_FILE
    with CampaignFileError.instead_of(FmuError, before="The binding of the run cannot be read: "):
        bound = load_binding(path) if path.exists() else None
    start, interval = (0.0, 1.0) if bound is None else (bound.binding.start_time, bound.interval)
    return np.asarray(start + interval * (steps + 1.0))


def _temperature(run: xr.DataTree, since: slice, size: int) -> tuple[records.FloatArray, bool]:
    """Return temperatures less the reference [K], and whether they were recorded."""
    for group, name in product(("observed", "truth"), TEMPERATURE):
        if group in run.children and name in run[group]:
            values = np.asarray(run[group][name].sel(step=since).values, dtype=np.float64)
            return values - (REFERENCE_TEMPERATURE if name == "temperature" else 0.0), True
    return np.zeros(size), False


def _noise(scenario: dict[str, Any]) -> tuple[float, str]:
    """Return the deviation of a strain reading [1], and who says so."""
    stated = ((scenario.get("truth") or {}).get("noise") or {}).get("standard_deviation")
    if stated:
        return float(stated), "as the scenario says of the gauges"
    return float(scenario["observation"]["standard_deviation"]), "as the twin assumes"


def _calibrated(run: xr.DataTree) -> dict[str, tuple[float, float]]:
    name = str(run.attrs.get("parameter", ""))
    draws = np.asarray(run["calibration"]["draw_value"].values, dtype=np.float64)
    spread = float(draws.std(ddof=1)) if len(draws) > 1 else 0.0
    return {name: (float(draws.mean()), spread)} if name and spread > 0.0 else {}
