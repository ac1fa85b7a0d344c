"""The page as HTML: figures without data, made by Bokeh. `view.js` fills them, `view.css` places them."""

import html
import json
import math
from collections.abc import Sequence
from importlib import resources

import numpy as np
from bokeh.document import Document
from bokeh.embed.util import standalone_docs_json_and_render_items
from bokeh.models import (
    BasicTicker,
    ColorBar,
    ColumnDataSource,
    DataRange1d,
    HoverTool,
    LinearColorMapper,
    Range1d,
    Span,
)
from bokeh.palettes import Cividis256
from bokeh.plotting import figure

from reporting import figures as style
from twin_master.report.view import capital
from twin_master.viewer.scene import Planform, Scene

TALLEST_BAR = 0.82
"""Height of a probability of one, where a control has a row of height one."""
_DAMAGE = tuple(
    "#{:02x}{:02x}{:02x}".format(*(round(255 + share * (end - 255)) for end in (0xD5, 0x5E, 0x00)))
    for share in np.linspace(0.0, 1.0, 64)
)
"""From white to the vermilion of Okabe and Ito."""


Titled = tuple[str, figure]
"""A figure and what stands above it."""


class _Figures:
    """The figures of a page; they share their sources of data and the axis of turns."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.turns = Range1d(-1, scene.horizon + 1, name="turns")
        factors = [f"state{k}" for k in range(len(scene.factors))]
        courses = [*factors, *(f"reward{k}" for k in range(len(scene.rewards))), "chosen"]
        bands = [f"{name}{part}" for name in courses for part in ("", "_lower", "_upper")]
        truths = [f"{name}_truth" for name in factors]
        self.past = _source("past", ["turn", *bands, *truths, "chosen_observed"])
        self.present = _source("present", ["turn", *bands])
        self.ahead = _source("ahead", ["turn", *bands])

    def new(self, unit: str, height: int, **options: object) -> figure:
        """Return an empty figure over the turns, or over `x_range` where that is given."""
        options.setdefault("x_range", self.turns)
        result = figure(
            height=height, sizing_mode="stretch_width", tools="", toolbar_location=None,
            min_border_right=12, **options,
        )  # fmt: skip
        result.yaxis.axis_label = unit
        result.yaxis.axis_label_text_font_style = "normal"
        result.xgrid.grid_line_color = None
        result.outline_line_color = None
        result.axis.minor_tick_line_color = None
        return result

    def course(self, name: str, unit: str, height: int, *, truth: bool = False) -> figure:
        """Return past and prediction of one quantity, with bands."""
        result = self.new(unit, height)
        result.y_range = DataRange1d(range_padding=0.12, only_visible=True)
        for source, color, dash in (
            (self.past, style.PRESENT, "solid"),
            (self.ahead, style.PREDICTION, "dashed"),
        ):
            result.varea(
                "turn", f"{name}_lower", f"{name}_upper", source=source, color=color,
                alpha=style.BAND_OPACITY,
            )  # fmt: skip
            line = result.line("turn", name, source=source, color=color, line_width=2, line_dash=dash)
        result.scatter("turn", name, source=self.ahead, color=style.PREDICTION, size=4)
        if truth:
            result.line(
                "turn",
                f"{name}_truth",
                source=self.past,
                color=style.TRUTH,
                line_width=1.2,
                line_dash="dotdash",
            )
        result.scatter("turn", name, source=self.present, color=style.PRESENT, size=9, marker="diamond")
        self._hover(result, [line], name, unit)
        return result

    def _hover(self, plot: figure, lines: list[object], name: str, unit: str) -> None:
        turn = self.scene.step_name
        columns = [(turn, "@turn"), (f"mean ({unit})", f"@{name}{{0.[000]}}")]
        columns.append(("95 %", f"@{name}_lower{{0.[000]}} to @{name}_upper{{0.[000]}}"))
        plot.add_tools(HoverTool(renderers="auto", tooltips=columns, mode="vline", attachment="vertical"))

    def states(self) -> list[Titled]:
        """Return a figure for each factor of the state."""
        result = []
        for number, factor in enumerate(self.scene.factors):
            plot = self.course(f"state{number}", f"{factor.symbol} ({factor.unit})", 175, truth=True)
            margin = 0.06 * (factor.highest - factor.lowest) or 1.0
            plot.y_range = Range1d(factor.lowest - margin, factor.highest + margin)
            result.append((factor.title, plot))
        return result

    def control(self) -> list[Titled]:
        """Return the controls: flown, decided with a probability, and predicted."""
        controls = self.scene.controls
        plot = self.new("", 50 + 55 * len(controls))
        plot.y_range = Range1d(-0.06, len(controls) + 0.04)
        for name, color in (("decided", style.DECISION), ("expected", style.PREDICTION)):
            source = _source(name, ["turn", "bottom", "top", "probability", "control"])
            bars = plot.vbar(
                "turn", top="top", bottom="bottom", width=0.8, source=source, color=color, line_color=None,
                fill_alpha=0.75,
            )  # fmt: skip
            columns = [
                (self.scene.step_name, "@turn"),
                ("control", "@control"),
                ("probability", "@probability{0.000}"),
            ]
            plot.add_tools(HoverTool(renderers=[bars], tooltips=columns))
        flown = _source("flown", ["left", "right", "row"])
        plot.segment("left", "row", "right", "row", source=flown, color=style.TRUTH, line_width=4)
        middle = [row + TALLEST_BAR / 2 for row in range(len(controls))]
        plot.yaxis.ticker = middle
        plot.yaxis.major_label_overrides = dict(zip(middle, controls, strict=True))
        plot.yaxis.major_tick_line_color = None
        plot.ygrid.grid_line_color = None
        for row in range(len(controls)):
            plot.add_layout(Span(location=row, dimension="width", line_color=style.REFERENCE, line_width=0.6))
        return [("Control: flown (line), probability of the choice (bars)", plot)]

    def rewards(self) -> list[Titled]:
        """Return a figure for each reward."""
        return [
            (f"{capital(name)} reward", self.course(f"reward{number}", "reward", 140))
            for number, name in enumerate(self.scene.rewards)
        ]

    def sensors(self) -> list[Titled]:
        """Return all sensors at the turn shown: what was expected, and what came."""
        sensors, count = self.scene.sensors, len(self.scene.sensors.titles)
        plot = self.new(f"{sensors.quantity} ({sensors.unit})", 215, x_range=Range1d(0.4, count + 0.6))
        plot.y_range = DataRange1d(range_padding=0.1)
        source = _source("sensors", ["number", "title", "mean", "lower", "upper", "observed", "outside"])
        bars = plot.vbar(
            "number", top="upper", bottom="lower", width=0.62, source=source, color=style.PRESENT,
            fill_alpha=style.BAND_OPACITY + 0.1, line_color=None,
        )  # fmt: skip
        plot.scatter(
            "number", "mean", source=source, marker="dash", size=11, color=style.PRESENT, line_width=2
        )
        plot.scatter("number", "observed", source=source, size=5, color=style.OBSERVED)
        plot.scatter(
            "number", "outside", source=source, size=11, marker="square", fill_alpha=0.0,
            color=style.PREDICTION, line_width=2,
        )  # fmt: skip
        columns = [(sensors.word, "@title"), ("observed", "@observed{0.[00]}"), ("expected", "@mean{0.[00]}")]
        columns.append(("95 %", "@lower{0.[00]} to @upper{0.[00]}"))
        plot.add_tools(HoverTool(renderers=[bars], tooltips=columns))
        plot.xaxis.ticker = BasicTicker(min_interval=1)
        plot.xaxis.axis_label = f"{sensors.word} (square: outside its interval)"
        plot.xaxis.axis_label_text_font_style = "normal"
        title = f"All {sensors.word}s at this {self.scene.step_name}: expected, 95 %, and observed"
        return [(title, plot)]

    def chosen(self) -> list[Titled]:
        """Return the sensor that the user chose, over the turns."""
        sensors = self.scene.sensors
        plot = self.course("chosen", f"{sensors.quantity} ({sensors.unit})", 210)
        plot.scatter("turn", "chosen_observed", source=self.past, size=4, color=style.OBSERVED)
        return [(f"One {sensors.word} over the {self.scene.step_name}s", plot)]

    def wing(self, planform: Planform) -> list[Titled]:
        """Return the wing from above, coloured by expected damage and measured strain."""
        (left, lowest), (right, highest) = planform.outline.min(axis=0), planform.outline.max(axis=0)
        margin = 0.03 * (right - left)
        plot = self.new(
            "", 230,
            x_range=Range1d(left - margin, right + margin),
            y_range=Range1d(lowest - margin, highest + margin),
        )  # fmt: skip
        plot.patch(*planform.outline.T, color="#f2f4f6", line_color=style.REFERENCE)
        sensors, factors = self.scene.sensors, self.scene.factors
        if planform.regions:
            corners = {
                "x": [region[:, 0].tolist() for region in planform.regions],
                "y": [region[:, 1].tolist() for region in planform.regions],
                "middle_x": [float(region[:, 0].mean()) for region in planform.regions],
                "top_y": [float(region[:, 1].max()) for region in planform.regions],
                "loss": [factor.lowest for factor in factors],
                "said": ["" for _ in factors],
            }
            regions = ColumnDataSource(corners, name="regions")
            lowest_loss, highest_loss = min(f.lowest for f in factors), max(f.highest for f in factors)
            damage = LinearColorMapper(palette=_DAMAGE, low=lowest_loss, high=highest_loss)
            plot.patches(
                "x",
                "y",
                source=regions,
                fill_color={"field": "loss", "transform": damage},
                line_color=style.TRUTH,
            )
            plot.text(
                "middle_x", "top_y", text="said", source=regions, text_align="center", text_baseline="bottom",
                text_font_size="12px", y_offset=-2,
            )  # fmt: skip
            _color_bar(plot, damage, f"expected loss ({factors[0].unit})")
        places = ColumnDataSource(
            {
                "x": planform.gauges[:, 0].tolist(),
                "y": planform.gauges[:, 1].tolist(),
                "title": list(sensors.titles),
                # Not None, which is drawn as zero: until the first turn nothing is known, and nothing lost.
                "observed": [math.nan] * len(planform.gauges),
                "lost": [math.nan] * len(planform.gauges),
            },
            name="places",
        )
        strain = LinearColorMapper(
            palette=Cividis256, low=min(sensors.lowest, 0.0), high=sensors.highest, nan_color="#ffffff"
        )
        dots = plot.scatter(
            "x", "y", source=places, size=11, line_color=style.TRUTH, line_width=0.6,
            fill_color={"field": "observed", "transform": strain},
        )  # fmt: skip
        plot.scatter("x", "lost", source=places, size=9, marker="x", color=style.TRUTH, line_width=2)
        plot.add_tools(
            HoverTool(renderers=[dots], tooltips=[("gauge", "@title"), (sensors.quantity, "@observed{0.0}")])
        )
        _color_bar(plot, strain, f"{sensors.quantity} ({sensors.unit})")
        plot.axis.visible = False
        plot.grid.visible = False
        return [("The wing from above: damage of the regions, measured strain of the gauges", plot)]


def _source(name: str, columns: Sequence[str]) -> ColumnDataSource:
    return ColumnDataSource({column: [] for column in columns}, name=name)


def _color_bar(plot: figure, mapper: LinearColorMapper, title: str) -> None:
    bar = ColorBar(
        color_mapper=mapper, height=8, title=title, orientation="horizontal", padding=2, margin=4,
        title_text_font_size="11px", title_text_font_style="normal", bar_line_color=style.REFERENCE,
        ticker=BasicTicker(desired_num_ticks=4), major_label_text_font_size="10px", title_standoff=2,
    )  # fmt: skip
    plot.add_layout(bar, "below")


def page_html(scene: Scene, record: object) -> str:
    """Return the page.

    Parameters
    ----------
    scene : Scene
        What it shows.
    record : JSON object
        What its script must know before the first turn.
    """
    figures = _Figures(scene)
    parts = {
        "wing": [] if scene.planform is None else figures.wing(scene.planform),
        "health": figures.states(),
        "control": figures.control(),
        "sensors": figures.sensors(),
        "chosen": figures.chosen(),
        "rewards": figures.rewards(),
    }
    document = Document()
    for plots in parts.values():
        for _, plot in plots:
            document.add_root(plot)
    documents, items = standalone_docs_json_and_render_items(list(document.roots))
    described = [item.to_json() for item in items]
    roots = {model: place for item in described for model, place in item["roots"].items()}
    filled = {
        name: "".join(
            f"<figure><figcaption>{html.escape(title)}</figcaption>"
            f'<div class="plot" id="{roots[plot.id]}" data-root-id="{plot.id}"></div></figure>'
            for title, plot in plots
        )
        for name, plots in parts.items()
    }
    options = "".join(
        f'<option value="{number}">{html.escape(title)}</option>'
        for number, title in enumerate(scene.sensors.titles)
    )
    content = {"documents": documents, "items": described, "scene": record}
    template = resources.files(__package__).joinpath("page.html").read_text(encoding="utf-8")
    for name, text in {
        **filled,
        "title": html.escape(scene.title),
        "step": html.escape(scene.step_name),
        "word": html.escape(scene.sensors.word),
        "options": options,
        # Inside a script element only the beginning of a tag could end it.
        "content": json.dumps(content, allow_nan=False).replace("<", "\\u003c"),
    }.items():
        template = template.replace(f"{{{{{name}}}}}", text)
    return template
