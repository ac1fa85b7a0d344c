"""The lines that a run of the benchmarks prints, one for each figure as it is measured."""

from benchmarks.comparison import Change
from benchmarks.measurement import Measurement
from reporting.words import significant

_NAME_WIDTH = 64
_FIGURE_WIDTH = 12
_TARGET_WIDTH = 14
_SHORT_WIDTH = 7

HEADING = (
    f"{'benchmark':{_NAME_WIDTH}} {'measured':>{_FIGURE_WIDTH}} {'target':>{_TARGET_WIDTH}} "
    f"{'reached':>{_SHORT_WIDTH}} {'ratio':>{_SHORT_WIDTH}} {'change':>{_SHORT_WIDTH}}  peer"
)
"""The heading of the columns. `ratio` is the measured figure over that of the peer."""


def line(measurement: Measurement, change: Change | None) -> str:
    """Return the line of a figure, without trailing blanks.

    Parameters
    ----------
    measurement : Measurement
        The figure.
    change : Change or None
        Its change since an earlier run.
    """
    figure = figure_text(measurement)
    reached = {None: "", True: "yes", False: "NO"}[measurement.reached]
    ratio = "" if measurement.ratio is None else significant(measurement.ratio)
    change_text = "" if change is None else f"{100 * change.relative:+.0f} %"
    return (
        f"{measurement.name:{_NAME_WIDTH}} {figure:>{_FIGURE_WIDTH}} "
        f"{target_text(measurement):>{_TARGET_WIDTH}} {reached:>{_SHORT_WIDTH}} "
        f"{ratio:>{_SHORT_WIDTH}} {change_text:>{_SHORT_WIDTH}}  {peer_text(measurement)}"
    ).rstrip()


def figure_text(measurement: Measurement) -> str:
    """Return the figure with its unit: "3.2 s"."""
    return with_unit(measurement.value, measurement)


def with_unit(value: float, measurement: Measurement) -> str:
    """Return a value with the unit of a figure; without one if the figure is a pure number."""
    return significant(value) + _unit_text(measurement)


def _unit_text(measurement: Measurement) -> str:
    if measurement.unit == "1":
        return ""
    return f" {'µs' if measurement.unit == 'us' else measurement.unit}"


def target_text(measurement: Measurement) -> str:
    """Return the target with its sign: "≤ 2 s"; empty without a target."""
    if measurement.target is None:
        return ""
    sign = "≥" if measurement.larger_is_better else "≤"
    return f"{sign} {measurement.target:g}{_unit_text(measurement)}"


def peer_text(measurement: Measurement) -> str:
    """Return what ran beside a figure, with its own figure and how far the answers agree."""
    parts = []
    name = measurement.reference_name
    if measurement.reference_value is not None:
        parts.append(f"{name}: {with_unit(measurement.reference_value, measurement)}")
    elif name:
        parts.append(f"{name}: not measured")
    if measurement.peer:
        parts.append(measurement.peer)
    if measurement.agreement is not None:
        parts.append(agreement_text(measurement))
    if measurement.remark:
        parts.append(measurement.remark)
    return "; ".join(parts)


def agreement_text(measurement: Measurement) -> str:
    """Return how far the answers agree: "beliefs agree to 2e-16 (≤ 1e-09)"; empty if unknown."""
    agreement = measurement.agreement
    if agreement is None:
        return ""
    return f"{agreement.quantity} agree to {agreement.difference:.1g} (≤ {agreement.tolerance:.2g})"
