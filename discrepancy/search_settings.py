"""Settings of the search for effects and of the verdict on it, each number with its reason.

Statistical tests have levels of their own (`gates`, `consistency_gate`).
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class SearchSettings:
    """Settings of the search; gains and log evidence in nats, scaled values in prior deviations."""

    # ---------------------------------------------------------------- what is probable before the
    # data
    prior_none: float = 0.5
    """Probability that nothing is missing: a name has to be earned."""
    set_probabilities: tuple[float, ...] = (0.97, 0.029, 0.001)
    """Fractions of the remaining probability for sets of one, two and three effects.

    Larger sets are not searched.
    """

    # ---------------------------------------------------------------- what is named
    name_probability: float = 0.95
    """Least probability of a named set of effects."""
    least_log_bayes_factor: float = 3.0
    """Least log Bayes factor of a named set against 'none'."""
    inconclusive_probability: float = 0.5
    """Probability of 'none' below which the data leave open whether something is missing."""
    largest_group: int = 6
    """Most members of a group; a larger group would say nothing."""

    # ---------------------------------------------------------------- screening: what is worth a
    # fit
    grid_levels: tuple[tuple[float, ...], ...] = (
        (),
        (-1.5, -0.5, 0.5, 1.5),
        (-1.3, 0.0, 1.3),
        (-1.2, 0.0, 1.2),
    )
    """Grid of the scaled parameters other than magnitudes, by the number of such parameters."""
    grid_levels_if_many: tuple[float, ...] = (-1.0, 1.0)
    """The same grid for four or more of them: its size grows exponentially with their number."""
    least_start: float = -5.6
    largest_start: float = 2.5
    """Least and largest scaled magnitude at which fits begin; farther out, scales mean little."""
    small_magnitude: float = 0.05
    """Signed magnitudes are tried at one prior deviation and at this fraction of it.

    An effect that shifts phases (clock, drift) is nonlinear at one deviation, before nuisances can
    compensate for the part that they share with it."""
    first_order_change: float = 25.0
    """Squared change of all readings [noise variances] to which an effect is reduced, so that its
    direction can be computed to first order."""
    zero_padding: int = 4
    """Factor of zero padding of spectra, because lines lie between the frequencies of a record."""
    most_peaks: int = 3
    """Peaks of a spectrum that are tried."""
    starts_near_data: int = 2
    """Points from which each effect is fitted, if the model is close to the data."""
    starts_far_from_data: int = 2
    """The same if the model is far from the data; the starts are the best points of a grid."""
    grid_levels_far_from_data: tuple[int, ...] = (1, 25, 5, 5, 3)
    """Levels of each parameter on that grid, by the number of parameters that are varied.

    The grid is fine, because friction that ends motions has many local optima over its magnitude,
    and the right one is narrow."""
    coarse_level_step: int = 5
    """Step between the levels of that grid that are tried first at each of many places."""
    places_with_near_levels: int = 10
    """Number of places, the best at these levels, at which the levels next to the best of them are
    tried, too."""
    first_periods: float = 4.0
    """Number of periods of the first mode in which the best of many places are chosen."""
    places_far_from_data: int = 3
    """Number of these best places, at which fits begin; without errors of a mesh, all levels are
    tried there first."""
    small_remainder: float = 0.05
    """Fraction of the squared residuals of the model without effect. If a set with an effect that
    may act at several places leaves less, no further places are tried beside it."""
    few_places: int = 3
    """Largest number of places of an effect that is tried at a small magnitude, too. Effects with
    more places mostly concern single channels, and are linear in their magnitude."""
    least_gain_to_fit: float = 2.0
    """Screened gain below which an effect is not fitted at all: it could not win a name."""
    least_gain_to_add: float = 4.0
    """The same for a further effect in a set, whose prior probability is smaller."""
    most_fitted_pairs: int = 8
    """Most pairs of effects that are fitted, of all that are screened."""

    # ---------------------------------------------------------------- rough fits
    rough_fit_iterations: int = 8
    """Iterations of a rough fit, which begins at the result of a screen."""
    largest_rough_deficit: float = 36.0
    """A rough fit ends early if its objective will not come this close to the best one: three times
    `exact_fit_range`."""

    no_effect_iterations: int = 20
    """Most iterations of the fit without effects.

    If the model is far from the data, the minimum lies in a long valley and is not worth
    reaching."""

    # ---------------------------------------------------------------- exact fits
    exact_fit_range: float = 12.0
    """Candidates this close to the best log evidence are fitted exactly; rough fits err by less."""
    exact_fit_share: float = 0.5
    """The same range as a fraction of the best gain, since rough fits of a poor model err more; the
    larger of both ranges counts."""
    most_exact_fits: int = 4
    """Most candidates that are fitted exactly after effects were fitted roughly."""
    refit_gain: float = 5.0
    """Log evidence by which a rough fit must exceed the exact fit for a candidate to be fitted
    again."""
    largest_single_deficit: float = 6.0
    """Single effects whose score is this far below 'none' are not fitted exactly."""
    largest_longer_set_deficit: float = 2.0
    """Sets whose score is this far below that with one effect fewer are not fitted exactly."""

    # ---------------------------------------------------------------- far from the truth
    far_chi_square: float = 1.5
    """Chi-squared per sample above which a model counts as far from the data."""
    far_prior_deviations: float = 4.0
    """Distance of a shared unknown from its prior mean, in prior deviations, above which the model
    counts as far, too."""

    mesh_error: float = 0.005
    """Relative error of a reading that the mesh of a structure causes, half of that of a frequency.

    It widens intervals, and a second effect has to explain more than it does."""

    # ---------------------------------------------------------------- named by the missing force
    least_low_end: float = 0.25
    """Least lower end of the fraction of the missing force that a partly named set explains."""
    contender_range: float = 12.0
    """Sets within this range of the best score are compared by the fraction of the missing force
    that they explain."""
    least_added_share: float = 0.01
    """Least fraction of the gap that a further effect or a free shape must add.

    In fitted trials it must add three times as much, because any further parameter gains there."""
    nearly_complete_share: float = 0.9
    """Fraction of the gap in held-out trials that a hypothesis surely explains, above which it may
    leave more than noise there and still be named."""
    force_rival_range: float = 10.0
    """Another hypothesis within this range of the best score counts as equal, unless its share of
    the gap is significantly smaller."""

    # ---------------------------------------------------------------- weighed with a remainder
    most_weighed_sets: tuple[int, ...] = (8, 4, 2)
    """Most sets of one, two and three effects that are considered for a fit under the noise of a
    remainder."""
    most_weighed_fits: int = 7
    """Most of these sets that are fitted in all."""
    weighed_range: float = 60.0
    """Sets whose expected score is farther below the best one are not fitted: such a fit changes it
    by less."""
    proving_share: float = 0.75
    """Fraction of the missing force, by the lower end of its interval, and of the mean square error
    of held-out trials that a force of free shape must explain to be proved by them."""
    least_gap_share: float = 0.5
    """Fraction of the gap that the interval of a partly named set must reach.

    If hypotheses are compared by simulations, the lower end of the interval must reach it, too.
    """
    prior_widening: float = 2.0
    """Factor by which priors of calibrated parameters and gains count as wider for a partly named
    set, because these explain part of the remainder."""
    determined_shape_deviation: float = 0.8
    """Posterior deviation of a shape parameter, in prior deviations, below which a verdict reports
    it."""
    negligible_share: float = 0.004
    """Fraction of the gap up to which a further effect explains hardly anything."""
    least_gain_of_negligible_effect: float = 10.0
    """Least gain of the score by such an effect over the set without it.

    It is high because the effect was chosen among many."""
    reported_prior_deviations: float = 3.0
    """Distance from the prior mean, in deviations, of a calibrated parameter that is reported."""

    # ---------------------------------------------------------------- what is judged is computed
    # finely
    largest_step_error: float = 0.1
    """Largest error by the time steps, over the noise (rms over a channel of a trial)."""
    largest_step_reduction: int = 8
    """Largest factor by which the time steps are made smaller than the model's own."""
    most_refitted: int = 3
    """Number of candidates that are fitted again with smaller steps."""

    @property
    def largest_set(self) -> int:
        """Number of effects in the largest set that is searched."""
        return len(self.set_probabilities)


SEARCH = SearchSettings()
"""The settings of all searches and verdicts; `docs/explanation/blind_test.md` measures them."""
