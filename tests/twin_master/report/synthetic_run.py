"""A small run in the layout of the run folder, by plain enumeration, apart from the mission loop."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from twin_master.report.reading import Run
from twin_master.scenario.reading import load_scenario
from twin_master.scenario.schema import Scenario

LEVELS = np.array([0.0, 0.2, 0.4, 0.6, 0.8])
CONTROLS = ("2g", "3g")
LOAD_FACTOR = np.array([2.0, 3.0])
REWARDS = ("health", "control", "error")
NOISE, ASSUMED_NOISE, LIMIT = 150e-6, 125e-6, 2500e-6


def _worsening(probability: float) -> np.ndarray:
    rows = np.diag([1 - probability] * 4 + [1.0]) + np.diag([probability] * 4, 1)
    return np.kron(rows, rows)


def _truth(steps: int) -> np.ndarray:
    turn = np.arange(steps)[:, None]
    z1 = 0.02 * np.clip(turn - 9, 0, 10) + 0.2 * (turn >= 20) + 0.2 * (turn >= 30)
    z2 = 0.02 * np.clip(turn - 4, 0, 10) + 0.2 * (turn >= 5) + 0.2 * (turn >= 25)
    return np.minimum(np.concatenate([z1, z2], axis=1), 0.8)


def build_tree(
    steps: int = 50, horizon: int = 10, sensors: int = 24, seed: int = 5, lost: bool = False
) -> xr.DataTree:
    """Fly a made-up wing with an exact twin and return the groups of ``run.nc``."""
    random = np.random.default_rng(seed)
    states = np.stack(np.meshgrid(LEVELS, LEVELS, indexing="ij"), axis=-1).reshape(-1, 2)
    sensitivity = np.abs(random.normal(0.0, 0.05, (2, sensors)))
    sensitivity[0, 16 % sensors] = 0.5
    sensitivity[0, 18 % sensors] = 0.9
    sensitivity[1, 22 % sensors] = 0.8
    healthy = np.linspace(700e-6, 350e-6, sensors)
    healthy[16 % sensors] = 1004e-6
    draw = 1.0 + 0.01 * random.standard_normal(30)

    def strain(z: np.ndarray) -> np.ndarray:
        return healthy * np.exp(z @ sensitivity)

    table = (
        strain(states)[:, None, :] * LOAD_FACTOR[:, None] / draw[:, None, None, None]
    )  # draw, state, control, sensor
    transition = np.stack([_worsening(0.05), _worsening(0.10)])
    health = np.mean(1 - table.max(-1) / LIMIT, axis=0)
    reward = health + 2.5 * np.array([-0.1, 0.1])
    value = np.zeros(25)
    for _ in range(200):
        action_value = reward + 0.6 * np.einsum("uij,j->iu", transition, value)
        value = action_value.max(1)
    policy = action_value.argmax(1)

    truth_state = _truth(steps)
    control = np.ones(steps, dtype=np.int64)
    filtered, evidence, observation, true_strain = [], [], [], []
    predicted, control_probability = [], []
    belief = np.eye(25)[0]
    for step in range(steps):
        noise_free = strain(truth_state[step]) * LOAD_FACTOR[control[step]]
        seen = noise_free + NOISE * random.standard_normal(sensors)
        if lost and 12 <= step <= 18:
            seen[16:20] = np.nan
        if lost and step in (3, 4):
            seen[:] = np.nan
        if step:
            belief = belief @ transition[control[step - 1]]
        residual = (seen - table[:, :, control[step]]) / ASSUMED_NOISE
        density = -0.5 * np.nansum(residual**2, -1) - np.isfinite(seen).sum() * np.log(
            ASSUMED_NOISE * np.sqrt(2 * np.pi)
        )
        largest = density.max()
        weight = np.exp(density - largest).mean(0) * belief
        evidence.append(largest + np.log(weight.sum()))
        belief = weight / weight.sum()
        coming, future, choices = belief @ transition[control[step]], [], []
        for _ in range(horizon):
            future.append(coming)
            choices.append(np.array([coming[policy == u].sum() for u in range(2)]))
            coming = sum((coming * (policy == u)) @ transition[u] for u in range(2))
        if step + 1 < steps:
            control[step + 1] = int(np.argmax(choices[0]))
        filtered.append(belief)
        predicted.append(future)
        control_probability.append(choices)
        observation.append(seen)
        true_strain.append(noise_free)
    filtered = np.array(filtered)
    smoothed = filtered.copy()
    for step in range(steps - 2, -1, -1):
        joint = filtered[step][:, None] * transition[control[step]]
        total = joint.sum(0)
        smoothed[step] = joint @ np.divide(smoothed[step + 1], total, out=np.zeros(25), where=total > 0)

    def moments(probability: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        mean = np.einsum("...s,...sk->...k", probability, values)
        return mean, np.sqrt(np.einsum("...s,...sk->...k", probability, (values - mean[..., None, :]) ** 2))

    def describe(probability: np.ndarray, chosen: np.ndarray, lead: tuple[str, ...]) -> xr.Dataset:
        """`chosen` is the probability of each control, (..., U)."""
        mean, deviation = moments(probability, states)
        joint = (probability[..., :, None] * chosen[..., None, :]).reshape(*probability.shape[:-1], -1)
        quantity, spread = moments(joint, table.mean(0).reshape(-1, sensors))
        spread = np.hypot(spread, 0.01 * quantity)
        gain = np.stack(
            [health.ravel(), np.tile([-0.1, 0.1], 25), -0.9 - 0.3 * np.repeat(states[:, 0], 2)], axis=-1
        )
        reward_mean, reward_deviation = moments(joint, gain)
        region, sensor, kind = (*lead, "region"), (*lead, "sensor"), (*lead, "reward")
        return xr.Dataset(
            {
                "probability": ((*lead, "state"), probability),
                "mean": (region, mean),
                "standard_deviation": (region, deviation),
                "quantity_mean": (sensor, quantity),
                "quantity_standard_deviation": (sensor, spread),
                "quantity_lower": (sensor, quantity - 1.96 * spread),
                "quantity_upper": (sensor, quantity + 1.96 * spread),
                "reward_mean": (kind, reward_mean),
                "reward_standard_deviation": (kind, reward_deviation),
            }
        )

    flown = np.eye(2)[control]
    estimates = describe(filtered, flown, ("step",))
    estimates["log_evidence"] = ("step", np.array(evidence))
    estimates["decision_probability"] = (("step", "control"), np.array(control_probability)[:, 0])
    groups = {
        "observed": xr.Dataset(
            {
                "strain": (("step", "sensor"), np.array(observation), {"units": "1", "long_name": "strain"}),
                "control_index": ("step", control),
                "load_factor": ("step", LOAD_FACTOR[control]),
            }
        ),
        "filtered": estimates,
        "smoothed": describe(smoothed, flown, ("step",)),
        "policy": xr.Dataset(
            {
                "control_index": ("state", policy),
                "action_value": (("state", "control"), action_value),
                "value": ("state", value),
            }
        ),
        "truth": xr.Dataset(
            {
                "state": (("step", "region"), truth_state),
                "strain": (("step", "sensor"), np.array(true_strain)),
            }
        ),
    }
    groups["calibration"] = xr.Dataset(
        {"draw_value": ("draw", draw)}, attrs={"parameter": "young_modulus_factor"}
    )
    groups["truth"]["strain_error_bound"] = ("step", np.full(steps, 1.2e-6), {"units": "1"})
    groups["truth"]["tip_displacement"] = ("step", np.full(steps, 0.18), {"units": "m"})
    groups["predicted"] = describe(
        np.array(predicted), np.array(control_probability), ("step", "horizon")
    ).assign(control_probability=(("step", "horizon", "control"), np.array(control_probability)))
    coordinates: dict[str, Any] = {
        "step": np.arange(steps),
        "sensor": np.arange(1, sensors + 1),
        "region": ["z1", "z2"],
        "control": list(CONTROLS),
        "reward": list(REWARDS),
        "horizon": np.arange(1, horizon + 1),
        "z1": ("state", states[:, 0]),
        "z2": ("state", states[:, 1]),
    }
    for name, dataset in groups.items():
        used = {k: v for k, v in coordinates.items() if (v[0] if isinstance(v, tuple) else k) in dataset.dims}
        groups[name] = dataset.assign_coords(used)
    root = xr.Dataset(attrs={"seed": seed, "scenario": "level_turns"})
    return xr.DataTree.from_dict({"/": root, **groups})


def config() -> dict[str, Any]:
    return {"kind": "uav-twin run", "seed": 5, "scenario": load_scenario("level_turns").scenario.to_dict()}


def summary() -> dict[str, Any]:
    def figure(
        key: str, title: str, value: float | str | None, unit: str = "", reference: float | None = None
    ) -> Any:
        source = "" if reference is None else "Kapteyn et al. 2021"
        return {
            "key": key,
            "title": title,
            "value": value,
            "unit": unit,
            "reference": reference,
            "reference_source": source,
        }

    return {
        "figures": [
            figure("policy_switch_damage", "policy leaves the first control from z1", 60.0, "%", 60.0),
            figure("damage_step", "step of the damage that calls for it", 30),
            figure("fallback_step", "step of the fallback", 31),
            figure("fallback_delay", "delay of the fallback", 1, "steps"),
            figure("early_fallback_step", "step of a fallback before the damage", None),
            figure("filtered_rms_error_z1", "filtered rms error of z1", 3.9, "points", 3.8),
            figure("log_evidence", "log evidence of all observations", 8123.4),
            figure("strain_error_bound", "worst certified strain error", 0.42, "microstrain"),
        ]
    }


def write_run(folder: Path, tree: xr.DataTree | None = None) -> Path:
    """Write a run folder and return it."""
    folder.mkdir(parents=True, exist_ok=True)
    run = build_tree() if tree is None else tree
    run.to_netcdf(folder / "run.nc", engine="h5netcdf")
    record = config()
    record["scenario"]["observation"]["count"] = run["smoothed/sensor"].size
    (folder / "config.json").write_text(json.dumps(record))
    (folder / "summary.json").write_text(json.dumps(summary()))
    return folder


def altered(run: Run, **values: np.ndarray | None) -> Run:
    """A run with other values of variables, GROUP__VARIABLE; None takes a group or a variable away."""
    groups = {name: run.tree[name].to_dataset().copy() for name in run.tree.children}
    for name, content in values.items():
        group, _, variable = name.partition("__")
        if content is None and not variable:
            del groups[group]
        elif content is None:
            groups[group] = groups[group].drop_vars(variable)
        else:
            groups[group][variable] = (groups[group][variable].dims, content)
    tree = xr.DataTree.from_dict({"/": xr.Dataset(attrs=run.tree.attrs), **groups})
    return replace(run, tree=tree)


def rescripted(run: Run, **tables: dict[str, Any]) -> Run:
    """A run whose scenario has other values in its tables."""
    scenario = run.scenario.to_dict()
    for table, changes in tables.items():
        if isinstance(scenario[table], dict):
            scenario[table] |= changes
        else:
            scenario[table] = [entry | changes for entry in scenario[table]]
    made = Scenario.model_validate(scenario)
    return replace(run, scenario=made, config={**run.config, "scenario": scenario})
