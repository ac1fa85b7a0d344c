"""The tables of a report: columns, cells, and the fields of titles and captions in `words.toml`."""

from collections.abc import Sequence

import numpy as np

from reporting.arrays import Float
from reporting.json_file import JsonRecord
from reporting.pages.table import PageColumn, Table, item_table, number_column
from reporting.provenance import provenance_items
from reporting.words import between, listing, number
from twin_master.report.captions import WORDS
from twin_master.report.learnt import (
    mean_and_interval,
    quantities_of_asset,
    quantities_of_sensors,
    sensor_rows,
)
from twin_master.report.reading import Run, moments_of
from twin_master.store.mission_result import LearntQuantity
from twin_master.store.summary import SummaryEntry
from twin_master.store.writing import printed_values

_MICROSTRAIN = 1.0e6
"""Factor from strain to microstrain."""


def summary_table(run: Run) -> Table:
    """Return the table of the run's results, with reference values if the scenario has any."""
    entries = [SummaryEntry(**record) for record in run.summary.get("figures", [])]
    has_references = any(entry.reference is not None for entry in entries)
    columns = [PageColumn("result"), number_column("this run"), PageColumn("unit")]
    if has_references:
        # a reference may be a text, such as "at most 2 steps", which has to wrap
        columns += [PageColumn("reference"), PageColumn("source of the reference")]
    rows = []
    for entry, (value, reference) in zip(entries, printed_values(entries), strict=True):
        # Only numbers are rounded for print: title and unit are those of the summary.
        row = [entry.title, value, entry.unit]
        if has_references:
            row += [reference, entry.reference_source]
        rows.append(row)
    references = ", beside their references" if has_references else ""
    return WORDS.table("figures", rows, columns, references=references)


def learnt_asset_table(run: Run) -> Table:
    """Return the table of the quantities of the asset that the twin learnt.

    It has the prior, the posterior after the last step and, in a simulation, the true value.
    """
    quantities = quantities_of_asset(run)
    has_truth = any(quantity.truth is not None for quantity in quantities)
    columns = [
        PageColumn("quantity"),
        number_column("prior, mean"),
        number_column("standard deviation"),
        number_column("learnt, mean"),
        number_column("standard deviation"),
        number_column("90 % interval"),
    ]
    if has_truth:
        columns.append(number_column("truth"))
    rows = []
    for quantity in quantities:
        prior = moments_of(quantity.prior)
        last_moments = moments_of(quantity.posterior[-1])
        row = [
            quantity.label,
            number(float(prior.mean)),
            number(float(prior.standard_deviation)),
            number(float(last_moments.mean)),
            number(float(last_moments.standard_deviation)),
            between(float(last_moments.lower), float(last_moments.upper)),
        ]
        if has_truth:
            truth = None if quantity.truth is None else float(quantity.truth)
            row.append(number(truth))
        rows.append(row)
    return WORDS.table(
        "learnt_asset",
        rows,
        columns,
        step=run.step_word,
        transition_factor=_transition_factor_sentence(run, quantities),
    )


def _transition_factor_sentence(run: Run, quantities: Sequence[LearntQuantity]) -> str:
    """Return the sentence that explains the learnt factor on transitions; empty without one."""
    if not any(quantity.name == "transition_factor" for quantity in quantities):
        return ""
    sentence = "The factor multiplies the assumed probabilities to leave a state"
    probabilities = []
    for control, probability in run.scenario.transition.probability.items():
        if isinstance(probability, int | float):  # not a table with a value for each factor
            probabilities.append(f"{probability:g} in {control}")
    if probabilities:
        sentence += f", in a {run.step_word} {listing(probabilities)}"
    return f"{sentence}."


def learnt_sensors_table(run: Run) -> Table:
    """Return the table of the quantities that were learnt of each sensor, after the last step."""
    quantities = quantities_of_sensors(run)
    columns = [PageColumn(run.sensors.word)]
    columns += [number_column(quantity.label) for quantity in quantities]
    priors = []
    for quantity in quantities:
        # All sensors have the same prior unless the scenario gives each its own.
        typical_prior: Float = np.nanmedian(quantity.prior, axis=0)
        priors.append(f"{quantity.title.lower()} {mean_and_interval(typical_prior)}")
    return WORDS.table(
        "learnt_sensors",
        sensor_rows(run),
        columns,
        sensor=run.sensors.word,
        step=run.step_word,
        prior="; ".join(priors),
    )


def calibrated_table(run: Run) -> Table:
    """Return the table of calibrated parameters, or of the quantities of a healthy wing."""
    record = run.calibration
    columns = [
        PageColumn("figure"),
        number_column("mean"),
        number_column("standard deviation"),
        number_column("95 % interval"),
        PageColumn("unit"),
    ]
    rows = []
    for quantity in calibrated_values(record):
        row = [
            quantity["title"],
            number(quantity["mean"]),
            number(quantity["standard_deviation"]),
            " to ".join(number(end) for end in quantity["interval_95"]),
            "" if quantity["unit"] == "1" else quantity["unit"],
        ]
        rows.append(row)
    if "campaign" in record:
        kind = "parameters"
        origin = f"from the campaign {record['campaign']}"
    else:
        kind = "wing"
        origin = "of the healthy wing"
    asset = record.get("asset", "")
    return WORDS.table("calibrated", rows, columns, kind=kind, asset=asset, origin=origin)


def calibrated_values(record: JsonRecord) -> list[JsonRecord]:
    """Return the calibrated values in the record of a calibration: parameters, then quantities.

    The list is empty if the run was not calibrated from a file.

    Parameters
    ----------
    record : mapping
        The record in `calibration.json`. Its table `state` has a value for each parameter, its
        table `quantities` one for each derived quantity. JSON does not preserve their order, which
        `correlation.names` and `names.quantities` give.
    """
    parameter_names = record.get("correlation", {}).get("names", ())
    quantity_names = record.get("names", {}).get("quantities", ())
    values = [record["state"][name] for name in parameter_names]
    values += [record["quantities"][name] for name in quantity_names]
    return values


def run_table(run: Run, seed: object) -> Table:
    """Return the table of the run: numbers of steps and states, controls, sensors and models."""
    sensors = f"{len(run.sensors.titles)}"
    if run.sensors.named:
        sensors += f": {', '.join(run.sensors.titles)}"
    policy = run.scenario.planner.policy_name
    if "policy" in run.config.get("inputs", {}):
        policy = "given by the user"
    states = run.model.states
    rows = [
        (f"{run.step_word}s flown", f"{run.step_count}"),
        (f"{run.step_word}s predicted", f"{run.horizon}"),
        ("states", f"{states.size} ({' × '.join(str(length) for length in states.shape)})"),
        ("controls", ", ".join(run.controls)),
        (f"{run.sensors.word}s", sensors),
        ("seed", f"{seed}"),
        ("policy", policy),
        ("asset", f"{run.tree.attrs.get('asset', '')}"),
        ("model that the twin believes", f"{run.tree.attrs.get('twin_model', '')}"),
        ("log evidence of the observations", f"{run['filtered/log_evidence'].sum():.0f} nat"),
        *_monitor_rows(run),
    ]
    return item_table(rows, **WORDS.words("tables", "run"))


def _monitor_rows(run: Run) -> list[tuple[str, str]]:
    """Return a row with the largest value of each quantity that a simulated asset reported.

    These are quantities with a unit, one value for each step. The bound of the strain error is
    dimensionless in the store and is printed in microstrain.
    """
    rows: list[tuple[str, str]] = []
    if run.true_state is None:
        return rows
    for name, variable in run.tree["truth"].data_vars.items():
        values = np.asarray(variable.values)
        unit = variable.attrs.get("units", "1")
        if name == "strain_error_bound":
            values = _MICROSTRAIN * values
            unit = "µε"
        if variable.dims == ("step",) and unit != "1" and np.isfinite(values).any():
            title = str(name).replace("_", " ")
            rows.append((f"largest {title}", f"{float(np.nanmax(values)):.3g} {unit}"))
    return rows


def provenance_table(run: Run) -> Table:
    """Return the table of software versions and of hashes of sources and inputs."""
    items = provenance_items(run.config.get("provenance", {}))
    items += provenance_items({"input_hashes": run.config.get("inputs", {})})
    return item_table(items, **WORDS.words("tables", "provenance"))
