"""The tables of a calibration, with their titles and captions, for console and page."""

from math import isfinite

from calibration.result.record import Calibration, ChannelFit, ParameterPrior, QuantityReading
from calibration.result.sensors import (
    SENSOR_COLUMNS,
    SensorFit,
    gains_and_farthest_zeros,
    printed_rows,
)
from reporting.pages.table import (
    RecordColumn,
    Table,
    item_table,
    number_cells,
    table_of_records,
    text_cells,
)
from reporting.provenance import provenance_items
from reporting.words import between, plus_minus

PROCEDURES = {
    "quadrature": "by quadrature",
    "Gaussian": "a Gaussian, checked along its axes",
    "several optima": "several optima, each a Gaussian",
    "joint": "of all experiments together, by importance sampling",
}


def parameters_table(result: Calibration) -> Table:
    """Return the table of the parameters before and after the calibration."""

    def posterior(prior: ParameterPrior) -> str:
        return plus_minus(result.mean(prior.name), result.standard_deviation(prior.name))

    def interval(prior: ParameterPrior) -> str:
        low, high = result.interval(prior.name)
        return between(low, high, result.standard_deviation(prior.name))

    def prior_left(prior: ParameterPrior) -> str:
        percent = 100 * result.posterior_over_prior(prior.name)
        decimals = 0 if percent > 9.5 else 1
        return f"{percent:.{decimals}f} %"

    columns: list[RecordColumn[ParameterPrior]] = [
        text_cells("parameter", lambda prior: prior.quantity.title),
        text_cells("unit", lambda prior: prior.quantity.printed_unit),
        number_cells("prior", lambda prior: _prior_text(result, prior.name)),
        number_cells("posterior", posterior),
        number_cells("90 % interval", interval),
        number_cells("left of the prior", prior_left),
    ]
    caption = (
        f"Mean ± standard deviation. The posterior is {PROCEDURES[result.procedure]}; "
        f"calibration.nc has {len(result.samples)} samples of it. Posterior over prior: the "
        "standard deviation of the posterior as a fraction of that of the prior."
    )
    if result.information is not None:
        caption += f" Information gained: {result.information:.2f} nat."
    return table_of_records(columns, result.priors, "Parameters", caption)


def _prior_text(result: Calibration, name: str) -> str:
    """Return the prior mean and standard deviation of a quantity as text."""
    mean, deviation = result.prior_moments(name)
    return plus_minus(mean, deviation)


def readings_table(result: Calibration) -> Table:
    """Return the table of measured quantities, with the model's before and after calibration."""
    units = {quantity.name: quantity.printed_unit for quantity in reversed(result.all_quantities)}
    columns: list[RecordColumn[QuantityReading]] = [
        text_cells("experiment", lambda reading: reading.experiment),
        text_cells("figure", lambda reading: reading.name),
        text_cells("unit", lambda reading: units[reading.name]),
        number_cells("measured", lambda reading: plus_minus(reading.value, reading.deviation)),
        number_cells("before", lambda reading: _prior_text(result, reading.name)),
        number_cells(
            "after",
            lambda reading: plus_minus(
                result.mean(reading.name), result.standard_deviation(reading.name)
            ),
        ),
        number_cells(
            "model minus reading, in standard deviations",
            lambda reading: f"{result.score(reading):+.1f}",
        ),
    ]
    return table_of_records(
        columns,
        result.readings,
        title="Measured and modelled",
        caption=(
            "Mean ± standard deviation: measured, and of the model before and after the "
            "calibration. The last column is the difference of model and reading over the "
            "standard deviation of both together."
        ),
    )


def channels_table(result: Calibration) -> Table:
    """Return the table of the residuals of each channel before and after the calibration."""
    columns: list[RecordColumn[ChannelFit]] = [
        text_cells("channel", lambda channel: channel.name),
        text_cells("trials", lambda channel: channel.trials),
        number_cells("readings", lambda channel: str(channel.readings)),
        number_cells("rms before", lambda channel: _rms_text(channel.before)),
        number_cells("rms after", lambda channel: _rms_text(channel.after)),
    ]
    return table_of_records(
        columns,
        result.channels,
        title="Residuals",
        caption=(
            "Rms residual in standard deviations of the noise, with the parameters at their prior "
            "means and at the most probable values; gains, zeros and initial states are fitted in "
            "both. Held-out trials took no part in the calibration."
        ),
    )


def sensors_table(result: Calibration) -> Table:
    """Return the table of fitted gains and zeros beside the stated values, for the page."""
    return _sensors_table(gains_and_farthest_zeros(result.sensors))


def printed_sensors_table(result: Calibration) -> Table:
    """Return the table of fitted gains and zeros, at most `MOST_PRINTED_SENSORS` of them."""
    return _sensors_table(printed_rows(result.sensors))


def _sensors_table(rows: list[SensorFit]) -> Table:
    """Return the table of the given gains and zeros."""
    return table_of_records(
        SENSOR_COLUMNS,
        rows,
        title="Gains and zeros of the channels",
        caption=(
            "Fitted together with the parameters, with their standard deviations; of the zeros of "
            "a channel, the one farthest from what is stated. The last column is the distance in "
            "stated standard deviations. calibration.nc has the zeros of all trials."
        ),
    )


def _rms_text(rms: float) -> str:
    """Return an rms residual over the noise as text."""
    return f"{rms:.2f}" if isfinite(rms) else "noise unknown"


def origin_table(result: Calibration) -> Table:
    """Return a table with the origin of a calibration: asset, model, data, seed, software."""
    items = [
        ("asset", result.asset),
        ("model", f"{result.model}, SHA-256 {result.model_hash[:16]}"),
        ("measured", result.source),
        ("seed", str(result.seed)),
        ("priors", ", ".join(f"{prior.name}: {prior.stated_by}" for prior in result.priors)),
        *provenance_items(result.provenance),
    ]
    return item_table(items, "Where it comes from", "calibration.nc has everything.")
