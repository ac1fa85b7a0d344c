"""`uav-twin calibrate`: all three steps of a wing; `ringdown`, `simulate` and `campaign`."""

import json as json_text
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import typer

from reporting import terminal
from reporting.files import atomic_write_text, refuse_filled
from reporting.terminal import LARGEST_SEED, JsonOption, NoReportOption
from uav_twin.discrepancy_commands import use_one_thread
from uav_twin.options import CampaignArgument, DesignOption, SampleSeedOption, complete_model

if TYPE_CHECKING:
    from calibration.result.record import Calibration
    from calibration.virtual_wing import TestBench
    from fe.runtime.state import DigitalState
    from fe.wing.design import WingDesign


def calibrate_campaign(
    campaign: CampaignArgument,
    *,
    model: Annotated[
        str | None,
        typer.Option(
            "--model",
            show_default="the shipped wing",
            autocompletion=complete_model,
            help=(
                "The model file of an FMU or a structure, a lumped model, a wing design: the same "
                "as for `discrepancy run`."
            ),
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for calibration.nc and report.")
    ] = None,
    asset: Annotated[
        str | None,
        typer.Option(
            "--asset", show_default="that of the campaign", help="Name of what was measured."
        ),
    ] = None,
    samples: Annotated[
        int,
        typer.Option("--samples", min=100, max=100000, help="Samples that are kept."),
    ] = 1000,
    seed: SampleSeedOption = 0,
    json: JsonOption = False,
    no_report: NoReportOption = False,
) -> None:
    """Estimate the parameters of any model, an FMU or a structure too, from a campaign.

    Example: `uav-twin calibrate campaign measured --model single_mass_rig --out calibrated`
    """
    from calibration.result.file import check_folder
    from calibration.result.folder import write_calibration_folder
    from calibration.result.record import check_name
    from discrepancy.campaign.reading import read_campaign
    from discrepancy.model_choice import choose_model
    from discrepancy.parameters.calibration import calibrate_parameters

    use_one_thread()
    data = read_campaign(campaign)
    name = check_name(data.name if asset is None else asset)
    if out is not None:
        check_folder(out, name, wing=False)
    chosen_model = choose_model(model)
    result = calibrate_parameters(data, chosen_model, asset=name, samples=samples, seed=seed)
    written_file = None
    if out is not None:
        written_file = write_calibration_folder(result, out, report=not no_report)
    print_calibration(result, written_file, json=json, report=not no_report)


def print_calibration(
    result: "Calibration",
    written_file: Path | None,
    *,
    json: bool,
    report: bool,
) -> None:
    """Print the posterior of a calibration, and the files that were written.

    Parameters
    ----------
    written_file : Path or None
        The file of the calibration, if one was written.
    report : bool
        Whether a report was written beside the file.
    """
    if json:
        file = None if written_file is None else str(written_file)
        terminal.print_json({"calibration": file} | _calibration_record(result))
        return
    from calibration.result.text import printed_calibration

    terminal.show(printed_calibration(result))
    if written_file is None:
        terminal.say("Nothing was written: give --out DIR for calibration.nc and the report.")
        return
    from calibration.result.folder import REPORT_NAME

    terminal.say(f"Calibration: {written_file}")
    if report:
        terminal.say(f"Report: {written_file.with_name(REPORT_NAME)}")


def _calibration_record(result: "Calibration") -> dict[str, Any]:
    """Return a calibration as plain data for JSON: parameters, quantities, and their origin."""
    # Only a wing has a design. It is calibrated from a laboratory's folder, and every other model
    # from a campaign.
    name_of_source = "campaign" if result.design is None else "laboratory"

    def posterior(name: str) -> dict[str, Any]:
        return {
            "posterior_mean": result.mean(name),
            "posterior_deviation": result.standard_deviation(name),
            "interval_90": result.interval(name),
        }

    return {
        "asset": result.asset,
        "model": result.model,
        name_of_source: result.source,
        "procedure": result.procedure,
        "explained": result.explained,
        "seed": result.seed,
        "parameters": [
            asdict(prior)
            | posterior(prior.name)
            | {"prior_left": result.posterior_over_prior(prior.name)}
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
    data: Annotated[
        Path | None,
        typer.Option(
            "--data",
            help=(
                "Laboratory folder with some or all of step1, step2 and step3; published figures "
                "for the others."
            ),
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", help="Folder for calibration.nc, report and figures."),
    ] = None,
    seed: SampleSeedOption = 0,
    asset: Annotated[
        str | None,
        typer.Option("--asset", show_default="that of the design", help="Name of this wing."),
    ] = None,
    design: Annotated[
        Path | None,
        typer.Option("--design", help="The wing as drawn; the shipped design by default."),
    ] = None,
    measured: Annotated[
        bool | None,
        typer.Option(
            "--measured/--published",
            show_default="measured where there are records",
            help="Aim step 3 at the ring-down records of --data or at the published figures.",
        ),
    ] = None,
    fitted: Annotated[
        bool,
        typer.Option(
            "--fitted",
            help="Fit the frequencies of the records too; spectral peaks by default.",
        ),
    ] = False,
    json: JsonOption = False,
    no_report: NoReportOption = False,
) -> None:
    """Tailor the model to one wing: planform, stiffness, masses and damping, in this order.

    A lab folder may hold one step alone. The sub-commands fit ring-downs,
    make a lab folder of a virtual wing, and calibrate any model from a campaign.

    Example: `uav-twin calibrate --data laboratory --out calibrated`
    """
    from calibration.result.file import check_folder
    from calibration.wing.calibrate import calibrate
    from calibration.wing.lab_data import published_data, read_lab_folder
    from calibration.wing.report import write_wing_folder
    from fe.wing.design import load_design

    if measured and data is None:
        raise typer.BadParameter("--measured needs --data with ring-down records.")
    if fitted and (data is None or measured is False):
        raise typer.BadParameter(
            "--fitted needs --data with ring-down records, and no --published."
        )
    wing_design = load_design(design)
    name = wing_design.name if asset is None else asset
    if out is not None:
        check_folder(out, name, wing=True)
    targets: Literal["measured", "published"] = "measured" if measured else "published"
    if data is None:
        lab = published_data()
    else:
        lab = read_lab_folder(
            data, None if measured is None else targets, frequencies_fitted=fitted
        )
    if not json:
        for origin in lab.origins:
            terminal.say(f"Step {origin.step}: {origin.text}.")
    calibration = calibrate(lab, wing_design, asset=name, seed=seed)
    written_file = None
    if out is not None:
        written_file = write_wing_folder(calibration, out, report=not no_report)
    print_calibration(calibration.result, written_file, json=json, report=not no_report)


def calibrate_ringdown(
    *,
    data: Annotated[
        Path,
        typer.Option("--data", help="Ring-down records: the authors' folder, or one file."),
    ],
    out: Annotated[Path | None, typer.Option("--out", help="Folder for table and figures.")] = None,
    fitted: Annotated[
        bool,
        typer.Option(
            "--fitted",
            help="Fit the frequencies too; by default those of the spectral peaks.",
        ),
    ] = False,
    extremes: Annotated[
        bool,
        typer.Option(
            "--extremes",
            help="Fit the extremes of records read off a plot, not the middle.",
        ),
    ] = False,
    start: Annotated[
        float | None,
        typer.Option(
            "--start",
            min=0.0,
            help="Time at which records are cropped, in seconds; the first peak by default.",
        ),
    ] = None,
) -> None:
    """Estimate natural frequencies and damping ratios of two modes from ring-downs.

    Example: `uav-twin calibrate ringdown --data laboratory/step3 --out ringdown`
    """
    from calibration.dynamics.extremes import refine_by_extremes
    from calibration.dynamics.figures import ring_down_figure
    from calibration.dynamics.records import read_records
    from calibration.dynamics.trials import (
        FIRST_PEAK,
        PUBLISHED_DAMPING_RATIOS,
        PUBLISHED_FREQUENCIES,
        average,
        fit_trials,
    )
    from reporting.formats.table_file import table_text
    from reporting.pages.figures import save_figure
    from reporting.pages.page import ReportFigure

    start = FIRST_PEAK if start is None else start
    trials = fit_trials(read_records(data), frequencies_fitted=fitted, start=start)
    if extremes:
        trials = refine_by_extremes(trials)
    rows = []
    for mode in (0, 1):
        rows.append(
            RingDownRow(
                f"mode {mode + 1}, natural frequency",
                "Hz",
                average(trials, "frequency", mode),
                PUBLISHED_FREQUENCIES[mode],
            )
        )
        rows.append(
            RingDownRow(
                f"mode {mode + 1}, damping ratio",
                "1",
                average(trials, "damping_ratio", mode),
                PUBLISHED_DAMPING_RATIOS[mode],
            )
        )
    headings = ("figure", "unit", "found", "between trials", "standard error", "paper")
    terminal.print_table(headings, [row.cells(".5g") for row in rows])
    if out is not None:
        columns = zip(*(row.cells(".10g") for row in rows), strict=True)
        table = dict(zip(headings, columns, strict=True))
        atomic_write_text(out / "ringdown.csv", table_text(table))
        picture = ReportFigure("ringdown", ring_down_figure(trials), title="", caption="")
        save_figure(picture, out / "figures")


class RingDownRow(NamedTuple):
    """A value that ring-downs give for a mode, beside the published one.

    Attributes
    ----------
    figure, unit : str
        The name of the value, and its unit.
    average : tuple of float
        The mean over the trials, the standard deviation between trials, and the standard error of
        the mean.
    paper : float
        The published value.
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
    out: Annotated[
        Path, typer.Option("--out", help="Folder to write; it must be empty or not exist.")
    ],
    e: Annotated[float, typer.Option("--e", help="True Young's modulus factor.")] = 1.0073,
    servo_mass: Annotated[
        float, typer.Option("--servo-mass", help="True mass of each servo, in kg.")
    ] = 0.169,
    pitot_mass: Annotated[
        float, typer.Option("--pitot-mass", help="True mass of the pitot tube, in kg.")
    ] = 0.134,
    alpha: Annotated[
        float, typer.Option("--alpha", help="True mass-proportional damping, in 1/s.")
    ] = 1.03,
    beta: Annotated[
        float, typer.Option("--beta", help="True stiffness-proportional damping, in seconds.")
    ] = 0.000766,
    seed: Annotated[
        int, typer.Option("--seed", min=0, max=LARGEST_SEED, help="Seed of all errors.")
    ] = 0,
    fmu: Annotated[
        Path | None,
        typer.Option(
            "--fmu",
            help="Do the experiments on this wing FMU, not on the reduced model; of the shipped "
            "planform.",
        ),
    ] = None,
    design: DesignOption = None,
    sampling_rate: Annotated[
        float,
        typer.Option(
            "--sampling-rate",
            help="Samples per second of a ring-down record; the published have 100000.",
        ),
    ] = 2000.0,
    noise: Annotated[
        float,
        typer.Option("--noise", min=0.0, help="Noise of a record [V], standard deviation."),
    ] = 0.0001,
    quantisation: Annotated[
        float | None,
        typer.Option("--quantisation", help="Step of the recorder [V]; none by default."),
    ] = None,
    frequency_error: Annotated[
        tuple[float, float],
        typer.Option(
            "--frequency-error",
            help="Relative differences of the wing's f1 and f2 from its model's; not with --fmu.",
        ),
    ] = (0.0, 0.0),
) -> None:
    """Measure a virtual wing: a folder as `calibrate` reads it, and truth.json beside it.

    Example: `uav-twin calibrate simulate --out laboratory --e 1.02 --seed 3`
    """
    from calibration.virtual_wing import (
        measure_lengths,
        measure_load_test,
        measure_ring_down,
        weigh,
    )
    from calibration.wing.lab_data import write_lab_folder
    from fe.runtime.state import DigitalState
    from fe.wing.design import load_design

    if fmu is not None and frequency_error != (0.0, 0.0):
        raise typer.BadParameter(
            "--frequency-error needs the reduced model; an FMU has its own frequencies."
        )
    if fmu is not None and design is not None:
        raise typer.BadParameter("--fmu and --design exclude each other: the FMU holds its wing.")
    refuse_filled(out)
    wing_design = load_design(design)
    truth = DigitalState(
        wing_design.geometry,
        young_modulus_factor=e,
        servo_mass=servo_mass,
        pitot_mass=pitot_mass,
        damping_alpha=alpha,
        damping_beta=beta,
    )
    # Do the three experiments on the virtual wing
    if fmu is None:
        test_bench = _bench_of_reduced_model(wing_design, truth, frequency_error)
    else:
        test_bench = _bench_of_fmu(fmu, truth)
    designed_geometry = None if design is None else wing_design.geometry
    with test_bench as bench:
        load_test = measure_load_test(bench, seed)
        records = measure_ring_down(
            bench, seed, sampling_rate=sampling_rate, noise=noise, quantisation=quantisation
        )
        write_lab_folder(
            out,
            load_test=load_test,
            records=records,
            lengths=measure_lengths(truth.geometry, seed, designed=designed_geometry),
            total_mass=weigh(truth, seed),
        )
    bench_name = "reduced model" if fmu is None else fmu.name
    _write_truth(out / TRUTH_FILE, truth, frequency_error, seed, bench_name)
    terminal.say(f"Laboratory folder: {out}; its truth: {out / TRUTH_FILE}")


def _bench_of_reduced_model(
    design: "WingDesign", truth: "DigitalState", frequency_error: tuple[float, float]
) -> "AbstractContextManager[TestBench]":
    """Return a context with a test bench that measures the reduced model of a wing.

    `frequency_error` are the relative differences of the true first two natural frequencies from
    those of the model.
    """
    from calibration.virtual_wing import VirtualWing
    from fe.reduction.model_cache import reduced_model

    return nullcontext(VirtualWing(reduced_model(design), truth, frequency_error))


def _bench_of_fmu(fmu: Path, truth: "DigitalState") -> "AbstractContextManager[TestBench]":
    """Return a context with a test bench that measures the FMU of a wing."""
    from twin_master.assets.virtual_experiments import FmuTestBench

    return FmuTestBench(fmu, truth)


def _write_truth(
    path: Path,
    truth: "DigitalState",
    frequency_error: tuple[float, float],
    seed: int,
    bench_name: str,
) -> None:
    """Write the true parameters of a virtual wing, and how it was measured, as JSON."""
    record = asdict(truth.geometry) | {
        "young_modulus_factor": truth.young_modulus_factor,
        "servo_mass": truth.servo_mass,
        "pitot_mass": truth.pitot_mass,
        "damping_alpha": truth.damping_alpha,
        "damping_beta": truth.damping_beta,
        "frequency_error": list(frequency_error),
        "seed": seed,
        "bench": bench_name,
    }
    atomic_write_text(path, json_text.dumps(record, indent=2) + "\n")
