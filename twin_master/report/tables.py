"""The tables of a report: columns, cells, and the fields of titles and captions in `words.toml`."""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from reporting.arrays import Float
from reporting.json_file import JsonRecord
from reporting.page import Page, PageColumn, Table, number_column
from reporting.words import between, in_one_line, listing, number
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

_HASH_DIGITS = 12
_MICROSTRAIN = 1.0e6
"""Factor from strain to microstrain."""


def _add_table(
    page: Page,
    name: str,
    columns: Sequence[PageColumn],
    rows: Iterable[Sequence[str]],
    **fields: object,
) -> None:
    """Add a table to a page, unless it has no rows.

    Parameters
    ----------
    name : str
        The name of its title and caption in `words.toml`.
    rows : iterable of sequence of str
        The cells. They may come from files of users: line breaks and repeated blanks become one
        blank.
    """
    cells = [[in_one_line(cell) for cell in row] for row in rows]
    if cells:
        page.add_table(Table(columns, cells), **WORDS.words("tables", name, **fields))


def add_summary_table(page: Page, run: Run) -> None:
    """Add the table of the run's results, with reference values if the scenario has any."""
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
    _add_table(page, "figures", columns, rows, references=references)


def add_learnt_asset_table(page: Page, run: Run) -> None:
    """Add the table of the whole asset's learnt quantities: prior, last posterior, true value."""
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
    _add_table(
        page,
        "learnt_asset",
        columns,
        rows,
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


def add_learnt_sensors_table(page: Page, run: Run) -> None:
    """Add the table of the quantities that were learnt of each sensor, after the last step."""
    quantities = quantities_of_sensors(run)
    columns = [PageColumn(run.sensors.word)]
    columns += [number_column(quantity.label) for quantity in quantities]
    priors = []
    for quantity in quantities:
        # All sensors have the same prior unless the scenario gives each its own.
        typical_prior: Float = np.nanmedian(quantity.prior, axis=0)
        priors.append(f"{quantity.title.lower()} {mean_and_interval(typical_prior)}")
    _add_table(
        page,
        "learnt_sensors",
        columns,
        sensor_rows(run),
        sensor=run.sensors.word,
        step=run.step_word,
        prior="; ".join(priors),
    )


def add_calibrated_table(page: Page, run: Run) -> None:
    """Add the table of calibrated parameters, or of the quantities of a healthy wing."""
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
    if not rows:
        return
    if "campaign" in record:
        kind = "parameters"
        origin = f"from the campaign {record['campaign']}"
    else:
        kind = "wing"
        origin = "of the healthy wing"
    _add_table(page, "calibrated", columns, rows, kind=kind, asset=record["asset"], origin=origin)


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


def add_run_table(page: Page, run: Run, seed: object) -> None:
    """Add the table of the run: numbers of steps and states, controls, sensors, seed and models."""
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
    _add_table(page, "run", [PageColumn("item"), PageColumn("value")], _with_value(rows))


def _with_value(rows: Iterable[tuple[str, str]]) -> list[tuple[str, str]]:
    """Return the (item, value) rows whose value is not empty."""
    return [(item, value) for item, value in rows if value.strip()]


class _Monitor(NamedTuple):
    """A further quantity that a simulated asset reports in each step.

    Attributes
    ----------
    title : str
        The name of the quantity in words.
    values : (T,) array
        The values in the printed unit; NaN in steps without one.
    unit : str
        The unit as it is printed.
    """

    title: str
    values: Float
    unit: str


def _monitors(run: Run) -> list[_Monitor]:
    """Return the quantities with a unit that a simulated asset reported, one value for each step.

    The bound of the strain error is dimensionless in the store and is printed in microstrain.
    """
    if run.true_state is None:
        return []
    monitors = []
    for name, variable in run.tree["truth"].data_vars.items():
        title = str(name).replace("_", " ")
        values = np.asarray(variable.values)
        unit = variable.attrs.get("units", "1")
        if variable.dims != ("step",):
            continue
        if name == "strain_error_bound":
            monitors.append(_Monitor(title, _MICROSTRAIN * values, "µε"))
        elif unit != "1":
            monitors.append(_Monitor(title, values, unit))
    return monitors


def _monitor_rows(run: Run) -> list[tuple[str, str]]:
    """Return a row with the largest value of each quantity that the asset reported."""
    rows = []
    for monitor in _monitors(run):
        if np.isfinite(monitor.values).any():
            largest = float(np.nanmax(monitor.values))
            rows.append((f"largest {monitor.title}", f"{largest:.3g} {monitor.unit}"))
    return rows


def add_provenance_table(page: Page, run: Run) -> None:
    """Add the table of software versions and of hashes of sources and inputs."""
    provenance = run.config.get("provenance", {})
    rows = [
        ("software", _sorted_pairs(provenance.get("versions", {}))),
        ("plug-ins", _sorted_pairs(provenance.get("plug_ins", {}))),
        ("sources", _sorted_hashes(provenance.get("source_hashes", {}))),
        ("inputs", _sorted_hashes(provenance.get("input_hashes", {}))),
        ("inputs", _sorted_hashes(run.config.get("inputs", {}))),
    ]
    columns = [PageColumn("item"), PageColumn("value")]
    _add_table(page, "provenance", columns, _with_value(rows))


def _sorted_pairs(values: Mapping[str, str]) -> str:
    """Return names with their values, sorted by name, as one text."""
    return ", ".join(f"{name} {value}" for name, value in sorted(values.items()))


def _sorted_hashes(hashes: Mapping[str, str]) -> str:
    """Return names with the first digits of their hashes, sorted by name, as one text."""
    return _sorted_pairs({name: value[:_HASH_DIGITS] for name, value in hashes.items()})
