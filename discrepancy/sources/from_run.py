"""The run folder of a mission as a campaign: every step is a row of a flight.

`docs/reference/run_folder.md` describes the folder; only its files are read.
"""

from collections.abc import Sequence
from itertools import product
from math import inf
from pathlib import Path

import numpy as np
import xarray as xr

from calibration.errors import CalibrationError
from calibration.result.file import load_calibration
from discrepancy.campaign import records
from discrepancy.campaign.records import BoolArray
from discrepancy.errors import CampaignDataError, CampaignFileError, DiscrepancyError
from discrepancy.system.wing_model import WingModel
from fmu_asset.client.binding import load_binding
from fmu_asset.errors import FmuError
from fmu_asset.packing.patch_file import load_patch
from reporting.errors import DamagedFileError
from reporting.files import hash_file
from reporting.folders import restore_folder
from reporting.formats.netcdf import read_groups
from reporting.json_file import JsonObject, read_json
from reporting.words import counted

RUN_FILE = "run.nc"
CONFIG_FILE = "config.json"
DESIGN_FILE = "asset/design.toml"
CALIBRATION_FILE = "asset/calibration.nc"
BINDING_FILE = "asset/binding.toml"
MODEL_PATCH_FILE = "asset/model_patch.json"
PATCH_NAME = "model_patch"
"""Attribute of `run.nc` with the file of a patch that a watch adopted during the mission."""
PATCH_STEP = "model_patch_from_step"
"""Attribute of `run.nc` with the first step with that patch."""
STRAIN = "strain"
TEMPERATURE = ("temperature_difference", "temperature")
"""Names of the temperature in a run: less the reference [K], or itself [degC]."""
REFERENCE_TEMPERATURE = 20.0
"""Reference temperature of the wing [degC]."""
HEALTH_DEVIATION = 0.25
"""Least prior standard deviation of a stiffness loss in a step, about the twin's estimate.

The twin's estimate is biased by the very effect that is searched, and is too certain. The 24 gauges
determine the health in each step anyway."""
BLOCK = 4
"""Steps of a block that is held out."""
HELD_OUT_SHARE = 0.2
"""Fraction of the steps that is held out, in whole blocks spread over the flight."""


def run_campaign(
    folder: Path | str,
    first_step: int | None = None,
    last_step: int | None = None,
    held_out_share: float = HELD_OUT_SHARE,
) -> records.Campaign:
    """Return the flight of a run folder as a campaign.

    The health (stiffness losses) of the wing is uncertain in every step. Of the simulated truth
    only the noise of the gauges and a temperature that the asset monitors are read.

    Parameters
    ----------
    folder : path
        The folder that `uav-twin run --out` leaves.
    first_step, last_step : int, optional
        The steps that are read; by default from the first of the flight to its last.
    held_out_share : float
        The fraction of the steps that is held out.

    Returns
    -------
    Campaign
        Strain channels g1, g2, ...; flight trials whose rows are steps, some of them held out. The
        time of a step is that at its end, as in the FMU.

    Raises
    ------
    CampaignFileError
        If the folder is not the run of a wing, or is not complete.
    CampaignDataError
        If nothing was observed, or a steady force acted in addition to the load factor.
    """
    folder = Path(folder)
    restore_folder(folder)
    try:
        scenario = _read_config(folder)["scenario"]
        _check_scenario(folder, scenario)
        run = _read_run(folder)
        steps = _steps_with_last_patch(run, first_step, last_step)
        return _build_campaign(folder, run, scenario, steps, held_out_share)
    except DiscrepancyError:
        raise
    except (KeyError, ValueError, TypeError, IndexError, AttributeError, OverflowError) as cause:
        reason = str(cause.args[0] if cause.args else cause).rstrip(".")
        raise CampaignFileError(
            f"{folder / RUN_FILE} or the config.json beside it does not have the layout of a run "
            f"of this version ({reason}): fly the run again."
        ) from cause


def _check_scenario(folder: Path, scenario: JsonObject) -> None:
    """Raise an error if the asset of a run is not the wing, or has a steady force at the tip."""
    states = {state["name"] for state in scenario["state"]}
    is_of_wing = scenario["observation"].get("role") == STRAIN
    if not is_of_wing or states != {*records.USUAL_REGIONS}:
        raise CampaignFileError(
            f"{folder} is not a run of the wing: strains under the damage states z1 and z2 are "
            "needed."
        )
    force = (scenario["asset"].get("load") or {}).get("tip_force", 0.0)
    if force:
        raise CampaignDataError(
            f"A force of {force:g} N at the tip acts in all steps of {folder}; only flights "
            "without it can be read."
        )


def _steps_with_last_patch(
    run: xr.DataTree, first_step: int | None, last_step: int | None
) -> slice:
    """Return the requested steps, without those before the last patch of the twin's model.

    In the earlier steps the twin estimated the health with another model.
    """
    firsts = [step for step in (run.attrs.get(PATCH_STEP), first_step) if step is not None]
    return slice(max(firsts, default=None), last_step)


def _build_campaign(
    folder: Path,
    run: xr.DataTree,
    scenario: JsonObject,
    steps: slice,
    held_out_share: float,
) -> records.Campaign:
    """Return some steps of a run as a campaign of one flight, with some of its steps held out.

    The strains are the readings that the twin observed; those that were lost are not used. The
    health is the twin's smoothed estimate, with a standard deviation of at least
    `HEALTH_DEVIATION`. `run` is the content of `run.nc`, and `steps` goes from the label of the
    first step to that of the last, which is included.
    """
    observed_steps = run["observed"].to_dataset().sel(step=steps)
    count = observed_steps.sizes["step"]
    if not count:
        raise CampaignDataError(_no_steps_message(folder, run, steps))
    strain = np.asarray(observed_steps[STRAIN].values, dtype=np.float64)  # (steps, gauges)
    is_used = np.isfinite(strain)
    if not is_used.any():
        raise CampaignDataError(
            f"No strain reached the twin in {folder}: there is nothing to compare."
        )
    noise, source_of_noise = _strain_noise(scenario)
    channels = _strain_channels(observed_steps["sensor"].values.tolist(), noise)
    temperature = _temperature_rises(run, steps)
    health_estimate = run["smoothed"].to_dataset().sel(step=steps)
    flight = records.Trial.plain(
        "steps",
        records.TrialKind.FLIGHT,
        tuple(channels),
        _end_times(folder, observed_steps["step"].values),
        values=np.where(is_used, strain, 0.0),
        used=is_used,
        temperature=np.zeros(count) if temperature is None else temperature,
        load_factor=np.asarray(observed_steps["load_factor"].values, dtype=np.float64),
        run=str(run.attrs.get("scenario", "run")),
        health=np.asarray(health_estimate["mean"].values, dtype=float),
        health_deviation=np.maximum(health_estimate["standard_deviation"].values, HEALTH_DEVIATION),
    )
    is_held_out = held_out_steps(count, BLOCK, held_out_share)
    trials = [flight.rows(~is_held_out)]
    if is_held_out.any():
        trials.append(flight.rows(is_held_out, name="steps held out", held_out=True))
    remarks = _flight_remarks(is_used, noise, source_of_noise)
    return records.Campaign(
        name=str(run.attrs.get("title", folder.name)),
        channels=channels,
        trials=tuple(trials),
        reference_temperature=None if temperature is None else REFERENCE_TEMPERATURE,
        parameters=_calibrated_parameter(run),
        data_hash=hash_file(folder / RUN_FILE),
        remarks=remarks,
    )


def _strain_channels(gauge_numbers: Sequence[int], noise: float) -> dict[str, records.Channel]:
    """Return a channel for each strain gauge, by its name, with a stated noise deviation [1]."""
    channels = {}
    for gauge_number in gauge_numbers:
        channels[f"g{gauge_number}"] = records.Channel(
            name=f"g{gauge_number}",
            quantity=records.Quantity.STRAIN,
            output=f"strain[{gauge_number}]",
            noise=records.NoiseRecord(noise, inf),
        )
    return channels


def _flight_remarks(is_used: BoolArray, noise: float, source_of_noise: str) -> tuple[str, ...]:
    """Return the remarks on a flight: on its length, its noise, and its lost readings.

    `is_used` (N, C) is False for readings of N steps that were lost, `noise` the standard deviation
    of a gauge's noise [1], and `source_of_noise` the phrase on where it is stated.
    """
    remarks = [
        f"Flight of {counted(len(is_used), 'step')} read from a run folder; health in each step: "
        f"belief with a deviation of {HEALTH_DEVIATION:g} or more.",
        f"Noise of a gauge: {1e6 * noise:.4g} microstrain, {source_of_noise}.",
    ]
    lost = int(is_used.size - is_used.sum())
    if lost:
        was = "was" if lost == 1 else "were"
        remarks.append(f"{lost} of {is_used.size} readings {was} lost.")
    return tuple(remarks)


def _no_steps_message(folder: Path, run: xr.DataTree, steps: slice) -> str:
    """Return the message that a run has none of the requested steps."""
    flown_steps = np.asarray(run["observed"]["step"].values).tolist()
    flown_text = f"{flown_steps[0]} to {flown_steps[-1]}" if flown_steps else "none"
    ends = []
    if steps.start is not None:
        ends.append(f"from {steps.start} on")
    if steps.stop is not None:
        ends.append(f"up to {steps.stop}")
    return f"{folder.name} has the steps {flown_text}, and none {', '.join(ends)}."


def run_model(folder: Path | str) -> tuple[WingModel, Path, Path | None]:
    """Return the model that the twin of a run used.

    The model includes the whole patch of the twin's model, also primitives of sensors, which act in
    `discrepancy.system.sensing.observe`.

    Parameters
    ----------
    folder : path
        The folder of the run.

    Returns
    -------
    model : WingModel
        The model of the wing with the patch.
    wing_file : Path
        The file of its calibration or design.
    patch_file : Path or None
        The file of its patch, if there is one.

    Raises
    ------
    CampaignFileError
        If the twin's model is not that of a wing.
    ModelError
        If the wing cannot be modelled.
    """
    folder = Path(folder)
    _read_config(folder)
    wing_file = folder / (CALIBRATION_FILE if _is_calibrated_wing(folder) else DESIGN_FILE)
    if not wing_file.is_file():
        raise CampaignFileError(
            f"{folder} holds no design (`{DESIGN_FILE}`): its twin believed no model of a wing "
            "that could be patched."
        )
    if wing_file.suffix == ".nc":
        model = WingModel.of_calibration(wing_file)
    else:
        model = WingModel.of_design(wing_file)
    run = _read_run(folder)
    patch_file = folder / str(run.attrs.get(PATCH_NAME, MODEL_PATCH_FILE))
    if not patch_file.is_file():
        return model, wing_file, None
    with CampaignFileError.instead_of(
        FmuError, before="The patch of the twin's model cannot be read: "
    ):
        gauge_count = len(run["observed"]["sensor"])
        effects = load_patch(patch_file).for_gauges(gauge_count).effects
    for effect in effects:
        model = model.with_patch(effect.patch)
    return model, wing_file, patch_file


def _is_calibrated_wing(folder: Path) -> bool:
    """Return whether the run folder has a calibration of a wing.

    The calibration of another model's parameters contains no wing design. For a damaged file the
    answer is yes, since the error is raised where the file is used.
    """
    file = folder / CALIBRATION_FILE
    if not file.is_file():
        return False
    try:
        return load_calibration(file).design is not None
    except CalibrationError:
        return True


def held_out_steps(count: int, block: int, share: float) -> BoolArray:
    """Choose the steps of a run to hold out: whole blocks, evenly spread, never the first block.

    Parameters
    ----------
    count : int
        The number of steps.
    block : int
        The number of steps in a block.
    share : float
        The fraction of the steps that is held out.

    Returns
    -------
    (count,) ndarray of bool
        True for held-out steps.
    """
    block_count = count // block
    held_out_count = min(round(share * count / block), block_count - 1)
    # indices of n blocks: n + 1 evenly spread ones from block 1 to the last, without the last
    held_out_blocks = np.linspace(1, block_count - 1, max(held_out_count, 0) + 1)[:-1].round()
    return np.isin(np.arange(count) // block, held_out_blocks)


# ---------------------------------------------------------------- files of the run folder


def _read_config(folder: Path) -> JsonObject:
    """Return the content of `config.json`; raise `CampaignFileError` if it has no scenario."""
    with CampaignFileError.instead_of(CampaignFileError, before=f"{folder} is not a run folder. "):
        config = read_json(folder / CONFIG_FILE, CampaignFileError)
    if not isinstance(config, dict) or not isinstance(config.get("scenario"), dict):
        raise CampaignFileError(
            f"{folder / CONFIG_FILE} is not that of a run: it has no `scenario`."
        )
    return config


def _read_run(folder: Path) -> xr.DataTree:
    """Return the groups of the file `run.nc`, which a run of the twin of a wing has written.

    Raises
    ------
    CampaignFileError
        If the file is damaged, or lacks a group, the strains or the load factors of such a run.
    """
    path = folder / RUN_FILE
    try:
        run = read_groups(path)
    except DamagedFileError as cause:
        raise CampaignFileError(
            f"{cause}: it is not a whole run, resume the run or fly it again."
        ) from cause
    missing_groups = {"observed", "smoothed", "calibration"} - {*run.children}
    if missing_groups:
        groups = ", ".join(sorted(missing_groups))
        raise CampaignFileError(f"{path} lacks the groups {groups}: it is not a run of a twin.")
    for name in (STRAIN, "load_factor"):
        if name not in run["observed"]:
            raise CampaignFileError(
                f"{path} lacks the observed {name!r}: it is not a run of a wing."
            )
    return run


def _end_times(folder: Path, steps: records.FloatArray) -> records.FloatArray:
    """Return the times at which steps (N,) end [s]; a step takes 1 s if the run has no binding."""
    path = folder / BINDING_FILE
    start, interval = 0.0, 1.0
    if path.exists():
        with CampaignFileError.instead_of(
            FmuError, before="The binding of the run cannot be read: "
        ):
            loaded_binding = load_binding(path)
        start, interval = loaded_binding.binding.start_time, loaded_binding.interval
    return np.asarray(start + interval * (steps + 1.0))


def _temperature_rises(run: xr.DataTree, steps: slice) -> records.FloatArray | None:
    """Return the temperatures of steps (N,) minus the reference temperature [K].

    What the twin observed comes before what the simulation stored as truth. The result is None if
    neither has a temperature.
    """
    for group, name in product(("observed", "truth"), TEMPERATURE):
        if group in run.children and name in run[group]:
            values = np.asarray(run[group][name].sel(step=steps).values, dtype=np.float64)
            return values - REFERENCE_TEMPERATURE if name == "temperature" else values
    return None


def _strain_noise(scenario: JsonObject) -> tuple[float, str]:
    """Return the standard deviation of a strain reading [1], and its source as a phrase.

    The deviation is that of the simulated gauges if the scenario states it, else the one that the
    twin uses.
    """
    truth = scenario.get("truth") or {}
    deviation = (truth.get("noise") or {}).get("standard_deviation")
    if deviation:
        return float(deviation), "as the scenario says of the gauges"
    return float(scenario["observation"]["standard_deviation"]), "as the twin assumes"


def _calibrated_parameter(run: xr.DataTree) -> dict[str, tuple[float, float]]:
    """Return the mean and standard deviation of the calibrated parameter, by its name.

    Both are computed from the draws of the calibration in the run. The result is empty if the run
    has no calibrated parameter, or if all draws are equal.
    """
    name = str(run.attrs.get("parameter", ""))
    draws = np.asarray(run["calibration"]["draw_value"].values, dtype=np.float64)
    if not name or len(draws) < 2:
        return {}
    deviation = float(draws.std(ddof=1))
    return {name: (float(draws.mean()), deviation)} if deviation > 0.0 else {}
