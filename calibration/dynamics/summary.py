"""The figures of calibration steps 1 and 3 beside the paper's, and their files."""

import io
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from calibration.geometry import GeometryCalibration
from calibration.static.summary import SummaryRow
from reporting.figures import to_png, to_svg
from reporting.files import atomic_write_bytes, atomic_write_text

from .masses_and_damping import DynamicCalibration
from .trials import PUBLISHED_DAMPING_RATIOS, PUBLISHED_FREQUENCIES, RingDownTrials

_PAPER_LENGTHS = (1828.0, 433.0, 260.0)  # mm, Table 1
_PAPER_DYNAMICS = {
    "servo_mass": (169.1, 3.9),
    "pitot_mass": (133.7, 7.7),
    "damping_alpha": (1.030, None),
    "damping_beta": (7.66e-4, None),
}
_SHOWN = {
    "servo_mass": ("mass of a servo", 1e3, "g"),
    "pitot_mass": ("mass of the pitot tube", 1e3, "g"),
    "damping_alpha": ("alpha", 1.0, "1/s"),
    "damping_beta": ("beta", 1.0, "s"),
}


def geometry_rows(result: GeometryCalibration) -> list[SummaryRow]:
    """Return prior and posterior of the three lengths [mm] beside the paper's."""
    rows = []
    for length, paper in zip(result.lengths, _PAPER_LENGTHS, strict=True):
        name = length.name.replace("_", " ")
        prior, posterior = length.prior, length.posterior
        rows += [
            SummaryRow(f"{name}, prior mean", prior.mean * 1e3, None, "mm"),
            SummaryRow(f"{name}, prior standard deviation", prior.standard_deviation * 1e3, None, "mm"),
            SummaryRow(f"{name}, posterior mean", posterior.mean * 1e3, paper, "mm"),
            SummaryRow(
                f"{name}, posterior standard deviation", posterior.standard_deviation * 1e3, None, "mm"
            ),
            SummaryRow(f"{name}, measurement from design in standard deviations", length.score, None, "1"),
        ]
    return rows


def ring_down_rows(trials: RingDownTrials) -> list[SummaryRow]:
    """Return frequencies and damping ratios, averaged and with their scatter, beside the paper's."""
    rows = []
    for mode in (0, 1):
        for name, value, paper, unit in (
            ("natural frequency", trials.frequency(mode), PUBLISHED_FREQUENCIES[mode], "Hz"),
            ("damping ratio", trials.damping_ratio(mode), PUBLISHED_DAMPING_RATIOS[mode], "1"),
        ):
            rows.append(SummaryRow(f"mode {mode + 1}, {name}", value.mean, paper, unit))
            if len(trials.fits) > 1:
                rows.append(
                    SummaryRow(
                        f"mode {mode + 1}, {name}, between trials", value.standard_deviation, None, unit
                    )
                )
            rows.append(
                SummaryRow(f"mode {mode + 1}, {name}, standard error", value.standard_error, None, unit)
            )
    return rows


def dynamics_rows(result: DynamicCalibration) -> list[SummaryRow]:
    """Return masses, damping and frequencies over the samples beside the paper's."""
    rows = []
    for attribute, (name, scale, unit) in _SHOWN.items():
        mean, deviation = _PAPER_DYNAMICS[attribute]
        rows += [
            SummaryRow(f"{name}, mean", result.mean(attribute) * scale, mean, unit),
            SummaryRow(
                f"{name}, standard deviation", result.standard_deviation(attribute) * scale, deviation, unit
            ),
        ]
    paper = (5.6497, 28.613)  # means of the authors' table
    rows += [
        SummaryRow(f"f{mode + 1} of the model, mean", float(np.mean(result.frequency[:, mode])), value, "Hz")
        for mode, value in enumerate(paper)
    ]
    rows += [
        SummaryRow(f"f{mode + 1} measured", result.targets.frequency[mode], PUBLISHED_FREQUENCIES[mode], "Hz")
        for mode in (0, 1)
    ]
    return rows


def write_rows(rows: list[SummaryRow], path: Path) -> Path:
    """Write figures as CSV: name, value, the paper's value, unit."""
    text = io.StringIO()
    text.write("figure,found,paper,unit\n")
    for row in rows:
        paper = "" if row.paper is None else f"{row.paper:.10g}"
        text.write(f'"{row.name}",{row.ours:.10g},{paper},{row.unit}\n')
    return atomic_write_text(path, text.getvalue())


def write_samples(result: DynamicCalibration, path: Path) -> Path:
    """Write the samples of step 3 as CSV, in kg, 1/s, s and Hz."""
    header = "young_modulus_factor,servo_mass_kg,pitot_mass_kg,damping_alpha_per_s,damping_beta_s,f1_Hz,f2_Hz"
    table = np.column_stack([result.young_modulus_factor, result.samples, result.frequency])
    lines = [",".join(f"{value:.10g}" for value in row) for row in table.tolist()]
    return atomic_write_text(path, "\n".join([header, *lines]) + "\n")


def write_figure(figure: Figure, path: Path) -> None:
    """Write a figure as SVG and PNG beside each other; `path` has no suffix."""
    atomic_write_bytes(path.with_suffix(".svg"), to_svg(figure))
    atomic_write_bytes(path.with_suffix(".png"), to_png(figure))
