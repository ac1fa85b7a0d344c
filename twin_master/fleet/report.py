"""The page of a fleet: its assets by health, who needs attention next, what was learnt, what failed.

From nothing but the folder of the fleet, which may still be growing. What it shows does not grow with the
number of assets: a cell of a map for each, and tables of the few that matter. The same page follows a fleet
in the browser: while it flies, while it is watched, or afterwards.
"""

import json
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from reporting import figures as style
from reporting.arrays import Float
from reporting.errors import ReportingError
from reporting.files import atomic_write_text
from reporting.page import Page, PageColumn, Words, number_column
from twin_master.errors import FleetError, TwinMasterError
from twin_master.fleet.flight import KIND, WATCHED_KIND, fleet_config, told_of
from twin_master.fleet.learn import LESSONS_NAME, lesson_rows
from twin_master.fleet.reading import (
    believed_means,
    figure_rows,
    group_figures,
    last_steps,
    leaving,
    noticed,
    severity,
)
from twin_master.fleet.store import ENDED, FAILED, NOTICE_KINDS, WITHIN, has_flown, open_group
from twin_master.fleet.watching import STATE_NAME, counts_of, read_standing
from twin_master.mission.journal import JOURNAL_NAME
from twin_master.report.reading import printed_factors
from twin_master.run_folder import find_config
from twin_master.scenario.schema import Scenario
from twin_master.viewer.server import serve_page, text_of

if TYPE_CHECKING:
    import xarray as xr


WORDS = Words("twin_master.fleet")
REPORT_NAME = "report.html"
NEXT, FAILURES = 15, 10
"""Rows of the tables of who needs attention next, and of failures."""


@dataclass(frozen=True)
class Standing:
    """How B assets of a group stand: steps and alarms (B,), moments of the state (B, F), SI, controls.

    Moments are NaN where no state is believed. `leaving` (B,) is the probability that a control is left soon;
    NaN where it is not known.
    """

    group: str
    scenario: Scenario
    names: list[str]
    step: NDArray[np.int64]
    mean: Float
    deviation: Float
    control: list[str]
    alarms: NDArray[np.int64]
    leaving: Float

    @property
    def severity(self) -> Float:
        """How badly off each is (B,)."""
        return severity(self.scenario, self.mean)

    @property
    def worst(self) -> int | None:
        """The row of the asset that is worst off; None where no state is believed of any."""
        if np.isnan(self.severity).all():
            return None
        return int(np.nanargmax(self.severity))


def write_fleet_report(folder: Path | str) -> Path:
    """Write the page of a fleet.

    Raises
    ------
    RunFolderError
        The folder holds no fleet.
    FileNotWrittenError
        The disk is full or the folder cannot be written.
    """
    return atomic_write_text(Path(folder) / REPORT_NAME, fleet_page(Path(folder), NEXT))


def fleet_page(folder: Path, most: int) -> str:
    """Return the page of a fleet as it stands, with so many assets in the table of who needs attention next.

    Raises
    ------
    RunFolderError
        The folder holds no fleet.
    FleetError
        It is damaged.
    """
    config = fleet_config(folder, KIND, WATCHED_KIND)
    watched, fleet = config["kind"] == WATCHED_KIND, config["fleet"]
    members = sum(len(group.get("members", ())) for group in fleet["groups"])  # of a watch they are not known
    groups = len(fleet["groups"])
    page = Page(
        fleet["title"] or fleet["name"],
        WORDS.say("subtitle", assets=members, groups=groups, seed=fleet["seed"], watched=watched),
    )
    page.add_section("The fleet")
    before = f"{folder} is damaged or of another version ("
    with FleetError.instead_of(KeyError, TypeError, AttributeError, before=before, after=")."):
        (_add_watched if watched else _add_flown)(page, folder, fleet["groups"], most)
    return page.render()


def _add_flown(page: Page, folder: Path, records: list[dict[str, Any]], most: int) -> None:
    groups = {record["name"]: open_group(folder, record["name"]) for record in records}
    found = [_flown(record, groups[record["name"]]) for record in records]
    page.add_paragraph(_opening(found, [*groups.values()]))
    figures = {name: group_figures(group) for name, group in groups.items()}
    WORDS.add_table(page, "fared", figure_rows(figures), more=list(figures))
    status = np.concatenate([group["status"].values for group in groups.values()])
    _add_failures(page, told_of(folder)["failures"], "lost", assets=len(status))
    if ended := int(np.sum(status == ENDED)):
        page.add_notice(WORDS.say("short", ended=ended, assets=len(status)))
    _add_lessons(page, folder)
    for record, standing in zip(records, found, strict=True):
        group = groups[record["name"]]
        flown = has_flown(group["status"].values)
        page.add_section(f"Group {record['name']}")
        try:
            standing = replace(standing, leaving=leaving(folder, record, group)[flown])
        except TwinMasterError as error:
            page.add_paragraph(WORDS.say("unknown", error=error))
        failed = int(np.sum(group["status"].values == FAILED))
        courses = believed_means(group)[flown], group["state"].values[flown]
        _add_group(page, standing, most, failed, courses)


def _flown(record: dict[str, Any], group: "xr.Dataset") -> Standing:
    """Return how the twins of a group stood after their last step, but for what they would do next."""
    scenario, flown = Scenario.model_validate(record["scenarios"][0]), has_flown(group["status"].values)
    at = flown, last_steps(group)[flown]
    return Standing(
        record["name"], scenario, [record["members"][row][0] for row in flown], at[1],
        believed_means(group)[at], group["standard_deviation"].values[at],
        [scenario.control_names[u] for u in group["control_index"].values[at]],
        noticed(group, "alarm")[flown], np.full(len(flown), np.nan),
    )  # fmt: skip


def _opening(found: list[Standing], groups: "list[xr.Dataset]") -> str:
    """Return what a reader wants to know first: how many flew, how the control went, who is worst off."""
    delay = np.concatenate([group["delay"].values for group in groups])
    first = np.concatenate([group["first_notice"].values[:, NOTICE_KINDS.index("alarm")] for group in groups])
    alarmed = first[first >= 0]
    called = delay[~np.isnan(delay)]
    known = [one for one in found if one.worst is not None]
    worst = max(known, key=lambda one: np.nanmax(one.severity), default=None)
    row = None if worst is None else worst.worst
    return WORDS.say(
        "opening", flown=sum(len(one.names) for one in found), assets=len(delay),
        alarmed=len(alarmed), first=min(alarmed, default=0),
        called=len(called), share=float(np.mean(called <= WITHIN)) if len(called) else 0.0, within=WITHIN,
        step=found[0].scenario.mission.step_name, worst=worst, row=row,
        states=[] if worst is None else zip(printed_factors(worst.scenario), worst.mean[row], strict=True),
    )  # fmt: skip


def _add_watched(page: Page, folder: Path, groups: list[dict[str, Any]], most: int) -> None:
    record = read_standing(folder)
    known, failures = record["assets"], record["failures"]
    told = {name: asset for name, asset in known.items() if asset["last"] is not None}
    page.add_highlights([(str(count), title) for title, count in counts_of(record).items()])
    _add_failures(page, failures, "not_watched", assets=len(known | failures))
    if silent := sorted(known.keys() - told.keys() - failures.keys()):
        page.add_notice(WORDS.say("silent", names=silent, most=most))
    _add_lessons(page, folder)
    for group in groups:
        scenario, prefix = Scenario.model_validate(group["scenarios"][0]), f"{group['name']}/"
        own = {name.removeprefix(prefix): told[name] for name in told if name.startswith(prefix)}
        last = [asset["last"] for asset in own.values()]
        mean, deviation = (
            np.array(
                [[one["health"][name][moment] for name in scenario.state_names] for one in last], np.float64
            )
            for moment in ("mean", "standard_deviation")
        )
        step, control = np.array([one["step"] for one in last]), [one["control"] for one in last]
        alarmed = np.array([asset["alarms"] for asset in own.values()], np.int64)
        chance = np.array([asset["leaving"] for asset in own.values()], np.float64)
        page.add_section(f"Group {group['name']}")
        _add_group(
            page,
            Standing(group["name"], scenario, [*own], step, mean, deviation, control, alarmed, chance),
            most,
        )


def _add_failures(page: Page, failures: Mapping[str, str], notice: str, assets: int) -> None:
    """Add what ended flights or watches, by cause; nothing without any."""
    if failures:
        page.add_notice(WORDS.say(notice, failed=len(failures), assets=assets))
    rows = []
    for sentence, count in Counter(failures.values()).most_common(FAILURES):
        names = [name for name, text in failures.items() if text == sentence]
        rows.append([sentence, str(count), ", ".join(names[:3]) + (", ..." if count > 3 else "")])
    WORDS.add_table(page, "failures", rows, watched=notice == "not_watched")


def _add_lessons(page: Page, folder: Path) -> None:
    """Add what was learnt across the fleet beside what was assumed, where it has been learnt."""
    path = folder / LESSONS_NAME
    if not path.is_file():
        return
    page.add_section("Learnt across the fleet")
    WORDS.add_table(page, "lessons", lesson_rows(json.loads(path.read_text())))


def _add_group(
    page: Page, standing: Standing, most: int, failed: int = 0, courses: tuple[Float, Float] | None = None
) -> None:
    """Add a map of a group, bands where all steps are at hand, and so many assets that need attention."""
    count, scenario = len(standing.names), standing.scenario
    if not count:
        page.add_paragraph(WORDS.say("nothing"))
        return
    page.add_report_figure(WORDS.figure("map", map_figure(scenario, standing.mean, failed), failed=failed))
    if courses is not None and not np.isnan(courses[0]).all():
        page.add_report_figure(WORDS.figure("course", course_figure(scenario, *courses)))
    factors, soon = printed_factors(scenario), np.rint(100.0 * np.nan_to_num(standing.leaving))
    severity_first = np.nan_to_num(standing.severity, nan=np.inf)  # of no state that is believed
    order = np.lexsort((-severity_first, -soon, -standing.alarms))[:most].tolist()
    rows, told = [], bool(standing.alarms.any())
    for row in order:
        states = [
            _moments(factor.scale * mean, factor.scale * deviation)
            for factor, mean, deviation in zip(
                factors, standing.mean[row], standing.deviation[row], strict=True
            )
        ]
        change = "" if np.isnan(standing.leaving[row]) else f"{soon[row]:.0f}"
        alarms = [str(standing.alarms[row] or "")] * told
        rows.append(
            [standing.names[row], str(standing.step[row]), *states, standing.control[row], change, *alarms]
        )
    more = [
        number_column(state.name, factor.unit) for state, factor in zip(scenario.state, factors, strict=True)
    ]
    more += [PageColumn("control"), number_column("change", "%"), *[number_column("alarms")] * told]
    WORDS.add_table(
        page, "next", rows, more=more, shown=len(rows), assets=count, alarms=told, mission=scenario.mission
    )


def _moments(mean: float, deviation: float) -> str:
    """Return the cell of a table with mean and standard deviation; NaN where no state is believed."""
    if np.isnan(mean):
        return "not believed"
    return f"{mean:.1f}\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}{deviation:.1f}"


@style.publication_style()
def map_figure(scenario: Scenario, last: Float, failed: int) -> Figure:
    """Return a map of the assets, the last means (B, F) of which are given: a panel for each factor."""
    factors, count = printed_factors(scenario), len(last) + failed
    wide = max(1, int(np.ceil(np.sqrt(2.0 * count))))
    high = -(-count // wide)
    order = np.argsort(-severity(scenario, last), kind="stable")
    figure, rows = style.panels(
        len(factors), 1, 0.4 + 1.9 * len(factors), 0.3, 0.1, left=0.07, right=0.99, hspace=0.25
    )
    for number, (factor, (axes,)) in enumerate(zip(factors, rows, strict=True)):
        cells = np.full(high * wide, np.nan)
        cells[: len(last)] = factor.scale * last[order, number]
        look: dict[str, Any] = {"aspect": "auto", "interpolation": "nearest"}
        there = np.where(np.arange(high * wide) < count, 1.0, np.nan).reshape(high, wide)
        axes.imshow(there, cmap="Greys", vmin=0.0, vmax=2.0, **look)
        image = axes.imshow(
            np.ma.masked_invalid(cells.reshape(high, wide)), cmap=style.LEVELS,
            vmin=factor.levels[0], vmax=factor.levels[-1], **look,
        )  # fmt: skip
        axes.set_xticks([])
        axes.set_yticks([])
        style.panel_label(axes, "abcdefgh"[number % 8], factor.title)
        # On the left, where a narrow screen shows it.
        style.color_bar(figure, image, factor.unit, ax=axes, location="left", pad=0.02, fraction=0.03)
    return figure


@style.publication_style()
def course_figure(scenario: Scenario, mean: Float, state: Float) -> Figure:
    """Return bands of the states of B assets over the steps: (B, T, F), true ones NaN where not known."""
    factors = printed_factors(scenario)
    figure, (row,) = style.panels(1, len(factors), 2.4, 0.3, 0.45, wspace=0.25)
    steps = np.flatnonzero(~np.isnan(mean).all(axis=(0, 2)))
    for number, (factor, axes) in enumerate(zip(factors, row, strict=True)):
        own, true = (factor.scale * values[:, steps, number] for values in (mean, state))
        low, quarter, middle, three, top = np.nanquantile(own, [0.05, 0.25, 0.5, 0.75, 0.95], axis=0)
        style.band(axes, steps, low, top, style.PRESENT)
        style.band(axes, steps, quarter, three, style.PRESENT)
        axes.plot(steps, middle, color=style.PRESENT, label="median of the filtered means")
        known = ~np.isnan(true).all(axis=0)  # of some, where assets have ended
        median = np.nanmedian(true[:, known], axis=0)
        axes.plot(steps[known], median, **style.TRUTH_LINE, label="median of the true states")
        axes.set_xlabel(scenario.mission.step_name)
        axes.set_ylabel(f"{factor.title} ({factor.unit})")
        style.panel_label(axes, "abcdefgh"[number % 8])
    return figure


WORST = 50
"""Assets in the table."""


def is_fleet(folder: Path) -> bool:
    """Return whether a folder is that of a fleet, flown or watched."""
    return find_config(folder, KIND, WATCHED_KIND) is not None


def serve_fleet(
    folder: Path, port: int, ready: Callable[[str], None], wanted: Callable[[], bool] = lambda: True
) -> None:
    """Show a fleet to browsers of this machine, as `viewer.server.serve` shows a flight."""
    seen, version, html = _stamp(folder), 0, fleet_page(folder, WORST)

    def current() -> str:
        """Make the page again where the fleet has changed; what cannot be read is looked at again."""
        nonlocal seen, version, html
        with suppress(TwinMasterError, ReportingError, OSError, ValueError):  # it was just being written
            if (stamp := _stamp(folder)) != seen:
                html = fleet_page(folder, WORST)
                seen, version = stamp, version + 1
        return str(version)

    def page() -> str:
        tag = f'<script src="/view.js" data-version="{current()}"></script></body>'
        return html.replace("</body>", tag)

    texts = {
        "/": (page, "text/html"),
        "/version": (current, "text/plain"),
        "/view.js": (text_of("twin_master.fleet", "view.js"), "text/javascript"),
    }
    serve_page(texts, port, ready, wanted)


def _stamp(folder: Path) -> list[tuple[str, int, int]]:
    paths = [folder / name for name in (JOURNAL_NAME, STATE_NAME, LESSONS_NAME)]
    stats = [(path.name, path.stat()) for path in paths if path.is_file()]
    return [(name, stat.st_mtime_ns, stat.st_size) for name, stat in stats]
