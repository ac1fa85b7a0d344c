"""`uav-twin calibrate`: all three steps of a wing; `ringdown`, `simulate` and `campaign`."""

import json as json_text
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal, NamedTuple

import typer

from fe.runtime.state import DigitalState
from reporting import terminal
from reporting.files import atomic_write_text, refuse_filled
from uav_twin import parts
from uav_twin.discrepancy_commands import one_thread
from uav_twin.options import show


def calibrate_campaign(
    campaign: Path,
    *,
    model: str | None = None,
    out: Path | None = None,
    asset: str | None = None,
    samples: int = 1000,
    seed: int = 0,
    json: bool = False,
    no_report: bool = False,
) -> None:
    """Posterior of the parameters of any model, an FMU or a structure too, from a campaign."""
    one_thread()
    data = parts.read_campaign(campaign)
    name = parts.check_name(data.name if asset is None else asset)
    if out is not None:
        parts.check_folder(out, name, wing=False)
    chosen = parts.choose_model(model)
    result = parts.calibrate_parameters(data, chosen, asset=name, samples=samples, seed=seed)
    written = None
    if out is not None:
        written = parts.write_calibration_folder(result, out, report=not no_report)
    conclude(result, written, json=json, report=not no_report)


def conclude(
    result: "parts.Calibration", written: Path | None, *, json: bool, report: bool
) -> None:
    """Print the result of a calibration, and where it was written.

    Parameters
    ----------
    result : Calibration
        The calibration.
    written : Path or None
        Its file, if one was written.
    json : bool
        Whether to print JSON.
    report : bool
        Whether a report stands beside the file.
    """
    if json:
        file = None if written is None else str(written)
        terminal.print_json({"calibration": file} | _record(result))
        return
    from calibration.result import text

    show(
        "calibration",
        words=text.WORDS,
        result=result,
        headline=text.headline(result),
        correlations=text.correlation_lines(result),
    )
    report_file = None
    if report and written is not None:
        report_file = written.with_name(parts.REPORT_NAME)
    show("calibration", written=written, report=report_file)


def _record(result: "parts.Calibration") -> dict[str, Any]:
    """Return the calibration as plain data."""

    def posterior(name: str) -> dict[str, Any]:
        return {
            "posterior_mean": result.mean(name),
            "posterior_deviation": result.standard_deviation(name),
            "interval_90": result.interval(name),
        }

    return {
        "asset": result.asset,
        "model": result.model,
        "campaign" if result.design is None else "laboratory": result.source,
        "procedure": result.procedure,
        "explained": result.explained,
        "seed": result.seed,
        "parameters": [
            asdict(prior) | posterior(prior.name) | {"prior_left": result.kept_share(prior.name)}
            for prior in result.priors
        ],
        "quantities": [asdict(figure) | posterior(figure.name) for figure in result.quantities],
        "correlation": result.correlation,
        "information_nat": result.information,
        "readings": result.readings,
        "channels": result.channels,
        "findings": result.findings,
    }


def calibrate_wing(
    *,
    data: Path | None = None,
    out: Path | None = None,
    seed: int = 0,
    asset: str | None = None,
    procedure: Literal["joint", "paper"] = "joint",
    design: Path | None = None,
    measured: bool | None = None,
    fitted: bool = False,
    json: bool = False,
    no_report: bool = False,
) -> None:
    """Tailor the model to one wing: planform, stiffness, masses and damping, in this order.

    A lab folder may hold one step alone; the sub-commands fit ring-downs, make a lab folder of a
    virtual wing, and calibrate any model from a campaign.
    """
    if measured and data is None:
        raise typer.BadParameter("--measured needs --data with ring-down records.")
    if fitted and (data is None or measured is False):
        raise typer.BadParameter(
            "--fitted needs --data with ring-down records, and no --published."
        )
    wing_design = parts.load_design(design)
    name = wing_design.name if asset is None else asset
    if out is not None:
        parts.check_folder(out, name, wing=True)
    targets: Literal["measured", "published"] = "measured" if measured else "published"
    if data is None:
        lab = parts.published_data()
    else:
        lab = parts.read_lab_folder(data, None if measured is None else targets, free=fitted)
    if not json:
        for origin in lab.origins:
            terminal.say(f"Step {origin.step}: {origin.text}.")
    calibration = parts.calibrate(lab, wing_design, asset=name, procedure=procedure, seed=seed)
    if not json:
        from calibration.paper.figures import WORDS

        columns, rows = WORDS.table("table_1", calibration.table_1)
        terminal.print_table([column.name for column in columns], rows)
    written = None
    if out is not None:
        written = parts.write_wing_folder(calibration, out, report=not no_report)
    conclude(calibration.result, written, json=json, report=not no_report)


def calibrate_ringdown(
    *,
    data: Path,
    out: Path | None = None,
    fitted: bool = False,
    extremes: bool = False,
    start: float | None = None,
) -> None:
    """Natural frequencies and damping ratios of two modes from ring-down records."""
    start = parts.FIRST_PEAK if start is None else start
    trials = parts.fit_trials(parts.read_records(data), free=fitted, start=start)
    if extremes:
        trials = parts.refine_by_extremes(trials)
    rows = []
    for mode in (0, 1):
        rows.append(
            RingDownRow(
                f"mode {mode + 1}, natural frequency",
                "Hz",
                parts.average(trials, "frequency", mode),
                parts.PUBLISHED_FREQUENCIES[mode],
            )
        )
        rows.append(
            RingDownRow(
                f"mode {mode + 1}, damping ratio",
                "1",
                parts.average(trials, "damping_ratio", mode),
                parts.PUBLISHED_DAMPING_RATIOS[mode],
            )
        )
    headings = ("figure", "unit", "found", "between trials", "standard error", "paper")
    terminal.print_table(headings, [row.cells(".5g") for row in rows])
    if out is not None:
        columns = zip(*(row.cells(".10g") for row in rows), strict=True)
        table = dict(zip(headings, columns, strict=True))
        atomic_write_text(out / "ringdown.csv", parts.table_text(table))
        parts.save_figure(parts.ring_down_figure(trials), out / "figures", "ringdown")


class RingDownRow(NamedTuple):
    """A figure of a mode from ring-downs, beside the published one.

    Attributes
    ----------
    figure, unit : str
        The name of the figure, and its unit.
    average : tuple of float
        Mean, deviation between trials, and standard error of the mean.
    paper : float
        The published figure.
    """

    figure: str
    unit: str
    average: tuple[float, float, float]
    paper: float

    def cells(self, digits: str) -> tuple[str, ...]:
        """Return the cells of a table, with numbers in a format such as ".5g"."""
        numbers = [format(value, digits) for value in (*self.average, self.paper)]
        return (self.figure, self.unit, *numbers)


TRUTH_FILE = "truth.json"


def calibrate_simulate(
    *,
    out: Path,
    e: float = 1.0073,
    servo_mass: float = 0.169,
    pitot_mass: float = 0.134,
    alpha: float = 1.03,
    beta: float = 0.000766,
    seed: int = 0,
    fmu: Path | None = None,
    design: Path | None = None,
    sampling_rate: float = 2000.0,
    noise: float = 0.0001,
    quantisation: float | None = None,
    frequency_error: tuple[float, float] = (0.0, 0.0),
) -> None:
    """Measure a virtual wing: a folder as `calibrate` reads it, and truth.json beside it."""
    if fmu is not None and frequency_error != (0.0, 0.0):
        raise typer.BadParameter(
            "--frequency-error needs the reduced model; an FMU has its own frequencies."
        )
    if fmu is not None and design is not None:
        raise typer.BadParameter("--fmu and --design exclude each other: the FMU holds its wing.")
    refuse_filled(out)
    wing_design = parts.load_design(design)
    true_values = (e, servo_mass, pitot_mass, alpha, beta)
    state: dict[str, float] = dict(zip(parts.STATE, true_values, strict=True))
    truth = DigitalState(
        wing_design.geometry,
        young_modulus_factor=e,
        servo_mass=servo_mass,
        pitot_mass=pitot_mass,
        damping_alpha=alpha,
        damping_beta=beta,
    )
    if fmu is not None:
        test_bench: Any = parts.FmuTestBench(fmu, truth)
    else:
        model = parts.reduced_model(wing_design)
        test_bench = nullcontext(parts.VirtualWing(model, truth, frequency_error))
    designed_geometry = None if design is None else wing_design.geometry
    with test_bench as bench:
        load_test = parts.measure_load_test(bench, seed)
        records = parts.measure_ring_down(
            bench, seed, sampling_rate=sampling_rate, noise=noise, quantisation=quantisation
        )
        parts.write_lab_folder(
            out,
            load_test=load_test,
            records=records,
            lengths=parts.measure_lengths(truth.geometry, seed, designed=designed_geometry),
            total_mass=parts.weigh(truth, seed),
        )
    known = asdict(wing_design.geometry) | {
        **state,
        "frequency_error": list(frequency_error),
        "seed": seed,
        "bench": "reduced model" if fmu is None else fmu.name,
    }
    atomic_write_text(out / TRUTH_FILE, json_text.dumps(known, indent=2) + "\n")
    terminal.say(f"Laboratory folder: {out}; its truth: {out / TRUTH_FILE}")
