"""What the search for effects is set to: one record, each number with its reason.

Gates have levels of their own (`gates`, `consistency_gate`): they judge what the search found.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class SearchSettings:
    """Settings of the search; gains and log evidence in nats, sizes in prior deviations."""

    # ---------------------------------------------------------------- what is probable before the
    # data
    prior_none: float = 0.5
    """Probability that nothing is missing: a name has to be earned."""
    set_shares: tuple[float, ...] = (0.97, 0.029, 0.001)
    """How the rest is shared among sets of one, two and three effects.

    Longer ones are not looked for.
    """

    # ---------------------------------------------------------------- what is named
    sure: float = 0.95
    """Probability that a name needs."""
    bayes_factor: float = 3.0
    """ln Bayes factor against 'none' that a name needs."""
    unsure: float = 0.5
    """Probability of 'none' below which the data leave open whether something is missing."""
    largest_group: int = 6
    """Members of a group; more of them say nothing."""

    # ---------------------------------------------------------------- screening: what is worth a
    # fit
    levels: tuple[tuple[float, ...], ...] = (
        (),
        (-1.5, -0.5, 0.5, 1.5),
        (-1.3, 0.0, 1.3),
        (-1.2, 0.0, 1.2),
    )
    """Grid of the scaled parameters that are not a mere scale, by their number from none on."""
    levels_of_many: tuple[float, ...] = (-1.0, 1.0)
    """The same from four on: the grid grows with the power of their number."""
    largest_start: float = 2.5
    """Fits do not begin at larger magnitudes: far off, scales mean little."""
    linear: float = 0.05
    """Signed magnitudes are tried at one prior deviation and at this share of it: what moves
    phases (clock, drift) leaves the range of first order before its shared part is taken up by
    the nuisances."""
    first_order: float = 25.0
    """Squared change of all readings [sigma^2] to which effects are shrunk to see their
    direction."""
    padded: int = 4
    """Zero padding of spectra: lines lie between the frequencies of a record."""
    peaks: int = 3
    """Peaks of a spectrum that are tried."""
    starts: int = 2
    """Starts of the fit of each effect close to the truth."""
    far_starts: int = 2
    """The same far from it, of the best on a grid."""
    far_levels: tuple[int, ...] = (1, 25, 5, 5, 3)
    """Levels of each parameter on it, by their number from none on: friction that ends motions
    has an optimum for every size, and the right one is that narrow."""
    few_places: int = 3
    """Effects with more places than this are those of single channels, which are linear in their
    size."""
    worth_fitting: float = 2.0
    """Screened gain below which an effect is not fitted at all: it could not win a name."""
    worth_adding: float = 4.0
    """The same for one more effect, whose prior is smaller."""
    pairs_fitted: int = 8
    """Pairs that are fitted of all that are screened."""

    # ---------------------------------------------------------------- rough fits
    rough_steps: int = 8
    """Steps of fits that begin where a screen leads."""
    out_of_reach: float = 36.0
    """They end where they have no prospect to come within this of the best: three times `close`."""

    none_steps: int = 20
    """Steps of the fit without effect: far from the truth its valley has no end that is worth
    reaching."""

    # ---------------------------------------------------------------- exact fits
    close: float = 12.0
    """Candidates within this log evidence of the best are fitted exactly: few steps err by less."""
    close_share: float = 0.5
    """The same as a share of what the best gained: far from the truth few steps rank only
    roughly."""
    exact_fits: int = 4
    """Candidates of a scan that are fitted exactly at most."""
    gained_again: float = 5.0
    """A candidate is fitted anew if a rough fit found it better than its exact one by this."""
    hopeless: float = 6.0
    """Single effects this far below 'none' are not fitted exactly."""
    hopeless_longer: float = 2.0
    """Sets with one more effect this far below the set without it are not."""
    rivals: float = 30.0
    """Effects that fit within this log evidence of the best one have families that may overtake
    it."""

    # ---------------------------------------------------------------- far from the truth
    far: float = 1.5
    """Chi-square per sample above which a fit is far from the truth."""
    strained: float = 4.0
    """Prior deviations beyond which a shared unknown says the same."""
    far_fits: int = 6
    """Sets along the missing force that are fitted to the readings."""

    # ---------------------------------------------------------------- named by the missing force
    followed: float = 25.0
    """Sets of effects within this log evidence of the best one, along the missing force, are
    fitted."""
    least_end: float = 0.25
    """Lower end of the share of the missing force that a name in part needs."""
    contenders: float = 12.0
    """Those within this are compared by the share of the missing force that they are."""
    slim: float = 0.01
    """Share of the missing force below which a further effect or a shape of its own is no part
    of a name; three times it where they were fitted, as any freedom gains there."""
    nearly_all: float = 0.9
    """Share of the missing force from which on laws are named without an error of readings
    beside them."""
    force_rival: float = 10.0
    """Log evidence within which another effect is no worse along the missing force, whose motion
    is taken as known: unless trials that were not fitted tell them apart."""

    # ---------------------------------------------------------------- begun from another size
    restart_sizes: tuple[float, ...] = (
        0.5,
        0.56,
        0.63,
        0.71,
        0.8,
        0.87,
        0.93,
        1.0,
        1.07,
        1.15,
        1.25,
        1.4,
        1.6,
        1.8,
        2.0,
    )
    """Sizes, over that which follows the missing force, from which the leading effect is fitted
    again where no fit leaves noise alone: friction that ends a motion has optima an eighth to a
    quarter of it apart."""
    restarts: int = 6
    """Such fits, from the sizes at which least is left.

    The first that leaves noise alone is the last.
    """

    # ---------------------------------------------------------------- weighed with a remainder
    weighed_sets: tuple[int, ...] = (8, 4, 2)
    """Sets of one, two and three effects that may be fitted under the wider noise of what is
    left."""
    weighed_fits: int = 7
    """Of these, how many are at most."""
    weighed_within: float = 60.0
    """Log evidence below the best one from which on they are not: such a fit moves by less."""
    least_share: float = 0.5
    """Share that the interval of a name in part must reach.

    Its lower end too where readings are compared.
    """
    widened: float = 2.0
    """How many times wider the priors of calibrated parameters and gains count for a name in
    part: they take up what is left."""
    told_by_data: float = 0.8
    """Prior deviations below which a shape is known from the data, so that a verdict tells it."""
    sliver: float = 0.004
    """Share of the gap below which one more effect has to earn its place against a remainder."""
    sliver_gain: float = 10.0
    """By how much evidence and prior of a set with such an effect must be above those of the set
    without it: it was chosen among all that may stand there."""
    stand_in_range: float = 3.0
    """Prior deviations beyond which a calibrated parameter is told as far off."""

    # ---------------------------------------------------------------- what is judged is computed
    # finely
    solver_share: float = 0.1
    """Largest share of the noise that the time steps may cost (rms over a channel of a trial)."""
    finest: int = 8
    """How many times smaller than the model's own the time steps may become for it."""
    refitted: int = 3
    """Candidates that are fitted again with smaller steps."""

    @property
    def largest_set(self) -> int:
        """Effects of the largest set that is looked for."""
        return len(self.set_shares)


SEARCH = SearchSettings()
"""The settings that verdicts are reached with; `docs/blind_test.md` measures them."""
