"""Name what is hidden in blind campaigns: `python -m benchmarks.blind_naming DIR [--jobs 2]`.

DIR is what `python -m benchmarks.blind generate --out DIR` wrote. Only DIR/campaigns and
DIR/leave_out.json are read; a verdict for each campaign goes to DIR/verdicts.
"""

import argparse
import json
import math
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track
from threadpoolctl import threadpool_limits

from discrepancy.campaign.reading import read_campaign
from discrepancy.catalogue.library import library
from discrepancy.errors import DiscrepancyError
from discrepancy.files.verdict import primitive_intervals
from discrepancy.system.interface import Model
from discrepancy.system.lumped_model import LumpedModel
from discrepancy.system.wing_model import WingModel
from discrepancy.verdict import VerdictKind
from discrepancy.workflow import Investigation, investigate, patch_draws
from fe.runtime.patch import ModelPatch, PowerDamping, PowerStiffness

NAMING = (VerdictKind.NAMED, VerdictKind.FAMILY)
_models: dict[str, Model] = {}


def model_of(folder: Path) -> Model:
    """Return the model of a campaign: the lumped one beside it, else the shipped wing."""
    file = folder / "model.toml"
    key = file.read_text(encoding="utf-8") if file.exists() else "wing"
    if key not in _models:
        _models[key] = LumpedModel.load(file) if file.exists() else WingModel.of_design()
    return _models[key]


def name_case(folder: Path, left_out: dict[str, list[str]]) -> dict[str, Any]:
    """Return the verdict on one campaign as the scoring wants it."""
    started = time.perf_counter()
    effects = [
        effect for effect in library() if effect.identifier not in left_out.get(folder.name, [])
    ]
    try:
        investigation = investigate(
            read_campaign(folder), model_of(folder), effects, thorough=False
        )
    except DiscrepancyError as error:
        return {
            "kind": "data error",
            "sentence": str(error),
            "seconds": time.perf_counter() - started,
        }
    row = verdict_row(investigation)
    row["seconds"] = time.perf_counter() - started
    return row


def verdict_row(found: Investigation) -> dict[str, Any]:
    """Return a verdict as plain data."""
    verdict, proof = found.verdict, found.proof
    row: dict[str, Any] = {
        "kind": verdict.kind.value,
        "sentence": verdict.sentence,
        "identifiers": sorted(item.identifier for item in verdict.effects)
        if verdict.kind in NAMING
        else [],
        "places": {item.identifier: item.place for item in verdict.effects},
        "group": list(verdict.group),
        "family": verdict.family,
        "probability": _finite(verdict.probability),
        "log_bayes_factor": _finite(verdict.log_bayes_factor),
        "gates": [
            [gate.name, gate.passed, _finite(gate.statistic), gate.reason] for gate in verdict.gates
        ],
        "stages": found.seconds,
        "hypotheses": [
            [list(item.identifiers), round(item.log_evidence, 2), round(item.probability, 5)]
            for item in verdict.hypotheses[:5]
        ],
        "estimates": {},
        "parameters": {},
    }
    if proof is not None and proof.held_out_after is not None:
        row["held_out_chi_square_per_sample_after"] = _finite(
            proof.held_out_after.chi_square_per_sample
        )
        row["share_closed"] = None if proof.closed is None else _finite(proof.closed.value)
    if verdict.kind in NAMING:
        row["parameters"] = {
            effect.identifier: {
                item.name: [item.low, item.value, item.high] for item in effect.parameters
            }
            for effect in verdict.effects
        }
        row["estimates"] = estimates(found)
    return row


def estimates(found: Investigation) -> dict[str, list[float]]:
    """Return low, value and high of each parameter of a verdict's effects: 90 % intervals, SI."""
    rows: dict[str, list[float]] = {}
    if found.problem is None or found.fit is None:
        return rows
    draws = patch_draws(found.problem, found.fit, seed=1)
    for effect, patches in zip(found.verdict.effects, draws, strict=True):
        for item in primitive_intervals(
            at_unit(effect.patch), [at_unit(patch) for patch in patches]
        ):
            if math.isfinite(item.low) and item.low < item.high:
                rows[f"{effect.identifier}.{item.parameter}"] = [item.low, item.value, item.high]
    return rows


def at_unit(patch: ModelPatch) -> ModelPatch:
    """Return a patch whose power laws have coefficients at unit speed and displacement."""
    primitives = []
    for primitive in patch:
        if isinstance(primitive, PowerDamping):
            scale = (
                primitive.reference_velocity**primitive.velocity_exponent
                * primitive.reference_displacement**primitive.displacement_exponent
            )
            primitive = replace(
                primitive,
                coefficient=primitive.coefficient / scale,
                reference_velocity=1.0,
                reference_displacement=1.0,
            )
        elif isinstance(primitive, PowerStiffness):
            primitive = replace(
                primitive,
                coefficient=primitive.coefficient
                / primitive.reference_displacement**primitive.exponent,
                reference_displacement=1.0,
            )
        primitives.append(primitive)
    return ModelPatch(tuple(primitives))


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _one(out: Path, left_out: dict[str, list[str]], folder: Path) -> str:
    row = name_case(folder, left_out)
    (out / f"{folder.name}.json").write_text(json.dumps(row, indent=1) + "\n", encoding="utf-8")
    return folder.name


def main() -> None:
    """Name all campaigns that have no verdict yet."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--again", action="store_true", help="also those that have a verdict")
    arguments = parser.parse_args()
    out = arguments.folder / "verdicts"
    out.mkdir(exist_ok=True)
    file = arguments.folder / "leave_out.json"
    left_out = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}
    folders = [
        folder
        for folder in sorted((arguments.folder / "campaigns").iterdir())
        if arguments.again or not (out / f"{folder.name}.json").exists()
    ]
    WingModel.of_design()  # built once, before the processes start
    with ProcessPoolExecutor(arguments.jobs, initializer=threadpool_limits, initargs=(1,)) as pool:
        named = pool.map(partial(_one, out, left_out), folders, chunksize=1)
        for _ in track(named, description="verdicts", total=len(folders), console=Console()):
            pass


if __name__ == "__main__":
    main()
