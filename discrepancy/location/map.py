"""The map of residuals: cells of sensor, trial and bin, with the statistics of each.

Whole records are correlated with functions that they may depend on; bins of time, amplitude,
frequency and load are tested for mean and mean square. Every p-value allows for what the fit has
absorbed. The residuals r, in units of the noise, have the covariance I - S S^T with the
sensitivities S (see `discrepancy.location.residuals`). The projection b . r on a function b thus
has the variance b . b - |S^T b|^2, and z = b . r / sqrt(b . b - |S^T b|^2) is standard normal. A
function whose variance nearly vanishes, because the fit has absorbed it, is not tested.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from discrepancy.campaign.noise_tests import benjamini_yekutieli, periodogram, variance_p_value
from discrepancy.campaign.records import BoolArray, FloatArray
from discrepancy.location.residuals import FittedTrial, ResidualSet, sum_of_squares_moments

_LEAST_REMAINING_VARIANCE = 0.02
"""Least variance of the projection on a unit function, as a fraction of that before the fit.

Below it the fit has absorbed the function, and its projection is not evidence."""


class NormalEquations(NamedTuple):
    """Normal equations of functions B of unit norm, fitted to the residuals r of one channel.

    Attributes
    ----------
    gram : (k, k) ndarray
        B^T B; without sensitivities B^T V B, with the expected variances V of the residuals.
    projection : (k,) ndarray
        B^T r.
    absorbed_by_fit : (P, k) ndarray
        S^T B, with the sensitivities S of the residuals to P parameters; (0, k) without them.
    """

    gram: FloatArray
    projection: FloatArray
    absorbed_by_fit: FloatArray


def normal_equations_of(
    basis: FloatArray, rows: Sequence[tuple[FittedTrial, BoolArray]], column: int
) -> NormalEquations | None:
    """Return the normal equations of functions that are fitted to a channel's residuals.

    Parameters
    ----------
    basis : (n, k) ndarray
        Values of the k functions at n samples; they are scaled to unit norm here.
    rows : sequence of (FittedTrial, (N,) ndarray of bool)
        Trials, and which of their N samples are the rows of `basis`, one trial after the other.
    column : int
        The index of the channel in the arrays of the trials.

    Returns
    -------
    NormalEquations or None
        The normal equations; functions that are zero everywhere are left out. None if all are, or
        if there are as many functions as samples, which would fit any residuals exactly.
    """
    norms = np.linalg.norm(basis, axis=0)
    basis = basis[:, norms > 0.0] / norms[norms > 0.0]
    function_count = basis.shape[1]
    residual = np.concatenate(  # (n,), in units of the noise
        [fitted_trial.standardised[is_used, column] for fitted_trial, is_used in rows]
    )
    if not 0 < function_count < max(residual.size, 2):
        return None
    sensitivities = [  # (rows of the trial, P) each
        fitted_trial.sensitivity[is_used, column]
        for fitted_trial, is_used in rows
        if fitted_trial.sensitivity is not None
    ]
    if len(sensitivities) == len(rows):
        absorbed = np.vstack(sensitivities).T @ basis  # S^T B
        return NormalEquations(basis.T @ basis, basis.T @ residual, absorbed)
    # without sensitivities the residuals count as independent, with their expected variances
    variance = np.concatenate(
        [fitted_trial.expected_variance[is_used, column] for fitted_trial, is_used in rows]
    )
    gram = (basis.T * variance) @ basis  # B^T V B
    return NormalEquations(gram, basis.T @ residual, np.zeros((0, function_count)))


class ExplainedSquares(NamedTuple):
    """What functions explain in the residuals.

    Attributes
    ----------
    sum_of_squares : float
        The explained sum of squares, in units of the noise variance.
    degrees_of_freedom : int
        The number of directions that remain after the fit of the model; chi-squared has as many.
    """

    sum_of_squares: float
    degrees_of_freedom: int


def explained_sum_of_squares(equations: Sequence[NormalEquations]) -> ExplainedSquares:
    """Return the sum of squares that functions explain in the residuals of several channels.

    If the model is right, the projection B^T r has the covariance G = B^T (I - S S^T) B, so that
    (B^T r)^T G^-1 (B^T r) is chi-squared. Eigenvectors of G that the fit has absorbed are left out.

    Parameters
    ----------
    equations : sequence of NormalEquations
        The normal equations of each channel; every channel has its own coefficients.
    """
    projection = np.concatenate([equation.projection for equation in equations])  # (K,)
    variances, directions = np.linalg.eigh(_covariance_of_projection(equations))  # (K,), (K, K)
    is_remaining = variances > _LEAST_REMAINING_VARIANCE
    components = directions[:, is_remaining].T @ projection
    squares = components**2 / variances[is_remaining]
    return ExplainedSquares(
        sum_of_squares=float(np.sum(squares)), degrees_of_freedom=int(is_remaining.sum())
    )


def _covariance_of_projection(equations: Sequence[NormalEquations]) -> FloatArray:
    """Return the covariance G = B^T B - (S^T B)^T (S^T B) of the projection, (K, K).

    B are the functions of all channels, with K coefficients in total. If one channel lacks the
    sensitivities S, nothing counts as absorbed by the fit.
    """
    gram = np.asarray(block_diag(*(equation.gram for equation in equations)))
    has_sensitivities = all(len(equation.absorbed_by_fit) > 0 for equation in equations)
    if not has_sensitivities:
        return gram
    # all channels share the parameters, so that the columns of the channels stand side by side
    absorbed = np.hstack([equation.absorbed_by_fit for equation in equations])
    return np.asarray(gram - absorbed.T @ absorbed)


def motion_envelope(fitted_trial: FittedTrial, column: int) -> FloatArray:
    """Return the amplitude of a channel's predicted motion at each sample of a dynamic trial.

    The amplitude is sqrt(x^2 + (v / w)^2) with the displacement x from the value at rest and the
    rate v, averaged over one period. The angular frequency w is the rms of v over the rms of x, as
    it is for a harmonic motion. If nothing moves, the amplitude is |x|.

    Parameters
    ----------
    fitted_trial : FittedTrial
        The trial, with the rates of its prediction.
    column : int
        The index of the channel in the arrays of the trial.

    Returns
    -------
    (N,) ndarray
        Amplitude [channel's unit].
    """
    assert fitted_trial.rates is not None
    prediction = fitted_trial.prediction[:, column]
    x = prediction - _value_at_rest(fitted_trial, column)
    v = fitted_trial.rates[:, column]
    rms_value = float(np.sqrt(np.mean(x**2)))
    rms_rate = float(np.sqrt(np.mean(v**2)))
    if rms_value == 0.0 or rms_rate == 0.0:
        return np.abs(x)
    rate_over_frequency = v * rms_value / rms_rate
    amplitude = np.hypot(x, rate_over_frequency)
    # Moving average over one period 2 pi / w. Near the ends fewer samples are in the window, so the
    # sums are divided by their numbers.
    period = 2.0 * np.pi * rms_value / (rms_rate * fitted_trial.trial.interval)
    width = min(max(1, round(period)), len(x))
    kernel = np.ones(width)
    sums = np.convolve(amplitude, kernel, "same")
    counts = np.convolve(np.ones_like(x), kernel, "same")
    return np.asarray(sums / counts)


def _value_at_rest(fitted_trial: FittedTrial, column: int) -> float:
    """Return the value about which a prediction oscillates: the mean of its last quarter."""
    values = fitted_trial.prediction[:, column]
    return float(np.mean(values[-max(len(values) // 4, 1) :]))


def dependence_functions(fitted_trial: FittedTrial, column: int) -> dict[str, FloatArray]:
    """Return the functions that the residuals of a channel may depend on, at its used samples.

    Here x is the predicted displacement from rest and v its rate. The nonlinear functions (x^3,
    |v|v and so on) are made orthogonal to the mean, x and v, so that an error of amplitude or phase
    does not appear in all of them.

    Parameters
    ----------
    fitted_trial : FittedTrial
        The trial, with its prediction; the functions of the rate need the rates of the prediction.
    column : int
        The index of the channel in the arrays of the trial.

    Returns
    -------
    dict of str to (n, k) ndarray
        Values of each function, k = 1 or 2 columns, at the n used samples. The names are those of
        `Cell.statistic`. Functions that are zero, or of which nothing remains after the projection,
        are left out.
    """
    is_used = fitted_trial.used[:, column]
    trial = fitted_trial.trial
    value_at_rest = _value_at_rest(fitted_trial, column) if trial.is_dynamic else 0.0
    x = fitted_trial.prediction[is_used, column] - value_at_rest
    linear_functions = {"mean": np.ones(int(is_used.sum())), "x": x}
    nonlinear_functions = {"x^3": [x**3], "|x|": [np.abs(x)], "sgn x": [np.sign(x)]}
    # Only the mean is projected out of load, time and temperature: a dependence on them is to be
    # reported under their names even if x and v could explain part of it.
    conditions = {"time": trial.time[is_used], "temperature": trial.temperature[is_used]}
    if not trial.is_dynamic:
        conditions["load"] = trial.force[is_used]
        conditions["load factor"] = trial.load_factor[is_used]
    elif fitted_trial.rates is not None:
        v = fitted_trial.rates[is_used, column]
        linear_functions["v"] = v
        nonlinear_functions["sgn v"] = [np.sign(v)]
        nonlinear_functions["|v|v"] = [np.abs(v) * v]
        amplitude = motion_envelope(fitted_trial, column)[is_used]
        # phase of a harmonic motion x = a cos(phase), v = -a w sin(phase)
        phase = np.angle(x / _rms_or_one(x) - 1j * v / _rms_or_one(v))
        for order, name in ((2, "2nd harmonic"), (3, "3rd harmonic")):
            nonlinear_functions[name] = [
                amplitude * np.cos(order * phase),
                amplitude * np.sin(order * phase),
            ]
    # orthonormal bases of the mean, x and v (n, 2 or 3), and of the mean alone (n, 1)
    scaled_functions = [values / _rms_or_one(values) for values in linear_functions.values()]
    linear_basis, _ = np.linalg.qr(np.column_stack(scaled_functions))
    mean_basis = linear_basis[:, :1]
    functions = {}
    for name, values in linear_functions.items():
        if np.any(values):
            functions[name] = values[:, np.newaxis]
    for name, columns in nonlinear_functions.items():
        _add_projected_function(functions, name, np.column_stack(columns), linear_basis)
    for name, values in conditions.items():
        _add_projected_function(functions, name, values[:, np.newaxis], mean_basis)
    return functions


def _add_projected_function(
    functions: dict[str, FloatArray], name: str, columns: FloatArray, basis: FloatArray
) -> None:
    """Add a function to `functions`, in place, after it was made orthogonal to a basis.

    The function is not added if less than 1e-6 of the norm of one of its columns remains. The
    function has k columns (n, k), and the columns of the basis (n, b) are orthonormal.
    """
    projected_columns = columns - basis @ (basis.T @ columns)
    norms = np.linalg.norm(columns, axis=0)
    is_independent = np.linalg.norm(projected_columns, axis=0) > 1e-6 * norms
    if np.all((norms > 0.0) & is_independent):
        functions[name] = projected_columns


def _rms_or_one(values: FloatArray) -> float:
    """Return the root mean square of values (n,); 1 if all are zero."""
    return float(np.sqrt(np.mean(values**2))) or 1.0


BIN_COUNT = 6
"""Bins of time, amplitude and frequency of a dynamic record."""
LOAD_BIN_COUNT = 3
"""Bins of load of a static trial, which has few rows."""

_LEAST_SAMPLES_OF_CELL = 4
"""Fewest samples of a cell whose size is tested."""


_LEAST_FREEDOM_OF_CELL = 0.5
"""Least effective degrees of freedom of a cell: with fewer, the fit has absorbed the residuals."""


@dataclass(frozen=True)
class Cell:
    """One entry of the map: a statistic of the residuals of a channel in a bin of a trial.

    Attributes
    ----------
    trial, channel : str
        The names of the trial and the channel.
    axis : str
        "whole", "time", "amplitude", "frequency" or "load".
    low, high : float
        The ends of the bin on that axis: [s], [channel's unit], [Hz], [N] or load factor; nan for
        the whole record.
    count : int
        The number of samples.
    statistic : str
        "mean", "variance", or the function that residuals depend on: "x", "v", "sgn v", "|v|v",
        "x^3", "sgn x" (odd), "|x|" (even), "2nd harmonic", "3rd harmonic", "time", "load", "load
        factor", "temperature".
    value : float
        Mean [noise deviation], mean square over its expectation, or correlation coefficient.
    p_value : float
        p-value: two-sided, for a variance one-sided.
    significant : bool
        True for a discovery at the map's false discovery rate.
    """

    trial: str
    channel: str
    axis: str
    low: float
    high: float
    count: int
    statistic: str
    value: float
    p_value: float
    significant: bool = False


def residual_map(
    residuals: ResidualSet, white_residuals: tuple[FloatArray, ...], rate: float = 0.05
) -> tuple[Cell, ...]:
    """Return the cells of all trials and channels, and mark those that are significant.

    A cell is significant if it is a discovery at the false discovery rate by the rule of Benjamini
    and Yekutieli (2001), which holds for dependent tests.

    Parameters
    ----------
    residuals : ResidualSet
        The residuals of the fitted trials.
    white_residuals : tuple of (N, C) ndarray
        The white residuals of each trial, from its method `whitened_residuals`, for the bins of
        frequency.
    rate : float
        The false discovery rate that is accepted.
    """
    cells: list[Cell] = []
    for fitted_trial, values in zip(residuals.trials, white_residuals, strict=True):
        cells += _cells_of_trial(residuals, fitted_trial, values)
    p_values = np.array([cell.p_value for cell in cells])
    are_discoveries = benjamini_yekutieli(p_values, rate)
    return tuple(
        replace(cell, significant=bool(is_discovery))
        for cell, is_discovery in zip(cells, are_discoveries, strict=True)
    )


def _cells_of_trial(
    residuals: ResidualSet, fitted_trial: FittedTrial, white_residuals: FloatArray
) -> Iterator[Cell]:
    """Yield the cells of a trial: its whole records, and their bins.

    Whole records are tested for all dependences, bins for the mean, and both for the variance. The
    white residuals (N, C) are tested in bands of frequency, if all samples of a dynamic record are
    used.
    """
    trial = fitted_trial.trial
    for column, channel in enumerate(trial.channels):
        noise_freedom = residuals.degrees_of_freedom(channel)
        is_used = fitted_trial.used[:, column]
        if not is_used.any():
            continue
        template = Cell(
            trial=trial.name,
            channel=channel,
            axis="whole",
            low=np.nan,
            high=np.nan,
            count=0,
            statistic="",
            value=np.nan,
            p_value=1.0,
        )
        for span in _spans(fitted_trial, column):
            count = int(span.used.sum())
            cell = replace(template, axis=span.axis, low=span.low, high=span.high, count=count)
            functions = {"mean": np.ones((count, 1))}
            if span.axis == "whole":
                functions = dependence_functions(fitted_trial, column)
            for name, function_values in functions.items():
                untested_cell = replace(cell, statistic=name)
                tested_cell = _test_dependence(
                    fitted_trial, column, span.used, function_values, untested_cell, noise_freedom
                )
                if tested_cell is not None:
                    yield tested_cell
            yield from _variance_cells(fitted_trial, column, span.used, cell, noise_freedom)
        if trial.is_dynamic and is_used.all():
            yield from _frequency_cells(
                white_residuals[:, column], trial.interval, template, noise_freedom
            )


class _Span(NamedTuple):
    """Samples of a channel between two values on an axis.

    Attributes
    ----------
    axis : str
        "whole", "time", "amplitude" or "load".
    low, high : float
        Ends; nan for the whole record.
    used : (N,) ndarray of bool
        The used samples between the ends.
    """

    axis: str
    low: float
    high: float
    used: BoolArray


def _spans(fitted_trial: FittedTrial, column: int) -> Iterator[_Span]:
    """Yield the spans of a channel's record that are tested: the whole, and its bins.

    The bins are of time and amplitude for a dynamic trial, else of load.
    """
    trial = fitted_trial.trial
    is_used = fitted_trial.used[:, column]
    yield _Span("whole", np.nan, np.nan, is_used)
    if trial.is_dynamic:
        time_edges = np.linspace(trial.time[0], trial.time[-1], BIN_COUNT + 1)
        yield from _spans_of_bins("time", trial.time, time_edges, is_used)
        if fitted_trial.rates is not None:
            amplitude = motion_envelope(fitted_trial, column)
            if amplitude.any():
                largest_amplitude = amplitude.max()
                least_amplitude = max(amplitude.min(), 1e-4 * largest_amplitude)
                edges = np.geomspace(least_amplitude, largest_amplitude, BIN_COUNT + 1)
                yield from _spans_of_bins("amplitude", amplitude, edges, is_used)
    else:
        load = trial.load
        load_edges = np.linspace(load.min(), load.max(), LOAD_BIN_COUNT + 1)
        yield from _spans_of_bins("load", load, load_edges, is_used)


def _spans_of_bins(
    axis: str, values: FloatArray, edges: FloatArray, is_used: BoolArray
) -> Iterator[_Span]:
    """Yield a span for each bin of an axis that has a width.

    `values` (N,) are those of the samples on the axis, and `edges` (B + 1,) the ascending edges of
    B bins. Samples outside of them belong to the first or the last bin.
    """
    bin_of_sample = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, edges.size - 2)
    for bin_index, (low, high) in enumerate(pairwise(edges.tolist())):
        if low < high:
            yield _Span(axis, low, high, is_used & (bin_of_sample == bin_index))


def _test_dependence(
    fitted_trial: FittedTrial,
    column: int,
    is_used: BoolArray,
    function_values: FloatArray,
    cell: Cell,
    noise_freedom: float,
) -> Cell | None:
    """Test whether the residuals of a channel depend on a function, such as the speed.

    Parameters
    ----------
    fitted_trial : FittedTrial
        The trial with the residuals of its N samples.
    column : int
        The index of the channel in the trial.
    is_used : (N,) ndarray of bool
        Whether each sample is one of the n samples that are tested.
    function_values : (n, k) ndarray
        Values of the function at these samples. Most functions have k = 1 component; a harmonic has
        two, its cosine and its sine. A constant function tests the mean of the residuals.
    cell : Cell
        The entry of the map for the result, still without value and p-value.
    noise_freedom : float
        The degrees of freedom of the channel's noise record; 0 if there is no record, and the noise
        variance is then taken as exact.

    Returns
    -------
    Cell or None
        The cell with the p-value of the test. The value of the cell is the correlation coefficient
        of residuals and function; for a constant function, the mean residual. None if the fit has
        already removed a component of the function from the residuals, if a component is zero
        everywhere, or if there are as many components as samples.
    """
    equations = normal_equations_of(function_values, ((fitted_trial, is_used),), column)
    if equations is None:
        return None
    explained_squares, component_count = explained_sum_of_squares((equations,))
    if component_count < function_values.shape[1]:
        return None
    residual = fitted_trial.standardised[is_used, column]
    if cell.statistic == "mean":
        value = float(np.mean(residual))
    else:
        # `normal_equations_of` scales each component b to unit norm, so that the correlation of b
        # and the residual r is b . r / |r|
        residual_norm = float(np.linalg.norm(residual)) or 1.0  # 1: no division by zero
        correlations = equations.projection / residual_norm
        # one component keeps its sign
        value = float(correlations[0] if component_count == 1 else np.linalg.norm(correlations))
    record_freedom = np.inf if noise_freedom == 0.0 else noise_freedom
    mean_square = explained_squares / component_count
    p_value = variance_p_value(mean_square, component_count, record_freedom)
    return replace(cell, value=value, p_value=p_value)


def _variance_cells(
    fitted_trial: FittedTrial, column: int, is_used: BoolArray, cell: Cell, noise_freedom: float
) -> Iterator[Cell]:
    """Yield a cell with the sum of squared residuals over its expectation.

    Nothing is yielded without a noise record (`noise_freedom` of 0), with too few samples, or if
    the fit has absorbed the residuals.

    Parameters
    ----------
    fitted_trial : FittedTrial
        The trial.
    column : int
        The index of the channel in the arrays of the trial.
    is_used : (N,) ndarray of bool
        The samples of the cell.
    cell : Cell
        The cell, still without value and p-value.
    noise_freedom : float
        The degrees of freedom of the channel's noise record; 0 if it has none.
    """
    # a bin of few samples is not tested; a whole record is, however short
    least_count = 1 if cell.axis == "whole" else _LEAST_SAMPLES_OF_CELL
    if noise_freedom <= 0.0 or cell.count < least_count:
        return
    sensitivity = (
        None if fitted_trial.sensitivity is None else fitted_trial.sensitivity[is_used, column]
    )
    expected_sum, freedom = sum_of_squares_moments(
        [(fitted_trial.expected_variance[is_used, column], sensitivity)]
    )
    if freedom >= _LEAST_FREEDOM_OF_CELL:
        value = float(np.sum(fitted_trial.standardised[is_used, column] ** 2)) / expected_sum
        p_value = variance_p_value(value, freedom, noise_freedom)
        yield replace(cell, statistic="variance", value=value, p_value=p_value)


def _frequency_cells(
    series: FloatArray, interval: float, template: Cell, noise_freedom: float
) -> Iterator[Cell]:
    """Yield a cell of the map with the variance of a channel's residuals in each frequency band.

    Bands are wider at high frequency. Nothing is yielded without a noise record, or for a record
    too short for `BIN_COUNT` bands of four ordinates on average.

    Parameters
    ----------
    series : (N,) ndarray
        Residuals of a channel that are white, of variance one, if they contain noise alone.
    interval : float
        The interval between successive samples [s].
    template : Cell
        A cell with the names of the trial and the channel, which the yielded cells take over.
    noise_freedom : float
        The degrees of freedom of the channel's noise record; 0 if it has none.
    """
    ordinates = periodogram(series)  # at the frequencies 1, 2, 3, ... times the resolution
    is_too_short = ordinates.size < 4 * BIN_COUNT
    if is_too_short or noise_freedom <= 0.0:
        return
    # The first band has four ordinates; the ends of the others grow geometrically.
    band_ends = np.round(np.geomspace(4, ordinates.size, BIN_COUNT)).astype(int)
    edges = [0, *np.unique(band_ends).tolist()]
    resolution = 1.0 / (series.size * interval)
    for start, end in pairwise(edges):
        count = 2 * (end - start)  # a cosine and a sine for each ordinate
        variance = float(ordinates[start:end].mean())
        # Ordinate j has the frequency (j + 1) times the resolution; the edge lies half a step
        # below the frequency of ordinate `start`.
        yield replace(
            template,
            axis="frequency",
            statistic="variance",
            low=(start + 0.5) * resolution,
            high=(end + 0.5) * resolution,
            count=count,
            value=variance,
            p_value=variance_p_value(variance, count, noise_freedom),
        )
