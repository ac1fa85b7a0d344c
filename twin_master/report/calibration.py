"""What the twin was told about the uncertain parameter of its model before it flew."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.special import ndtr

from reporting import figures as style
from reporting.words import parameter_title
from twin_master.report.data import RunRecord
from twin_master.report.text import number

Float = NDArray[np.floating[Any]]


class CalibratedFigure(NamedTuple):
    """One figure of a calibrated wing: what it is, unit (SI), mean, standard deviation, 95 % interval."""

    title: str
    unit: str
    mean: float
    standard_deviation: float
    interval: tuple[float, float]


@dataclass(frozen=True)
class CalibrationView:
    """The parts of a calibration that the report draws; those that the run does not hold are None.

    Attributes
    ----------
    parameter : str
        Name of the uncertain parameter.
    unit : str
        Its unit.
    draws : (E,)
        Draws that the twin averages over.
    true_value : float or None
        Value that the asset really has, of a simulated one.
    prior : (mean, standard deviation) or None
    posterior : (grid (n,), density (n,)) or None
    pairs : (load (m,) N, displacement (m,) m) or None
        Measurements that it was calibrated with.
    stiffness : (mean, standard deviation) N/m or None
        Posterior of the tip stiffness.
    wing : str
        Name of the wing, or of whatever else was calibrated, from its calibration file.
    campaign : str
        Name of the campaign that parameters of a model were calibrated from; empty for a wing.
    moments : (mean, standard deviation) or None
        Of the calibrated parameter in the samples of its calibration file.
    ends : (low, high)
        Range of the parameter, at which prior and posterior are cut off.
    findings : tuple of str
        What that did not tell, or what disagreed.
    figures : tuple of CalibratedFigure
        All that its calibration file gives of it.
    """

    parameter: str
    unit: str
    draws: Float
    true_value: float | None
    prior: tuple[float, float] | None
    posterior: tuple[Float, Float] | None
    pairs: tuple[Float, Float] | None
    stiffness: tuple[float, float] | None
    wing: str = ""
    figures: tuple[CalibratedFigure, ...] = ()
    campaign: str = ""
    moments: tuple[float, float] | None = None
    ends: tuple[float, float] = (-np.inf, np.inf)
    findings: tuple[str, ...] = ()


def calibration_view(record: RunRecord) -> CalibrationView | None:
    """Return what is known of the calibration; None without draws."""
    draws = record.parameter_draws
    if draws is None or not len(draws) or not np.isfinite(draws).all():
        return None
    kept = record.calibration
    asset = record.scenario.get("asset")
    asset = asset if isinstance(asset, Mapping) else {}
    parameters = asset.get("parameters")
    true_value = parameters.get(record.parameter_name) if isinstance(parameters, Mapping) else None
    packed = asset.get("design") == "calibration" and not asset.get("file")
    if true_value is None and (packed or ("campaign" in kept and not record.config.get("watched"))):
        # what is flown starts at the mean of the calibration
        true_value = _table(_table(kept, "state"), record.parameter_name).get("mean")
    data = _table(kept, "data")
    # the second of two keys is that of runs of earlier versions
    return CalibrationView(
        parameter=record.parameter_name,
        unit=record.parameter_unit,
        draws=draws,
        true_value=float(true_value) if isinstance(true_value, int | float) else None,
        prior=_moments(_table(kept, "prior")),
        posterior=_arrays(_table(kept, "exact") or _table(kept, "posterior"), "grid", "density"),
        pairs=_arrays(data, "load", "displacement") or _arrays(data, "load_N", "displacement_m"),
        stiffness=_moments(
            _table(kept, "tip_stiffness_exact")
            or _table(kept, "tip_stiffness")
            or _table(_table(kept, "quantities"), "tip_stiffness")
        ),
        wing=str(kept.get("asset") or ""),
        campaign=str(kept.get("campaign") or ""),
        moments=_moments(_table(_table(kept, "state"), record.parameter_name)),
        ends=tuple(_table(kept, "prior").get("range", (-np.inf, np.inf))),
        findings=tuple(str(text) for text in kept.get("findings") or ()),
        figures=tuple(
            figure
            for group, names in _figure_names(kept)
            for name in names
            if (figure := _figure(_table(kept, group).get(name))) is not None
        ),
    )


def _figure_names(kept: Mapping[str, Any]) -> list[tuple[str, list[str]]]:
    """Return the tables of calibrated figures with the names in them, in the order of the calibration."""
    names = _table(kept, "correlation").get("names")
    # runs of earlier versions keep no order of the quantities
    quantities = _table(kept, "names").get("quantities") or list(_table(kept, "quantities"))
    return [
        (group, [str(name) for name in found] if isinstance(found, list) else [])
        for group, found in (("state", names), ("quantities", quantities))
    ]


def _figure(entry: object) -> CalibratedFigure | None:
    if not isinstance(entry, Mapping):
        return None
    try:
        low, high = (float(end) for end in entry["interval_95"])
        return CalibratedFigure(
            str(entry["title"]),
            str(entry["unit"]),
            float(entry["mean"]),
            float(entry["standard_deviation"]),
            (low, high),
        )
    except (KeyError, TypeError, ValueError):
        return None


def _table(record: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    value = record.get(key)
    return value if isinstance(value, Mapping) else {}


def _moments(record: Mapping[str, Any]) -> tuple[float, float] | None:
    mean, deviation = record.get("mean"), record.get("standard_deviation")
    if isinstance(mean, int | float) and isinstance(deviation, int | float) and deviation > 0:
        return float(mean), float(deviation)
    return None


def _arrays(record: Mapping[str, Any], first: str, second: str) -> tuple[Float, Float] | None:
    if not (isinstance(record.get(first), list) and isinstance(record.get(second), list)):
        return None
    x, y = np.asarray(record[first], dtype=np.float64), np.asarray(record[second], dtype=np.float64)
    return (x, y) if x.ndim == 1 and x.shape == y.shape and len(x) else None


def calibration_figure(view: CalibrationView) -> Figure:
    """Draw the measurements with the stiffness they give, and the distribution of the parameter."""
    with style.publication_style():
        figure = style.new_figure(2.7)
        options = {"left": 0.088, "right": 0.985, "top": 0.89, "bottom": 0.16, "wspace": 0.26}
        if view.pairs is not None and view.stiffness is not None:
            grid = figure.add_gridspec(1, 2, **options)
            _pair_panel(figure.add_subplot(grid[0, 0]), view.pairs, view.stiffness)
            _density_panel(figure.add_subplot(grid[0, 1]), view, "b")
        else:
            grid = figure.add_gridspec(1, 1, **options)
            _density_panel(figure.add_subplot(grid[0, 0]), view, "")
    return figure


def _pair_panel(axes: Axes, pairs: tuple[Float, Float], stiffness: tuple[float, float]) -> None:
    load, displacement = pairs
    reach = np.linspace(0.0, 1.08 * float(load.max()), 2)
    mean, deviation = stiffness
    low, high = (1.0e3 * reach / (mean + sign * 2.0 * deviation) for sign in (1.0, -1.0))
    axes.fill_between(reach, low, high, color=style.PRESENT, alpha=style.BAND_OPACITY, linewidth=0)
    axes.plot(reach, 1.0e3 * reach / mean, color=style.PRESENT, label="calibrated")
    axes.plot(
        load, 1.0e3 * displacement, linestyle="none", marker="o", markersize=3.2, color=style.OBSERVED,
        label="measured",
    )  # fmt: skip
    axes.set_xlim(0.0, reach[-1])
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("tip load (N)")
    axes.set_ylabel("tip displacement (mm)")
    axes.legend(loc="upper left")
    style.panel_label(axes, "a", "Measurements")


def _density_panel(axes: Axes, view: CalibrationView, label: str) -> None:
    center, spread = float(view.draws.mean()), float(view.draws.std())
    reach = 4.5 * spread if spread > 0 else 1e-3 * max(abs(center), 1.0)
    low, high = center - reach, center + 1.5 * reach  # room for the legend
    if spread > 0:
        bins = min(16, max(4, len(view.draws) // 5))
        axes.hist(
            view.draws, bins=bins, density=True, color=style.REFERENCE, alpha=0.35, linewidth=0,
            label=f"{len(view.draws)} draws used",
        )  # fmt: skip
    else:
        axes.axvline(center, color=style.PRESENT, label="value used")
    if view.prior is not None:
        mean, deviation = view.prior
        x = np.linspace(max(low, view.ends[0]), min(high, view.ends[1]), 200)
        mass = np.subtract(*ndtr((np.array(view.ends[::-1]) - mean) / deviation))
        density = np.exp(-0.5 * ((x - mean) / deviation) ** 2) / (deviation * np.sqrt(2.0 * np.pi))
        axes.plot(x, density / mass, color=style.PAST, linewidth=1.2, label="prior")
    if view.posterior is not None:
        grid, density = view.posterior
        inside = (grid >= max(low, view.ends[0])) & (grid <= min(high, view.ends[1]))
        axes.plot(grid[inside], density[inside], color=style.PRESENT, label="posterior")
    if view.true_value is not None:
        axes.axvline(
            view.true_value, color=style.TRUTH, linewidth=1.0, linestyle=(0, (4, 1.5, 1, 1.5)), label="truth"
        )
    axes.set_xlim(low, high)
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel(parameter_title(view.parameter) + ("" if view.unit == "1" else f" ({view.unit})"))
    axes.set_ylabel("density")
    axes.legend(loc="upper right", handlelength=1.5)
    style.panel_label(axes, label, "The uncertain parameter")


def calibration_caption(view: CalibrationView) -> str:
    """Return the caption of the calibration."""
    name = parameter_title(view.parameter)
    sentences = []
    if view.pairs is not None and view.stiffness is not None:
        mean, deviation = view.stiffness
        sentences.append(
            f"a: {len(view.pairs[0])} measured pairs of load and displacement, and the calibrated tip "
            f"stiffness {mean:.1f} ± {deviation:.1f} N/m (band: two standard deviations). b:"
        )
    unit = "dimensionless" if view.unit == "1" else view.unit
    sentences.append(
        f"The {name} ({unit}): the twin averages over {len(view.draws)} draws, mean "
        f"{number(float(view.draws.mean()))}, standard deviation {number(float(view.draws.std()))}."
    )
    if view.true_value is not None:
        sentences.append(f"The asset flown has {number(view.true_value)}, which the twin does not know.")
    return " ".join(sentences)
