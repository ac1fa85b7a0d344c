"""Campaign folders and sealed files."""

import json
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.blind.cases import Case
from benchmarks.blind.instruments import NOISE_FREEDOM
from benchmarks.blind.plan import ChannelPlan, TrialPlan


def _text(value: str | float | tuple[float, float] | bool) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value)
    if isinstance(value, tuple):
        return "[" + ", ".join(_text(element) for element in value) + "]"
    return repr(float(value))


def _table(heading: str, rows: dict[str, str]) -> list[str]:
    return ["", heading, *(f"{key} = {value}" for key, value in rows.items())]


def _channel(channel: ChannelPlan, stated: float | None) -> list[str]:
    rows = {
        "name": _text(channel.name),
        "quantity": _text(channel.quantity),
        "unit": _text(channel.unit),
        "output": _text(channel.output),
    }
    if not math.isnan(channel.station):
        rows |= {"station": _text(channel.station), "chord": _text(channel.chord)}
    rows |= {"gain_deviation": _text(channel.gain), "offset_deviation": _text(channel.offset)}
    if stated is not None:
        rows["noise"] = (
            f"{{ standard_deviation = {stated:.5g}, degrees_of_freedom = {NOISE_FREEDOM} }}"
        )
    return _table("[[channel]]", rows)


def _trial(trial: TrialPlan, file: str, case: Case) -> list[str]:
    plan = case.plan
    rows = {
        "name": _text(trial.name),
        "kind": _text(trial.kind),
        "file": _text(file),
        "run": _text(trial.run),
        "start": _text(trial.start),
    }
    if trial.held_out:
        rows["held_out"] = "true"
    if plan.reference_temperature is not None:
        rows["temperature"] = _text(plan.reference_temperature + trial.temperature)
    if trial.place:
        rows["load_place"] = _text(plan.places[trial.place])
    if trial.kind == "ringdown":
        rows["release"] = (
            f'{{ displacement = {trial.release!r}, unit = "m", '
            f"deviation = {plan.release_deviation!r}, "
            "at_rest = true, mode_count = 3, time_zero_deviation = 0.0 }"
        )
    return _table("[[trial]]", rows)


def _csv(
    path: Path, header: list[str], columns: list[NDArray[np.float64]], formats: list[str]
) -> None:
    lines = [",".join(header)]
    pattern = ",".join(formats)
    lines += [pattern % tuple(row) for row in np.column_stack(columns).tolist()]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_case(case: Case, campaigns: Path, sealed: Path) -> None:
    """Write `campaigns/<case>/` and `sealed/<case>.json`."""
    plan, measured = case.plan, case.measured
    folder = campaigns / case.order.name
    folder.mkdir(parents=True, exist_ok=True)
    lines = ["format = 1", f"name = {_text(plan.name)}"]
    if plan.reference_temperature is not None:
        lines.append(f"reference_temperature = {plan.reference_temperature!r}")
    for name, (mean, deviation) in plan.priors.items():
        lines += _table(f"[parameters.{name}]", {"mean": repr(mean), "deviation": repr(deviation)})
    if measured.noise:
        lines += _table("[noise]", {"file": _text("noise.csv")})
        times = np.arange(plan.noise_samples) / plan.rate
        names = list(measured.noise)
        _csv(
            folder / "noise.csv",
            ["time", *names],
            [times, *(measured.noise[name] for name in names)],
            ["%.6g", *["%.6g"] * len(names)],
        )
    for channel in plan.channels.values():
        lines += _channel(
            channel, None if channel.name in measured.noise else measured.stated[channel.name]
        )
    first = {"static": "force", "flight": "load_factor", "ringdown": "time"}
    for number, trial in enumerate(plan.trials, start=1):
        file = f"{number:02d}.csv"
        lines += _trial(trial, file, case)
        header = [first[trial.kind]]
        columns = [trial.rows]
        formats = ["%.9g"]
        if trial.kind != "ringdown":
            header.append("time")
            columns.append(trial.campaign_times)
            formats.append("%.9g")
        values = measured.values[trial.name]
        _csv(
            folder / file,
            [*header, *trial.channels],
            [*columns, *values.T],
            [*formats, *["%.7g"] * values.shape[1]],
        )
    if plan.model_file:
        (folder / plan.model_file).write_text(plan.model_text, encoding="utf-8")
    (folder / "campaign.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    sealed.mkdir(parents=True, exist_ok=True)
    text = json.dumps(case.truth, indent=1, sort_keys=True)
    (sealed / f"{case.order.name}.json").write_text(text + "\n", encoding="utf-8")
