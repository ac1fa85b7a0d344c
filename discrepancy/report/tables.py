"""The tables of the report on residuals, scores, parameters, detectable sizes and data."""

from collections.abc import Mapping, Sequence
from math import isnan, nan

from discrepancy.campaign.records import Campaign, Channel, Trial
from discrepancy.campaign.units import UNITS
from discrepancy.document import Origin
from discrepancy.judgement.closed_share import NOMINAL_UNIT, percent_with_interval
from discrepancy.judgement.hypotheses import calibrated_parameters
from discrepancy.judgement.separability import Detectability, Separability
from discrepancy.location.locate import Location
from discrepancy.location.omnibus_tests import OmnibusTest
from discrepancy.proof_record import Proof, Scores
from discrepancy.report.decidability_text import confused_effects, detectability_texts
from discrepancy.report.text import (
    UNKNOWN,
    added_label,
    number,
    p_value_text,
    unit_text,
)
from discrepancy.self_calibration import Proportion, SelfCalibration, ordered_outcomes
from discrepancy.workflow import Investigation
from reporting.pages.table import (
    PageColumn,
    RecordColumn,
    Table,
    item_table,
    number_cells,
    number_column,
    table_of_records,
    text_cells,
)
from reporting.provenance import provenance_items
from reporting.words import number as cell_text
from reporting.words import plus_minus

MOST_SHOWN_CHANNELS = 6
"""Most channels of a trial that are listed if it has many."""
MANY_CHANNELS = 8
"""Number of channels of a trial above which not all are listed."""
NINETY = 1.6449
"""Normal quantile at 95 %: half of a 90 % interval in standard deviations."""


def global_tests_table(location: Location) -> Table:
    """Return the table of the tests for any disagreement of model and data."""
    columns: list[RecordColumn[OmnibusTest]] = [
        text_cells("test", lambda test: test.name),
        number_cells("statistic", lambda test: number(test.statistic)),
        number_cells("p", lambda test: p_value_text(test.p_value)),
        text_cells(
            "disagrees",
            lambda test: UNKNOWN if isnan(test.p_value) else cell_text(test.rejected),
        ),
    ]
    return table_of_records(
        columns,
        location.tests,
        title="Global tests",
        caption=(
            "Residuals of the unchanged model on fitted trials, each against what noise would "
            "leave after the fit; Holm's rule at 1 % over the tests."
        ),
    )


def parameter_rows(investigation: Investigation) -> list[tuple[str, ...]]:
    """Return a row for each parameter of the model: name, unit, and values with 90 % half-widths.

    The values are those of the calibration, of the fit of the unchanged model and, if there is an
    effect, of the fit with it.
    """
    problem, search, fit = investigation.problem, investigation.search, investigation.fit
    if problem is None or search is None or fit is None:
        return []
    fits = [search.no_effect]
    if fit.candidate.terms:
        fits.append(fit)
    estimates_of_fits = [calibrated_parameters(problem, fitted) for fitted in fits]
    layout = problem.shared
    priors = {
        parameter.name: (mean, deviation)
        for parameter, mean, deviation in zip(
            problem.model.parameters,
            layout.centre.tolist()[: layout.parameter_count],
            layout.scale.tolist()[: layout.parameter_count],
            strict=True,
        )
    }
    rows = []
    for index, parameter in enumerate(estimates_of_fits[0]):
        mean, deviation = priors[parameter.name]
        cells = [_with_half_width(mean, deviation)]
        for estimates in estimates_of_fits:
            cells.append(_with_half_width(estimates[index].mean, estimates[index].deviation))
        name = parameter.name.replace("_", " ")
        rows.append((name, unit_text(parameter.unit), *cells))
    return rows


def _with_half_width(value: float, deviation: float) -> str:
    """Return a value with the half-width of its 90 % interval, or "exact" if its deviation is 0."""
    return plus_minus(value, NINETY * deviation) if deviation > 0.0 else f"{value:.6g}, exact"


def parameters_table(investigation: Investigation) -> Table:
    """Return the table of the model's parameters as calibrated, without and with the effect."""
    columns = [
        PageColumn("parameter"),
        PageColumn("unit"),
        number_column("calibration"),
        number_column("unchanged model"),
        number_column("with the effect"),
    ]
    rows = parameter_rows(investigation)
    if rows:
        columns = columns[: len(rows[0])]  # without an effect there is no last column
    label = added_label(investigation)
    fits = f"without and with {label}" if label else "without any effect"
    return Table(
        columns,
        rows,
        title="Calibrated parameters before and after",
        caption=(
            "Values with the half-width of their 90 % intervals: as the calibration states them, "
            f"and fitted to these data {fits}. Where the unchanged model moves a parameter by "
            "several deviations, the parameter has taken up what the model lacks."
        ),
    )


def _score_cells(scores: Scores) -> dict[str, str]:
    """Return the scores of trials as texts, by the title of their row."""
    return {
        "χ² per sample (1 is noise)": number(scores.chi_square_per_sample),
        "χ² per sample, expected of a right model": number(scores.chi_square_expected),
        "χ² per sample, standard deviation of a right model": number(
            scores.chi_square_deviation, 2
        ),
        "mean log score, nat per sample (best −1.42)": number(scores.log_score),
        "coverage of 50 % intervals, %": f"{100.0 * scores.coverage_50:.1f}",
        "coverage of 90 % intervals, %": f"{100.0 * scores.coverage_90:.1f}",
        "p-value that residuals are white": p_value_text(scores.whiteness),
        "p-value that the transforms are uniform": p_value_text(scores.pit_p_value),
        "number of samples": str(scores.sample_count),
    }


def proof_table(investigation: Investigation, proof: Proof) -> Table:
    """Return the table of the scores of fitted and held-out trials, without and with the effects.

    The last rows have the rms residual of each channel, in the unit in which it is drawn.
    """
    scores_by_title = {
        "held out, before": proof.held_out_before,
        "held out, after": proof.held_out_after,
        "fitted, before": proof.fitted_before,
        "fitted, after": proof.fitted_after,
    }
    scored = {title: scores for title, scores in scores_by_title.items() if scores is not None}
    columns = [PageColumn("score"), *(number_column(title) for title in scored)]
    rows = _score_rows([*scored.values()])
    rows += _rms_rows([*scored.values()], investigation.campaign.channels)
    return Table(
        columns,
        rows,
        title="Before and after, at the same scale",
        caption=_proof_caption(investigation, proof),
    )


def _score_rows(scores_of_columns: Sequence[Scores]) -> list[list[str]]:
    """Return a row for each score: its title, and a cell for each column of scores."""
    cells_of_columns = [_score_cells(scores) for scores in scores_of_columns]
    rows = []
    for title in cells_of_columns[0]:
        rows.append([title, *(cells[title] for cells in cells_of_columns)])
    return rows


def _rms_rows(
    scores_of_columns: Sequence[Scores], channels: Mapping[str, Channel]
) -> list[list[str]]:
    """Return a row for each channel: its rms residual in each column of scores.

    A channel that a column's trials do not have gets the cell of a number that is unknown.
    """
    # a dict keeps the order in which the channels come first
    channel_names: dict[str, None] = {}
    for scores in scores_of_columns:
        channel_names.update(dict.fromkeys(scores.rms))
    rows = []
    for name in channel_names:
        factor, unit = UNITS[channels[name].quantity].drawn
        shown_unit = "in its own unit" if unit == NOMINAL_UNIT else unit
        title = f"rms residual of {name.replace('_', ' ')} ({shown_unit})"
        cells = [number(factor * scores.rms.get(name, nan)) for scores in scores_of_columns]
        rows.append([title, *cells])
    return rows


def _proof_caption(investigation: Investigation, proof: Proof) -> str:
    """Return the caption of the proof: gain in log score, error taken away, and held-out trials."""
    sentences = []
    if proof.held_out_after is None:
        sentences.append("Nothing is held out, so that nothing is proved.")
    else:
        gain = f"{number(proof.log_score_gain)} ± {number(proof.log_score_gain_error, 2)}"
        sentences.append(f"Gain in log score on held-out trials {gain} nat per sample.")
    if proof.closed is None:
        sentences.append(proof.closed_reason)
    else:
        sentences.append(
            f"Share of the mean square error taken away, on {proof.closed.trials} trials: "
            f"{percent_with_interval(proof.closed)}."
        )
    fitted_trials = investigation.before.trials if investigation.before is not None else ()
    held_out = [fitted.trial.name for fitted in fitted_trials if fitted.trial.held_out]
    if held_out:
        sentences.append(
            f"Held out: {', '.join(held_out)}; only their own releases and zeros were adapted."
        )
    return " ".join(filter(None, sentences))


def detectable_sizes_table(separability: Separability) -> Table:
    """Return the table of the least size at which each effect can be detected."""
    columns: list[RecordColumn[Detectability]] = [
        text_cells("effect", lambda row: row.effect.identifier.replace("_", " ")),
        text_cells("testable", lambda row: detectability_texts(row)[0]),
        text_cells("shows best at", lambda row: row.place.replace("_", " ")),
        text_cells("parameter", lambda row: row.parameter.replace("_", " ")),
        number_cells("detectable from", lambda row: detectability_texts(row)[1]),
        number_cells("prior median", lambda row: detectability_texts(row)[2]),
        text_cells(
            "confused with",
            lambda row: ", ".join(confused_effects(separability, row.effect.identifier)).replace(
                "_", " "
            ),
        ),
    ]
    return table_of_records(
        columns,
        testable_effects(separability),
        title="Detectable sizes",
        caption=(
            "Computed from the model, the inputs and the noise, without the readings. Detectable "
            "from: the size at which d² reaches 25, with all nuisances adapted."
        ),
    )


def testable_effects(separability: Separability) -> list[Detectability]:
    """Return the effects that the campaign can test."""
    return [row for row in separability.detectability if not row.reason]


def printed_sizes_table(separability: Separability) -> Table:
    """Return the least size at which each effect can be detected, for the terminal."""
    columns: list[RecordColumn[Detectability]] = [
        text_cells("effect", lambda row: row.effect.identifier),
        text_cells("shows best at", lambda row: row.place),
        text_cells("parameter", lambda row: row.parameter.replace("_", " ")),
        text_cells("detectable from", lambda row: detectability_texts(row)[1]),
        text_cells("prior median", lambda row: detectability_texts(row)[2]),
    ]
    return table_of_records(columns, testable_effects(separability))


def _self_calibration_rows(self_calibration: SelfCalibration) -> list[tuple[str, str, Proportion]]:
    """Return the rows of the self-calibration: hidden or not, the outcome, and its fraction."""
    rows = []
    for title, null in (("an effect was hidden", False), ("nothing was hidden", True)):
        for outcome in ordered_outcomes(self_calibration, null=null):
            rows.append((title, outcome, self_calibration.share(outcome, null=null)))
    rows.append(
        ("named rightly", "90 % intervals that hold the true value", self_calibration.coverage())
    )
    return rows


def self_calibration_table(self_calibration: SelfCalibration) -> Table:
    """Return the table of verdicts on campaigns that were simulated with known effects."""
    columns: list[RecordColumn[tuple[str, str, Proportion]]] = [
        text_cells("campaigns", lambda row: row[0]),
        text_cells("outcome", lambda row: row[1]),
        text_cells("share, 90 % Wilson interval", lambda row: _proportion_text(row[2])),
    ]
    caption = (
        "Simulated by the model that looks for the effect, with half its time step: this says what "
        "the campaign and the workflow can do, not that the model is right."
    )
    if self_calibration.not_detectable:
        names = ", ".join(self_calibration.not_detectable)
        caption += f" Never detectable in draws of their priors, so not hidden: {names}."
    return table_of_records(
        columns,
        _self_calibration_rows(self_calibration),
        title="Verdicts on simulated campaigns of this geometry",
        caption=f"{caption} self_calibration.json has every case.",
    )


def _proportion_text(proportion: Proportion) -> str:
    """Return a fraction as count, percentage and interval."""
    low = f"{100.0 * proportion.low:.0f}"
    high = f"{100.0 * proportion.high:.0f}"
    percent = f"{100.0 * proportion.value:.0f}"
    return f"{proportion.count} of {proportion.total}: {percent} % ({low} to {high} %)"


def trials_table(campaign: Campaign) -> Table:
    """Return the table of the trials of a campaign."""
    columns: list[RecordColumn[Trial]] = [
        text_cells("trial", lambda trial: trial.name),
        text_cells("kind", lambda trial: trial.kind.value),
        text_cells("run", lambda trial: trial.run or UNKNOWN),
        number_cells("rows", lambda trial: str(len(trial.time))),
        text_cells("channels", _channels_text),
        text_cells("role", lambda trial: "held out" if trial.held_out else "fitted"),
        number_cells("left out", lambda trial: str(trial.used.size - trial.used.sum())),
    ]
    return table_of_records(
        columns,
        campaign.trials,
        title="Trials",
        caption="Left out: single samples that were marked as outliers or empty.",
    )


def _channels_text(trial: Trial) -> str:
    """Return the channels of a trial; of many only the first."""
    if len(trial.channels) <= MANY_CHANNELS:
        return ", ".join(trial.channels)
    others = len(trial.channels) - MOST_SHOWN_CHANNELS
    return f"{', '.join(trial.channels[:MOST_SHOWN_CHANNELS])} and {others} more"


def origin_table(origin: Origin) -> Table:
    """Return the table of data, model, command and software from which a verdict was computed."""
    items = [
        ("campaign", f"{origin.campaign}, SHA-256 {origin.data_hash}"),
        ("model", f"{origin.model}, SHA-256 {origin.model_hash}"),
        ("command", origin.short_command),
        ("seed", str(origin.provenance.seed)),
        *provenance_items(origin.provenance.as_dict()),
    ]
    return item_table(
        items,
        "Provenance",
        "verdict.json, patch.json and residuals.nc beside this page contain every number, and the "
        "hashes in full.",
    )
