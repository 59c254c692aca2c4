"""Every number by which a diagnosis is tuned, in one table, with the reason beside each.

Read by all stages from the intake to the judgement, and reads nothing itself. Lengths of time are in s, rates in rad/s;
shares are of 1. What describes a single effect stands in that effect's own file, and levels of the model's own
parameters in `effects.base`.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class IntakeSettings:
    """What a recording must hold before it may say anything, and how it is repaired."""

    #: Recordings are laid so far apart in time that no instant stands in two of them, s.
    apart_s: float = 1e5
    #: Shorter recordings say too little of friction and of slow motion, s.
    least_s: float = 1.5
    #: Fewer rows leave no noise to compare with.
    least_rows: int = 300
    #: The way must be so many times the encoder's step, or its noise.
    least_counts: int = 40
    #: Share of the rows in motion: an axis at rest shows its bristle alone.
    least_moving: float = 0.03
    #: Longest time between rows, s: friction and inertia of a servo axis act within milliseconds.
    coarsest_s: float = 0.1
    #: Noise that the slowest observer makes of the encoder's, as a share of dry friction, that hides everything.
    most_noise: float = 0.5
    #: Time around the instant at which a drive goes off or on that does not count, s.
    around_off_s: float = 0.1
    #: Steps of the thermometer that a temperature must change by: its last digit flickers between two or three.
    least_steps_warm: float = 3.0
    #: This share of the command's spread counts for dry friction where it is more.
    noise_of_command: float = 0.3
    #: Share of rows at the end of the command's range from which a recording is refused as saturated,
    saturated: float = 0.4
    #: where the motion in them needs so many times what is recorded.
    needs_more: float = 1.1
    #: The same share from which it is noted.
    noted_saturated: float = 0.02
    #: Share of rows as one of their neighbours from which a command is of steps, and at no limit.
    held: float = 0.9
    #: A row that leaves its neighbours by so many noises and comes back is a glitch,
    glitch_noises: float = 30.0
    #: if it is as many usual steps as well: a fast motion is none.
    glitch_steps: float = 8.0
    #: A factor by which a unit is off at least: no model of the right axis is so wrong.
    wrong_unit: float = 5.0
    #: A factor on what moves by which no model is off, whatever else it leaves out: no mass is looked for so far away.
    no_model: float = 100.0
    #: By how much the factors of inertia and of friction may differ and be one unit.
    same_unit: float = 3.0
    #: Standard errors from which a factor in the command is certain; a refusal must not be a matter of chance.
    certain_errors: float = 8.0
    #: So many rows of the command count as one independent row.
    correlated_rows: float = 20.0
    #: Share of the command that must be understood before sign or unit are judged.
    understood: float = 0.5


@dataclass(frozen=True)
class ExcitationSettings:
    """From when on the motion shows the axis's inertia, and both its directions."""

    #: Inertia must take this share of the command (root mean squares) before effects of swift motion can be told.
    least_inertial: float = 0.15
    #: The same on an axis that goes both ways, whose command swings with its friction: less will do.
    least_both_ways: float = 0.02
    #: Share of the rows, at most, in which an axis that creeps may do otherwise: it had to get there.
    otherwise: float = 0.05
    #: Share of the rows that must go either way before one direction can be told from the other.
    least_either_way: float = 0.05
    #: Share of a high speed from which a row goes a way.
    moving_speed: float = 0.1


@dataclass(frozen=True)
class ObserverSettings:
    """The observer that pulls a model to the encoder: fast enough to see friction, slow enough for the noise."""

    #: Lowest bandwidth, rad/s: a slower observer shows no friction any more.
    slowest: float = 25.0
    #: Highest bandwidth, rad/s: from here on more shows noise only. What the encoder allows lies between the two.
    fastest: float = 200.0
    #: The bandwidth's share of the sampling rate, at most.
    share_of_sampling: float = 0.1
    #: The same up to `slow_sampling`: where rows are rare, a slower observer shows less than its noise is worth.
    most_of_sampling: float = 0.33
    #: Bandwidth up to which that share may go, rad/s.
    slow_sampling: float = 50.0
    #: The same where the axis creeps: a slower observer carries a model along that sticks and slips.
    share_creeping: float = 0.35
    #: Share of the command that encoder noise may make where most of the command's power is beyond that bandwidth.
    swift_noise: float = 0.02
    #: Share of dry friction that encoder noise may make of the mismatch; sets the bandwidth.
    wanted_noise: float = 0.006
    #: Damping of the observer's poles.
    poles_damping: float = 0.8
    #: The observer's damping over the rate with which falling friction makes the model's errors grow.
    over_growth: float = 1.2
    #: Longest step of the model, s.
    longest_step_s: float = 0.0013
    #: Steps of a row around reversals, where friction turns over within a sample or two.
    steps_at_reversal: int = 4
    #: Factor on the number of steps behind a gap, whose contact is stiff.
    steps_in_gap: int = 2
    #: Share of the motor's correction that a load behind a spring gets: all of it would ring.
    load_share: float = 0.6
    #: The same behind a gap.
    load_share_in_gap: float = 1.0
    #: Innovations below this many noises of the encoder carry the model's friction nowhere.
    quiet_noises: float = 5.0
    #: Time constants of the observer that pass before a row behind a start counts: what is left of it is 1e-5 then.
    settling: float = 15.0
    #: A gap in time of so many time constants of the observer begins again behind it,
    gap_constants: float = 2.0
    #: if it is of so many rows as well: an uneven sampling is none.
    gap_rows: float = 5.0
    #: Mismatches beyond this many dry frictions say no more: a model that has run away counts as that bad.
    worst: float = 1e6
    #: Share of each recording that first rounds run on: the stretch where most is left shows most of any effect.
    shortened_share: float = 0.35
    #: The least that this is, s.
    shortened_least_s: float = 4.0
    #: Cores that a diagnosis uses, at most.
    most_cores: int = 2


@dataclass(frozen=True)
class FloorSettings:
    """The noise floor: what the quiet stretches of the recordings leave."""

    #: Length of a stretch in time constants of the observer.
    stretch: float = 8.0
    #: The quantile of the stretches' power that is taken for noise: missing physics acts here and there only.
    quantile: float = 0.25
    #: The standard score of that quantile, by which it is corrected for having been picked as quiet.
    score: float = -0.674
    #: By how much slow torque noise may exceed the white part of the mismatch, in power.
    slow_over_white: float = 6.0
    #: Share of an error that the floor, known no better than this, leaves to be explained at least.
    least_share: float = 0.02


@dataclass(frozen=True)
class CoordinateSettings:
    """Coordinates over which a mismatch is looked at."""

    #: Times since a reversal, and at rest, are told up to here, s.
    longest_s: float = 1.0
    #: The joint rests where its speed is below this many of its own errors.
    rest_errors: float = 3.0
    #: A map of rest needs this share of the rows.
    least_resting: float = 0.02
    #: The change of the command is taken over so long, s.
    change_s: float = 0.01


@dataclass(frozen=True)
class FitSettings:
    """Damped Gauss-Newton with Huber's loss."""

    #: Scales beyond which a row's mismatch counts by its distance only.
    huber: float = 4.0
    #: The scale of a mismatch is at least this share of its RMS: rare blows must not count by distance alone.
    least_of_rms: float = 0.3
    #: Nor is it smaller than this share of dry friction.
    least_scale: float = 0.002
    #: A fit has converged when a step improves the cost by less than this share.
    converged: float = 1e-3
    #: Damping that steps begin with, of the normal matrix's diagonal: so little that beliefs decide where data do not.
    least_damping: float = 1e-8
    #: Longest step of one coordinate at once.
    longest_step: float = 1.5
    #: A fresh Jacobian that predicts to gain this share of the cost, and no step helps, is taken over a wider span,
    predicted: float = 0.01
    #: of so much of each coordinate, at least.
    wide: float = 0.01
    #: Length of the blocks whose sums are taken to be independent, s: rows within one may be correlated as they like.
    memory_s: float = 0.25
    #: Steps of a fit, in each of two scales.
    steps: int = 12


@dataclass(frozen=True)
class TrialSettings:
    """How many starts of effects are tried, and how far each is fitted."""

    #: Starts that go on to the second round.
    second_round: int = 16
    #: Steps of each there.
    second_steps: int = 3
    #: Effects that are fitted on everything.
    full_fits: int = 5
    #: Steps of such a fit.
    full_steps: int = 8
    #: Starts of a far effect that get a step of their own: those that the model's own parameters can follow best.
    far_starts: int = 4
    #: A candidate is fitted on everything when it has saved at least 1 - in_reach of what the best has saved.
    in_reach: float = 0.4
    #: What a number more must take of the rest to be worth it.
    per_number: float = 0.02


@dataclass(frozen=True)
class WorthSettings:
    """From when on a term is worth a name: levels of the outside contract, and what experience added."""

    #: Worth naming by the outside contract: share of the explainable error,
    share: float = 0.05
    #: or share of Coulomb friction where it acts.
    torque: float = 0.03
    #: The least torque that any finding must carry there, which several effects of one per cent each stay below.
    least_torque: float = 0.018
    #: The least torque of a parameter beyond its own level, which acts for some milliseconds behind a reversal.
    level_torque: float = 0.003
    #: A term that takes less than `sure_share` must take this share of what is left above the floor: a name that leaves
    #: most of the rest as it was is not what the rest is made of.
    least_of_left: float = 0.25
    #: A term that takes this share of what is left is what the rest is made of: then the torque that it stands for
    #: counts, for what a scale on the model's own friction and inertia cannot take up of it may be little.
    nearly_all: float = 0.8
    #: Rows that show where an effect acts: its torque there is at least this quantile of what it changes.
    acts_at: float = 0.98
    #: A fit that takes so much of the explainable error counts though its last steps still improved it.
    sure_share: float = 0.3
    #: A coordinate so near to its bound, or to the end of its range, lies on it.
    on_bound: float = 1e-6
    #: A torque where it acts of so many times the largest command is none: what is fed and what moves are in two units.
    most_of_command: float = 5.0
    #: Robust deviations beyond which a mismatch is a blow, and counts no more for what is left.
    blow: float = 8.0
    #: Blocks whose sums are taken to be independent when a gain is judged, s. Shorter than those of the intervals: what
    #: other missing physics leaves is slow, and must not count as noise as long as it is not named.
    gain_memory_s: float = 0.1


@dataclass(frozen=True)
class ForwardSettings:
    """Forward selection, with backward elimination behind each term that comes in."""

    #: Share of the time limit that the search for terms may take; cross-validation needs the rest.
    search_share: float = 0.75
    #: Most terms.
    most_terms: int = 5
    #: Nothing worth naming is left when the mismatch above the floor is below this share of dry friction,
    nothing_rms: float = 0.006
    #: and its means over short stretches are below this share of it,
    nothing_stretch: float = 0.02
    #: but for this share of the stretches.
    but_share: float = 0.005
    #: Rivals that saved at least 1 - close of what the best saved get their chance when the best does not deserve it.
    close: float = 0.3
    #: Times that a fit goes on where a term deserves it.
    refits: int = 2
    #: The share of what a term takes that is as good as nothing: blows behind a gap come a sample earlier or later.
    near: float = 0.05


@dataclass(frozen=True)
class JointSettings:
    """Levels of the model's own friction, released together."""

    #: Where they leave less than this share of what was there,
    nearly_all: float = 0.05
    #: they come before an effect that needs as many numbers and leaves no less than this share of what they leave,
    as_good: float = 1.05
    #: or as good as nothing, as they do: a share of what was there.
    nothing: float = 0.002


@dataclass(frozen=True)
class GroupSettings:
    """Several effects at once, none of which takes much of what is left."""

    #: Only where what is left above the noise floor is this share of dry friction,
    much_left: float = 0.025
    #: and this share of what was explainable.
    left_share: float = 0.08
    #: Most terms, those of forward selection included.
    most_terms: int = 9
    #: A term takes at least this share of what is left when it comes in,
    least_each: float = 0.06
    #: and all of them together at least this share.
    least_together: float = 0.35
    #: A term acts with at least this share of dry friction, seen through the observer's low-pass.
    least_torque: float = 0.025
    #: Candidates of a round that are tried until one deserves to come in.
    tried: int = 3


@dataclass(frozen=True)
class SwapSettings:
    """Rivals in the place of terms that came in before others."""

    #: Rivals of a term that are tried, at most.
    most_tried: int = 2
    #: They left at most so many times what the term left.
    within: float = 2.5
    #: A rival that leaves at most so many times what the term leaves takes its place by what it predicts,
    near: float = 1.2
    #: when free windows of unseen rows, short and long ones, are off by this share at most of what they were.
    predicts: float = 0.6
    #: One that costs less must not make them worse than this.
    no_worse: float = 1.05
    #: A rival takes the place when the cost falls by more than this share of it, or with fewer unknowns rises by less.
    better: float = 0.01


@dataclass(frozen=True)
class DriftSettings:
    """A slow change of the constant torque, which shows in means over a second."""

    #: Length over which the mismatch is averaged, s.
    span_s: float = 1.0
    #: The share of the means' power that a drift must take.
    least_taken: float = 0.15
    #: What it must gain beyond the Bayesian information criterion, in units of noise; one thing is tried, not hundreds.
    least_gain: float = 20.0
    #: The same where it takes a good part of the means' power, which noise does not,
    least_gain_of_most: float = 10.0
    #: namely this share.
    most_taken: float = 0.4


@dataclass(frozen=True)
class ResetSettings:
    """Parameters put back to their nominal values where the data do not mind."""

    #: The data mind when the torque that changes is over this share of dry friction in some rows,
    torque: float = 0.01
    #: or the error grows by this share.
    error: float = 0.02
    #: Spread of a belief so firm that a parameter stays.
    firm: float = 1e-6


@dataclass(frozen=True)
class ValidationSettings:
    """Cross-validation: rows left out in turn, and windows that are simulated freely."""

    #: Steps of each new fit; it starts from the one that has seen everything.
    steps: int = 3
    #: Stretches of each recording.
    stretches: int = 4
    #: Rows so long behind an event are not judged either, s: a window that simulates freely carries it that far.
    tail_s: float = 1.0
    #: Lengths of the windows, s.
    horizons_s: tuple[float, ...] = (0.25, 1.0)
    #: Free windows of unseen rows must come out by this factor better with the names than without. A few terms with
    #: dynamics of their own can follow nearly any mismatch one sample ahead, and predict nothing.
    most_free_run_error: float = 0.7
    #: The same where the model's drive makes the torque: a servo's loop pulls a simulated run back by itself.
    most_free_run_error_by_drive: float = 0.85
    #: That is not asked where the mismatch is within so many times the noise floor anyway.
    fitted_floors: float = 2.0
    #: Nor where rows that no fit has seen have a mismatch of no more than this share of what they had: that predicts.
    #: Where friction falls with speed a simulated run leaves the recorded one however good the model is.
    predicted_share: float = 0.05


@dataclass(frozen=True)
class IntervalSettings:
    """How far estimates may be off."""

    #: Half width of a 95 % interval in standard deviations.
    z95: float = 1.96
    #: Probability of the region in which several coordinates lie together.
    region: float = 0.95
    #: Error of any estimate that steps of a sample and forms that are not quite the axis's make, as a share of it.
    model_error: float = 0.006
    #: By how much worse steps of a sample make the bristle's numbers, which act for some samples at a time.
    bristle_error: float = 2.0
    #: A change of a parameter below this share is none.
    least_change: float = 0.002


@dataclass(frozen=True)
class MapSettings:
    """Where a mismatch lives: maps over coordinates, and what is drawn of them."""

    #: Bins of a map.
    bins: int = 24
    #: Bins of a map over time, which has more to show than a curve.
    time_bins: int = 96
    #: Rows that a bin needs before its mean is shown.
    least_in_bin: int = 30
    #: Probability under noise below which a map counts as seen.
    seen: float = 1e-3
    #: A place carries the mismatch where its power is over this share of the strongest place's.
    strong: float = 0.5
    #: Bands of frequency, Hz.
    bands_hz: tuple[tuple[float, float], ...] = (
        *((0.0, 0.5), (0.5, 2.0), (2.0, 5.0), (5.0, 10.0), (10.0, 20.0), (20.0, 50.0)),
    )
    #: Points of a table of what has no name.
    table_points: int = 33
    #: The share of the mismatch that such a table must take of rows it has not seen.
    table_least_share: float = 0.05


@dataclass(frozen=True)
class CurveSettings:
    """What is drawn of a mismatch: signatures of terms, courses over time, spectra."""

    #: Bins of a signature.
    signature_bins: int = 60
    #: Periods in the range of positions from which a periodic signature is drawn over one period only.
    fold_from: float = 4.0
    #: The stretch of time in which a term acts most lasts so long, s.
    stretch_s: float = 3.0
    #: So many rows of a signature count as one independent row in its standard errors.
    correlated_rows: float = 20.0
    #: Length of a stretch whose root mean square is one point over time, s.
    course_s: float = 0.1
    #: Lowest frequency of a spectrum, Hz.
    lowest_hz: float = 0.2
    #: Highest frequency of a spectrum, Hz: the observer shows nothing beyond.
    highest_hz: float = 60.0
    #: Bands of a spectrum, alike in width on a logarithmic scale.
    bands: int = 60
    #: Length of the windows that a spectrum is averaged over, s: what it resolves at the low end.
    window_s: float = 8.0


@dataclass(frozen=True)
class VerdictSettings:
    """From what is named and what is left to a verdict, and how sure a name is."""

    #: Below this share of the explainable error no known name may stand: what is there is something else. Real machines
    #: keep some of theirs above it, so that it is no nearer to 1; confidence falls with what is left instead.
    least_explained: float = 0.85
    #: The same where what is left is worth a name itself.
    least_beside_much: float = 0.925
    #: The same where no torque was recorded and the model's drive makes it: its inner loop has parts of its own.
    least_by_drive: float = 0.5
    #: What is left is worth a name itself from this share of dry friction on.
    much_torque: float = 0.05
    #: Share of the explainable error on unseen rows from which a name that may not stand is told as part of the answer.
    least_partial: float = 0.5
    #: What is left above the noise floor counts as unexplained from this share of dry friction,
    left_torque: float = 0.02
    #: if it is also this share of what could be explained.
    left_share: float = 0.05
    #: Length of a stretch that may be an event of its own, s,
    event_s: float = 0.1
    #: the share of all stretches that such events are at most,
    event_share: float = 0.02
    #: out of at least so many stretches,
    event_of: int = 50
    #: and the share of the power of what is left that they carry at least.
    event_power: float = 0.5
    #: Share of dry friction from which the encoder's noise in the mismatch hides what is left.
    hides_rest: float = 0.15
    #: The same from which it hides everything.
    hides_all: float = 0.5
    #: A rival that leaves at most this many times what the finding leaves cannot be told apart.
    alike: float = 1.2
    #: Confidence 0.5 + 0.49*(1 - exp(-gap/gap_scale)); gap: logarithm of what the best rival leaves over what the
    #: finding leaves.
    gap_scale: float = 0.15
    #: Share of the rows at a servo's limit from which its gain is told from its torque; below, only the product shows,
    at_limit: float = 0.02
    #: and either name is as likely as the other.
    either: float = 0.5
    #: From this share of the explainable error removed on, what is left says nothing against the names.
    fully: float = 0.95


@dataclass(frozen=True)
class DiagnosisSettings:
    """All of them, in the order in which the stages read them."""

    intake: IntakeSettings = IntakeSettings()
    excitation: ExcitationSettings = ExcitationSettings()
    observer: ObserverSettings = ObserverSettings()
    floor: FloorSettings = FloorSettings()
    coordinates: CoordinateSettings = CoordinateSettings()
    fit: FitSettings = FitSettings()
    trials: TrialSettings = TrialSettings()
    worth: WorthSettings = WorthSettings()
    forward: ForwardSettings = ForwardSettings()
    joint: JointSettings = JointSettings()
    group: GroupSettings = GroupSettings()
    swap: SwapSettings = SwapSettings()
    drift: DriftSettings = DriftSettings()
    reset: ResetSettings = ResetSettings()
    validation: ValidationSettings = ValidationSettings()
    intervals: IntervalSettings = IntervalSettings()
    maps: MapSettings = MapSettings()
    curves: CurveSettings = CurveSettings()
    verdict: VerdictSettings = VerdictSettings()


#: The settings of every diagnosis.
SETTINGS = DiagnosisSettings()
