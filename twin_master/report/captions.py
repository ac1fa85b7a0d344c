"""Titles and captions of the figures of a report.

Their texts are templates in `words.toml`; the functions here fill in the fields of the templates.
"""

from importlib import resources

import numpy as np
from matplotlib.figure import Figure

from reporting.arrays import Float
from reporting.pages.page import PageFigure, ReportFigure
from reporting.pages.page_words import Words
from reporting.words import capital, number, parameter_title, small
from twin_master.report.calibration import load_test, parameter_unit, true_value
from twin_master.report.check import PredictiveCheck
from twin_master.report.reading import Run
from twin_master.report.structure import StructurePicture

WORDS = Words("twin_master.report")
"""The texts of the report."""

MISSION_NOW = "mission_now"
"""The name of the figure of past and prediction at a chosen present step."""
MISSION_WHOLE = "mission_whole"
"""The name of the same figure at the last step, with all observations of the mission."""
NETWORK = "network"
"""The name of the drawing of the decision network, which is the same for all runs."""


def state_units(run: Run) -> str:
    """Return the printed units of the factors of the state as one text, without repetitions."""
    units = ["percent" if factor.unit == "%" else factor.unit for factor in run.factors]
    return ", ".join(dict.fromkeys(units))


def caption_mission(run: Run, figure: Figure, present_row: int, name: str) -> ReportFigure:
    """Return a figure of `mission_figure` with its title and caption.

    Parameters
    ----------
    present_row : int
        The row of the present step in the run's arrays, from 0 to T - 1. Its printed number is
        larger by the number of the run's first step.
    name : str
        The name of the figure: `MISSION_NOW` or `MISSION_WHOLE`.
    """
    is_last_step = present_row == run.step_count - 1
    step_number = run.first_step + present_row
    present_step = f"{run.step_word} {step_number}"
    if name == MISSION_NOW:
        title = f"The mission as the twin sees it at {present_step}"
    else:
        title = f"The whole mission, seen from its last {run.step_word}"
    # The template `figures.mission` in `words.toml` joins these fields. At the last step there are
    # no later observations and controls, and the past is smoothed instead of filtered.
    truth_sentence = "The black line is the truth, which the twin never sees."
    report_figure = WORDS.figure(
        "mission",
        figure,
        title=title,
        symbols=", ".join(factor.symbol for factor in run.factors),
        state_units=state_units(run),
        evidence="all observations" if is_last_step else f"the observations up to {present_step}",
        step=run.step_word,
        now=step_number,
        horizon=run.horizon,
        sensor_title=capital(run.sensors.word),
        quantity=run.sensors.quantity,
        unit=run.sensors.unit or "each in its unit",
        past="in hindsight" if is_last_step else "as seen at the time",
        later_observations="" if is_last_step else f"hollow: not yet made at {present_step}; ",
        later_controls="" if is_last_step else "; triangles: flown later",
        decision=_decision_sentence(run, present_row),
        truth="" if run.true_state is None else truth_sentence,
    )
    return report_figure._replace(name=name)


def _decision_sentence(run: Run, present_row: int) -> str:
    """Return the sentence on the control chosen at the end of the step in row `present_row`."""
    probability = run["filtered/decision_probability"][present_row]
    chosen_control = int(np.argmax(probability))
    if run.decides_on_prediction:
        state = f"predicted for that {run.step_word}"
    else:
        state = "as just observed"
    return (
        f"At the end of {run.step_word} {run.first_step + present_row} the twin decided on "
        f"{run.controls[chosen_control]} for the next one: the policy asks for it with probability "
        f"{probability[chosen_control]:.2f} in the state {state}."
    )


def caption_belief(run: Run, figure: Figure) -> ReportFigure:
    """Return the figure of the belief about the state, with its title and caption."""
    units = state_units(run)
    is_truth_known = run.true_state is not None
    if len(run.factors) == 2:
        first_factor, second_factor = run.factors
        report_figure = WORDS.figure(
            "joint_belief",
            figure,
            first=first_factor.symbol,
            second=second_factor.symbol,
            state_units=units,
            step=run.step_word,
            truth="; ring: truth" if is_truth_known else "",
        )
    else:
        report_figure = WORDS.figure(
            "marginal_belief",
            figure,
            state_units=units,
            step=run.step_word,
            truth=" Black line: truth." if is_truth_known else "",
        )
    return report_figure._replace(name="belief")


def caption_learnt(run: Run, figure: Figure) -> ReportFigure:
    """Return the figure of the learnt quantities, with its title and caption."""
    sensor_sentence = (
        f"On the left, the band is that of the {run.sensors.word} in the title, which departs most "
        "from its prior, and grey lines are the means of the others. On the right are all of "
        "them, with their prior as a blue band."
    )
    truth_sentence = "The truth is that of the simulated asset; the twin does not know it."
    has_sensors = any(quantity.is_per_sensor for quantity in run.learnt_quantities)
    has_truth = any(quantity.truth is not None for quantity in run.learnt_quantities)
    return WORDS.figure(
        "learnt",
        figure,
        step=run.step_word,
        sensors=sensor_sentence if has_sensors else "",
        truth=truth_sentence if has_truth else "",
    )


def caption_policy(run: Run, figure: Figure) -> ReportFigure:
    """Return the figure of the policy, with its title and caption."""
    controls = run.controls
    if len(controls) == 1:
        margin = ""
    elif len(controls) == 2:
        margin = (
            f"b: how much more {controls[1]} is worth than {controls[0]} "
            "(action values, dimensionless)."
        )
    else:
        margin = "b: how much more the chosen control is worth than the next best (dimensionless)."
    truth = "" if run.true_state is None else " (black: truth)"
    return WORDS.figure("policy", figure, truth=truth, margin=margin)


def caption_check(run: Run, check: PredictiveCheck, figure: Figure) -> ReportFigure:
    """Return the figure of the posterior predictive check, with its title and caption."""
    lowest_coverage = ""
    if len(check.transform):
        sensor = int(np.nanargmin(check.coverage))
        title = small(run.sensors.titles[sensor])
        lowest_coverage = f"Lowest coverage: {title}, {100.0 * check.coverage[sensor]:.0f} %."
    assumptions = f"a noise of {_assumed_noise(run)}"
    error = assumed_model_error(run)
    if error:
        assumptions += f" and an error of its model of {error} of the predicted value"
    if run.scenario.learning is not None:
        assumptions += ", corrected by what it has learnt about it"
    return WORDS.figure(
        "check",
        figure,
        step=run.step_word,
        sensor=run.sensors.word,
        count=len(check.transform),
        rms=f"{check.standard_deviation:.2f}",
        coverage=f"{100 * check.overall_coverage:.1f}",
        lowest_coverage=lowest_coverage,
        assumptions=assumptions,
    )


def _assumed_noise(run: Run) -> str:
    """Return the assumed noise with its unit.

    If the sensors differ in noise or unit, the noise of each sensor is listed.
    """
    sensors = run.sensors
    noise = np.asarray(run.scenario.observation.standard_deviation)
    is_common = noise.ndim == 0 and bool(sensors.unit)
    if is_common:
        return f"{sensors.scale * float(noise):.4g} {sensors.unit}"
    noise_of_sensors: Float = np.broadcast_to(noise, run.scenario.observation.count)
    texts = []
    for value, unit, title in zip(
        noise_of_sensors.tolist(), sensors.units, sensors.titles, strict=True
    ):
        texts.append(f"{sensors.scale * value:.4g} {unit} ({small(title)})")
    return ", ".join(texts)


def assumed_model_error(run: Run) -> str:
    """Return the assumed relative error of the model in percent, or its range; empty if it is 0."""
    error = 100.0 * np.asarray(run.scenario.observation.model_error)
    low = float(error.min())
    high = float(error.max())
    if high == 0.0:
        return ""
    return f"{low:.3g} %" if low == high else f"{low:.3g} to {high:.3g} %"


def caption_calibration(run: Run, figure: Figure) -> ReportFigure:
    """Return the figure of the calibration, with its title and caption."""
    draws = run["calibration/draw_value"]
    unit = parameter_unit(run)
    truth = true_value(run)
    truth_sentence = ""
    if truth is not None:
        truth_sentence = f"The asset flown has {number(truth)}, which the twin does not know."
    test = load_test(run)
    load_test_sentence = ""
    if test is not None:
        load_test_sentence = (
            f"a: {len(test.load)} measured pairs of load and displacement, and the calibrated tip "
            f"stiffness {test.stiffness:.1f} ± {test.stiffness_deviation:.1f} N/m "
            "(band: two standard deviations). b:"
        )
    return WORDS.figure(
        "calibration",
        figure,
        before_flight=" before the flight" if run.learnt_quantities else "",
        load_test=load_test_sentence,
        parameter=parameter_title(run.scenario.calibration.parameter),
        unit="dimensionless" if unit == "1" else unit,
        draw_count=len(draws),
        mean=number(float(draws.mean())),
        standard_deviation=number(float(draws.std())),
        truth=truth_sentence,
    )


def caption_mesh(run: Run, picture: StructurePicture) -> ReportFigure:
    """Return the picture of a structure's mesh, with its title and caption."""
    report_figure = WORDS.figure(
        "mesh",
        picture.figure,
        step=run.step_word,
        scale=f"{picture.scale:.3g}",
        largest=f"{1e3 * picture.largest:.3g}",
        sensor=run.sensors.word,
    )
    return report_figure._replace(name="structure")


def caption_planform(run: Run, figure: Figure) -> ReportFigure:
    """Return the picture of a wing from above, with its title and caption."""
    report_figure = WORDS.figure("planform", figure, step=run.step_word, sensor=run.sensors.word)
    return report_figure._replace(name="structure")


def network_figure(run: Run) -> PageFigure:
    """Return the decision network, whose drawing is a file, with its title and caption."""
    if run.decides_on_prediction:
        deciding_belief = "the belief predicted from its observation"
    else:
        deciding_belief = "the belief that its observation updated"
    texts = WORDS.words("figures", NETWORK, step=run.step_word, deciding_belief=deciding_belief)
    drawing = resources.files(__package__).joinpath("network.svg").read_bytes()
    return PageFigure(NETWORK, drawing, **texts)
