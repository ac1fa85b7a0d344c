"""Pictures for notebooks: the belief and the residuals of a run, and the states of a fleet.

They are drawn from the stored arrays alone, as `open_run` and `open_fleet` return them.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol, cast

import numpy as np

from reporting.arrays import Float
from reporting.pages.notebook import new_panels
from twin_master.scenario.section import printed_state

if TYPE_CHECKING:  # both take long to import
    import xarray as xr
    from matplotlib.axes import Axes

LARGEST_SHOWN = 4.0
"""Larger residuals have the colour of this one [standard deviations]."""


class HasTree(Protocol):
    """A result with the stored arrays of a run, such as `fly` returns."""

    @property
    def tree(self) -> "xr.DataTree":
        """All groups of `run.nc`."""


def plot_belief(
    run: "xr.DataTree | HasTree", axes: "Axes | Sequence[Axes] | None" = None
) -> "list[Axes]":
    """Draw the believed state over the steps, with the truth where it is known.

    Each factor of the state has a panel with the mean and two standard deviations of the belief
    p(D_t | o_0..o_t), within the range of the factor's levels.

    Parameters
    ----------
    run : DataTree or RunOutcome
        The results of a run, from `open_run` or `fly`.
    axes : Axes or sequence of Axes, optional
        A panel for each factor; new ones of pyplot by default.

    Returns
    -------
    list of Axes
        The panels.

    Raises
    ------
    ValueError
        If another number of panels was given.
    """
    from reporting.pages import figures as style

    tree = _tree_of(run)
    filtered_group = tree["filtered"].to_dataset()
    policy = tree["policy"].to_dataset()
    truth = tree["truth"].to_dataset() if "truth" in tree.children else {}
    names = [str(name) for name in filtered_group["region"].values]
    steps = filtered_group["step"].values
    panels = new_panels(len(names), axes)
    for panel, name in zip(panels, names, strict=True):
        scale, unit = printed_state(policy[name].attrs.get("units", "1"))
        mean = scale * filtered_group["mean"].sel(region=name).values
        deviation = scale * filtered_group["standard_deviation"].sel(region=name).values
        levels = scale * policy[name].values
        lower = np.clip(mean - 2.0 * deviation, levels.min(), levels.max())
        upper = np.clip(mean + 2.0 * deviation, levels.min(), levels.max())
        style.band(panel, steps, lower, upper, style.PRESENT)
        panel.plot(steps, mean, color=style.PRESENT, label="believed, with two standard deviations")
        if "state" in truth:
            true_state = scale * truth["state"].sel(region=name).values
            panel.plot(steps, true_state, **style.TRUTH_LINE, label="truth")
        panel.set_ylabel(f"{name} ({unit})")
    panels[0].legend(frameon=False)
    panels[-1].set_xlabel("step")
    return panels


def plot_residuals(run: "xr.DataTree | HasTree", axes: "Axes | None" = None) -> "Axes":
    """Draw the residuals of each gauge, measured minus expected, over the steps.

    The residual is in the standard deviations that the twin assumes: if the model holds, 95 % of
    all cells are between -2 and 2. Cells of lost readings are grey.

    Parameters
    ----------
    run : DataTree or RunOutcome
        The results of a run, from `open_run` or `fly`.
    axes : Axes, optional
        The panel; a new one of pyplot by default.

    Returns
    -------
    Axes
        The panel.
    """
    from reporting.pages import figures as style

    residual = _tree_of(run)["filtered"].to_dataset()["residual"]
    (panel,) = new_panels(1, axes)
    panel.set_facecolor("#c8c8c8")
    colours = style.RESIDUALS.copy()
    colours["vmin"] = -LARGEST_SHOWN
    colours["vmax"] = LARGEST_SHOWN
    image = panel.pcolormesh(
        residual["step"].values,
        np.arange(1, residual.sizes["sensor"] + 1),
        np.ma.masked_invalid(residual.transpose("sensor", "step").values),
        **colours,
    )
    panel.set_xlabel("step")
    panel.set_ylabel("number of the gauge")
    figure = panel.get_figure()
    assert figure is not None
    panel.set_title("measured less expected", loc="left")
    figure.colorbar(image, ax=panel, extend="both", label="standard deviations")
    return panel


def plot_courses(fleet: "xr.DataTree", axes: "Axes | Sequence[Axes] | None" = None) -> "list[Axes]":
    """Draw the believed states of the twins of a fleet over the steps.

    Each factor of the state of each group has a panel. It shows the medians over the twins of the
    believed and of the true states, and the bands of 50 % and 90 % of the believed ones.

    Parameters
    ----------
    fleet : DataTree
        The store of the fleet, from `open_fleet`.
    axes : Axes or sequence of Axes, optional
        A panel for each factor of each group; new ones of pyplot by default.

    Returns
    -------
    list of Axes
        The panels.
    """
    rows = []
    for group_name, group in fleet.children.items():
        for factor in group["filtered"].to_dataset()["region"].values:
            rows.append((group_name, str(factor)))
    panels = new_panels(len(rows), axes)
    for panel, (group_name, factor) in zip(panels, rows, strict=True):
        group = fleet.children[group_name]
        stored_unit = str(group["filtered"].to_dataset()["mean"].attrs["units"])
        has_one_unit = ", " not in stored_unit  # factors may differ in their unit
        scale, unit = printed_state(stored_unit) if has_one_unit else (1.0, "SI")
        believed_states = group["filtered"].to_dataset()["mean"].sel(region=factor).values
        true_states = group["truth"].to_dataset()["state"].sel(region=factor).values
        draw_states_of_twins(panel, scale * believed_states, scale * true_states)
        panel.set_ylabel(f"{factor}, {unit}")
        panel.set_title(group_name, loc="left")
        panel.set_xlabel(group.attrs["step_name"])
    panels[0].legend(frameon=False)
    return panels


def draw_states_of_twins(axes: "Axes", believed: Float, truth: Float) -> None:
    """Draw one factor of the states of B twins over T steps.

    Bands hold 50 % and 90 % of the believed states; lines are the medians of the believed and of
    the true states.

    Parameters
    ----------
    believed : (B, T) array
        The mean states; NaN in steps that were not flown.
    truth : (B, T) array
        The true states; NaN where they are not known.
    """
    from reporting.pages import figures as style

    steps = np.flatnonzero(~np.isnan(believed).all(axis=0))
    quantiles = np.nanquantile(believed[:, steps], [0.05, 0.25, 0.5, 0.75, 0.95], axis=0)
    low, lower_quartile, medians, upper_quartile, high = quantiles
    style.band(axes, steps, low, high, style.PRESENT)
    style.band(axes, steps, lower_quartile, upper_quartile, style.PRESENT)
    axes.plot(steps, medians, color=style.PRESENT, label="believed, median of the twins")
    known_steps = np.flatnonzero(~np.isnan(truth).all(axis=0))
    true_medians = np.nanmedian(truth[:, known_steps], axis=0)
    axes.plot(known_steps, true_medians, **style.TRUTH_LINE, label="truth, median of the twins")


def _tree_of(run: "xr.DataTree | HasTree") -> "xr.DataTree":
    """Return the arrays of a run.

    Raises
    ------
    TypeError
        If neither arrays nor the result of a run were given.
    """
    tree: object = getattr(run, "tree", run)
    if not hasattr(tree, "children"):
        raise TypeError(
            "A run is needed, as `uav_twin.open_run` or `uav_twin.fly` returns it, but a "
            f"{type(run).__name__} was given: open a folder with `uav_twin.open_run`."
        )
    return cast("xr.DataTree", tree)
