"""The page of a fleet: its assets by health, who needs attention next, what was learnt, what failed.

From nothing but the folder of the fleet, which may still be growing. What it shows does not grow with the
number of assets: a cell of a map for each, and tables of the few that matter.
"""

import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from reporting import figures as style
from reporting.files import atomic_write_text
from reporting.page import Column, Page, Table
from reporting.words import counted
from twin_master.errors import TwinMasterError
from twin_master.fleet.flight import RESULT_NAME, fleet_config
from twin_master.fleet.lessons import LESSONS_NAME
from twin_master.fleet.reading import WITHIN, group_figures, last_turns, leaving, noticed, shown
from twin_master.fleet.store import FAILED, has_flown, open_group
from twin_master.scenario.schema import Scenario

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["REPORT_NAME", "write_fleet_report"]

Float = NDArray[np.float64]

REPORT_NAME = "report.html"
NEXT, FAILURES = 15, 10
"""Rows of the tables of who needs attention next, and of failures."""
LOST = "{} of {} assets failed in flight; their twins end there."
SHORT = "{} of {} assets ended their simulation before the mission was over; what they have flown counts."
BANDS = (
    "Bands hold 90 and 50 % of the assets; the line is the median of the filtered means, "
    "the dash-dotted one that of the true states, where they are known."
)


@dataclass(frozen=True)
class Standing:
    """How B assets of a group stand: turns and alarms (B,), moments of the state (B, F), SI, controls.

    `leaving` (B,) is the probability that a control is left soon; NaN where it is not known.
    """

    scenario: Scenario
    names: list[str]
    turn: NDArray[np.int64]
    mean: Float
    deviation: Float
    control: list[str]
    alarms: NDArray[np.int64]
    leaving: Float


def write_fleet_report(folder: Path | str) -> Path:
    """Write the page of a fleet.

    Raises
    ------
    RunFolderExistsError, FleetError
        The folder holds no fleet.
    FileNotWrittenError
        The disk is full or the folder cannot be written.
    """
    folder = Path(folder)
    fleet = fleet_config(folder)["fleet"]
    result = json.loads((folder / RESULT_NAME).read_text())
    failures, ended = result["failures"], result.get("ended", {})
    groups = {record["name"]: open_group(folder, record["name"]) for record in fleet["groups"]}
    twins = sum(group.sizes["twin"] for group in groups.values())
    page = Page(
        fleet["title"] or fleet["name"],
        f"{counted(twins, 'asset')} in {counted(len(groups), 'group')}, seed {fleet['seed']}",
    )
    page.add_section("The fleet")
    page.add_paragraph(" ".join(_opening(fleet["groups"], groups)))
    _figures(page, groups)
    if failures:
        add_failures(
            page, failures, LOST.format(len(failures), twins), f"All of them stand in {RESULT_NAME}."
        )
    if ended:
        page.add_notice(SHORT.format(len(ended), twins))
    lessons = folder / LESSONS_NAME
    if lessons.is_file():
        page.add_section("Learnt across the fleet")
        add_lessons(page, json.loads(lessons.read_text()))
    for record in fleet["groups"]:
        add_flown_group(page, folder, record, groups[record["name"]], NEXT)
    atomic_write_text(folder / REPORT_NAME, page.render())
    return folder / REPORT_NAME


def _opening(records: list[dict[str, Any]], groups: "dict[str, xr.Dataset]") -> list[str]:
    """Return what a reader wants to know first: how many flew, how the control went, who is worst off."""
    twins = sum(group.sizes["twin"] for group in groups.values())
    flown = {name: has_flown(group["status"].values) for name, group in groups.items()}
    sentences = [f"{sum(map(len, flown.values()))} of {counted(twins, 'asset')} have flown."]
    alarmed = {name: np.flatnonzero(noticed(group, "alarm")) for name, group in groups.items()}
    first = [
        groups[name]["first_notice"].values[rows, 0].min() for name, rows in alarmed.items() if len(rows)
    ]
    if first:
        count, step = sum(map(len, alarmed.values())), next(iter(groups.values())).attrs["step_name"]
        sentences.append(f"{counted(count, 'asset')} raised an alarm, first in {step} {min(first)}.")
    delay = np.concatenate([group["delay"].values[flown[name]] for name, group in groups.items()])
    called = delay[~np.isnan(delay)]
    if len(called):
        share = 100.0 * float(np.mean(called <= WITHIN))
        step = next(iter(groups.values())).attrs["step_name"]
        sentences.append(
            f"In {counted(len(called), 'asset')} the damage called for another control; the fallback came "
            f"within {WITHIN} {step}s of it in {share:.0f} %."
        )
    worst = []
    for record in records:
        group, rows = groups[record["name"]], flown[record["name"]]
        if len(rows):
            last = group["mean"].values[rows, last_turns(group)[rows]]
            row = int(np.argmax(last.sum(axis=1)))
            worst.append((float(last[row].sum()), record, rows[row], last[row]))
    if worst:
        _, record, row, state = max(worst, key=lambda entry: entry[0])
        scenario = Scenario.model_validate(record["scenarios"][0])
        scale, unit = scale_of(scenario)
        believed = [
            f"{factor.title or factor.name} {scale * value:.3g} {unit}"
            for factor, value in zip(scenario.state, state.tolist(), strict=True)
        ]
        sentences.append(
            f"The worst off is {record['members'][row][0]} of {record['name']}: {', '.join(believed)}."
        )
    return sentences


def _figures(page: Page, groups: "dict[str, xr.Dataset]") -> None:
    found = {name: group_figures(group) for name, group in groups.items()}
    titles = dict.fromkeys(title for figures in found.values() for title in figures)
    rows = [[title, *(shown(figures.get(title)) for figures in found.values())] for title in titles]
    columns = [Column("figure"), *(Column(name, numeric=True) for name in found)]
    caption = "Means over the twins that flew to their end, with their standard errors; states in SI."
    page.add_table(Table(columns, rows), caption, title="How the twins fared")


def add_failures(page: Page, failures: dict[str, str], notice: str, caption: str) -> None:
    """Add what ended flights or watches, by cause."""
    page.add_notice(notice)
    kinds = Counter(failures.values()).most_common(FAILURES)
    rows = []
    for sentence, count in kinds:
        names = [name for name, text in failures.items() if text == sentence]
        rows.append([sentence, str(count), ", ".join(names[:3]) + (", ..." if count > 3 else "")])
    columns = [Column("cause"), Column("assets", numeric=True), Column("such as")]
    page.add_table(Table(columns, rows), caption, title="Failures")


def add_lessons(page: Page, record: dict[str, Any]) -> None:
    """Add what was learnt beside what was assumed."""
    rows = []
    for name, group in record["groups"].items():
        for control, rate in group["probability"].items():
            interval = f"{rate['lower_95']:.4f} to {rate['upper_95']:.4f}"
            if not rate["flown"]:
                rows.append(
                    [name, f"probability to worsen, {control}", f"{rate['assumed']:.4f}", "", "not flown"]
                )
                continue
            off = not rate["lower_95"] <= rate["assumed"] <= rate["upper_95"]
            assumed = f"{rate['assumed']:.4f}{' (outside)' if off else ''}"
            rows.append([name, f"probability to worsen, {control}", assumed, f"{rate['mean']:.4f}", interval])
        if group["alarmed"]:
            rows.append([name, "twins with an alarm among them", "", str(group["alarmed"]), ""])
        lines = [("noise over the assumed", "1", group["noise_factor"])]
        if "population" in group:
            told = group["population"]
            lines += [(f"{told['parameter']}, {moment}", "", told[moment]) for moment in ("mean", "spread")]
        for title, assumed, line in lines:
            interval = f"{line['lower_95']:.4g} to {line['upper_95']:.4g}"
            rows.append([name, title, assumed, f"{line['mean']:.4g}", interval])
    heads = ("group", "learnt", "assumed", "mean", "95 % interval")
    columns = [Column(head, numeric=head in heads[2:]) for head in heads]
    caption = "Exact posteriors of all twins together; several groups share a distribution of their rates."
    page.add_table(Table(columns, rows), caption, title="What was learnt beside what was assumed")


def add_flown_group(page: Page, folder: Path, record: dict[str, Any], group: "xr.Dataset", most: int) -> None:
    """Add a group of the store, see `add_group`."""
    scenario, known = Scenario.model_validate(record["scenarios"][0]), group["status"].values
    rows, last = has_flown(known), last_turns(group)
    mean, at = group["mean"].values[rows], (np.arange(len(rows)), last[rows])
    try:
        chance = leaving(folder, record, group)[rows]
    except TwinMasterError as error:
        page.add_paragraph(f"Who leaves its control soon is not known: {error}")
        chance = np.full(len(rows), np.nan)
    control = group["control_index"].values[rows][at]
    standing = Standing(
        scenario, [record["members"][row][0] for row in rows], last[rows], mean[at],
        group["standard_deviation"].values[rows][at], [scenario.control_names[u] for u in control],
        noticed(group, "alarm")[rows], chance,
    )  # fmt: skip
    failed = int(np.sum(known == FAILED))
    add_group(page, record["name"], standing, most, failed, group["state"].values[rows], mean)


def add_group(
    page: Page, name: str, standing: Standing, most: int, failed: int = 0, state: Float | None = None,
    mean: Float | None = None,
) -> None:  # fmt: skip
    """Add a map of a group, bands where all turns are at hand, and so many assets that need attention."""
    page.add_section(f"Group {name}")
    count, scenario = len(standing.names), standing.scenario
    if not count:
        page.add_paragraph("Nothing is known of its assets yet.")
        return
    scale, unit = scale_of(scenario)
    with style.publication_style():
        drawn = map_figure(scenario, scale * standing.mean, failed, unit)
    caption = f"Filtered means, one cell for each asset, the worst first.{grey(failed)}"
    page.add_figure(style.to_svg(drawn), caption, title="The assets by health")
    if state is not None and mean is not None:
        with style.publication_style():
            drawn = course_figure(scenario, scale * mean, scale * state, unit)
        page.add_figure(style.to_svg(drawn), BANDS, title="Health over time")
    soon = np.nan_to_num(standing.leaving)
    order = np.lexsort((-standing.mean.sum(axis=1), -soon, -standing.alarms))[:most]
    rows, told = [], bool(standing.alarms.any())
    for row in order.tolist():
        pairs = zip(scale * standing.mean[row], scale * standing.deviation[row], strict=True)
        states = [
            f"{mean:.1f}\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}{deviation:.1f}" for mean, deviation in pairs
        ]
        alarms = [str(standing.alarms[row] or "")] * told
        change = "" if np.isnan(standing.leaving[row]) else f"{100.0 * soon[row]:.0f}"
        rows.append(
            [standing.names[row], str(standing.turn[row]), *states, standing.control[row], change, *alarms]
        )
    columns = [Column("asset"), Column(scenario.mission.step_name, numeric=True)]
    columns += [Column(factor.name, unit, numeric=True) for factor in scenario.state]
    columns += [Column("control"), Column("change", "%", numeric=True)]
    columns += [*[Column("alarms", numeric=True)] * told]
    caption = (
        f"{len(rows)} of {counted(count, 'asset')}, by {'alarms, then by ' * told}the probability that the "
        f"policy leaves the control within {scenario.mission.prediction_steps} {scenario.mission.step_name}s "
        "(change; of assets with calibrations of their own by one policy), then by the sum of their states."
    )
    page.add_table(Table(columns, rows), caption, title="Who needs attention next")


def scale_of(scenario: Scenario) -> tuple[float, str]:
    """Return what states are multiplied by for people, and their unit then."""
    units = {factor.unit for factor in scenario.state}
    if units == {"1"}:
        return 100.0, "%"
    return 1.0, units.pop() if len(units) == 1 else "SI"


def grey(failed: int) -> str:
    """Return what the grey cells of a map are, where it has some."""
    return f" Grey: {failed} that failed in flight." if failed else ""


def map_figure(scenario: Scenario, last: Float, failed: int, unit: str) -> Figure:
    """Return a map of the assets: (B, F), a panel for each factor."""
    count = len(last) + failed
    wide = max(1, int(np.ceil(np.sqrt(2.0 * count))))
    high = -(-count // wide)
    order = np.argsort(-last.sum(axis=1), kind="stable")
    cells = np.full((last.shape[1], high * wide), np.nan)
    cells[:, : len(last)] = last[order].T
    figure = style.new_figure(0.4 + 1.9 * last.shape[1])
    norm = Normalize(0.0, float(max(factor.levels[-1] for factor in scenario.state)) * scale_of(scenario)[0])
    for number, factor in enumerate(scenario.state):
        axes = figure.add_subplot(last.shape[1], 1, number + 1)
        image = axes.imshow(
            np.ma.masked_invalid(cells[number].reshape(high, wide)),
            cmap=style.LEVELS, norm=norm, aspect="auto", interpolation="nearest",
        )  # fmt: skip
        if failed:
            rest = np.full(high * wide, np.nan)
            rest[len(last) : count] = 1.0
            axes.imshow(
                np.ma.masked_invalid(rest.reshape(high, wide)), cmap="Greys", vmin=0.0, vmax=2.0,
                aspect="auto", interpolation="nearest",
            )  # fmt: skip
        axes.set_xticks([])
        axes.set_yticks([])
        style.panel_label(axes, "abcdefgh"[number % 8], factor.title or factor.name)
        figure.colorbar(image, ax=axes, label=unit)
    figure.tight_layout()
    return figure


def course_figure(scenario: Scenario, mean: Float, state: Float, unit: str) -> Figure:
    """Return bands of the states of B assets over the turns: (B, T, F), true ones NaN where not known."""
    figure = style.new_figure(2.4)
    seen = ~np.isnan(mean).all(axis=(0, 2))
    mean, state, steps = mean[:, seen], state[:, seen], np.flatnonzero(seen)
    for number, factor in enumerate(scenario.state):
        axes = figure.add_subplot(1, len(scenario.state), number + 1)
        low, quarter, middle, three, top = np.nanquantile(
            mean[:, :, number], [0.05, 0.25, 0.5, 0.75, 0.95], axis=0
        )
        for below, above in ((low, top), (quarter, three)):
            axes.fill_between(steps, below, above, color=style.PRESENT, alpha=style.BAND_OPACITY, linewidth=0)
        axes.plot(steps, middle, color=style.PRESENT, label="median of the filtered means")
        true = np.median(state[:, :, number], axis=0)
        axes.plot(
            steps, true, color=style.TRUTH, linewidth=1.0, linestyle=(0, (4, 1.5, 1, 1.5)),
            label="median of the true states",
        )  # fmt: skip
        axes.set_xlabel(scenario.mission.step_name)
        axes.set_ylabel(f"{factor.title or factor.name} ({unit})")
        style.panel_label(axes, "abcdefgh"[number % 8])
    figure.tight_layout()
    return figure
