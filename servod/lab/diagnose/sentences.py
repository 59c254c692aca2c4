"""What the report says in plain sentences: the verdict, how sure, what remains, and what to record next.

Stands on the document of a diagnosis alone.
"""

from __future__ import annotations

from typing import Any

Document = dict[str, Any]

#: What to do about a refused recording, by a word of the reason.
REMEDIES = {
    "too short": "Record for at least some seconds; three recordings of 15 s are usual.",
    "too still": "Let the axis move: slow sines, a mix of frequencies, and moves with rests in between.",
    "too noisy": "The encoder's noise hides what friction does: use a finer encoder, or move faster and further.",
    "saturated": "The drive was at its limit: ask for slower motions, so that the command is what acts.",
    "opposite signs": "Turn the sign of the command or of the position in a --map file (scale: -1).",
    "another unit": "Give the unit in a --map file (scale: 0.001 turns mN·m into N·m).",
    "degrees": "Give the unit in a --map file (scale: 0.0174533 turns degrees into rad).",
    "counts": "Give the unit in a --map file (scale: 2*pi over the counts of a turn).",
    "never changes": "Record the command that goes to the drive, not a constant.",
}

#: How the diagnosis works, for those who want to know.
MATHEMATICS = (
    "Prediction. The model is simulated under the recorded command and pulled to the recorded position by an observer "
    "of fixed gains. The pull, as a torque, is the error shown here: where the model is right it is noise (Ljung, "
    "System Identification, 1999, ch. 7).",
    "Recalibration. The model's own parameters are fitted first, each within what a good model is known to (10 %), by "
    "damped Gauss-Newton with Huber's loss.",
    "Search. Every known effect is added in several forms and from many starts, together with all parameters of the "
    "model. It stays when the gain is significant against correlated noise with a correction for the number of things "
    "tried (Bayesian information criterion), and when it is large enough to be worth naming.",
    "Proof. Each recording in turn is left out, the rest is fitted again, and the one left out is predicted; a quarter "
    "of every recording where there is only one, or where recordings differ in a number of their own. Intervals "
    "count correlated rows as fewer (sums over blocks of a quarter of a second: Carlstein, Annals of Statistics 14, "
    "1986).",
)


def verdict_sentence(document: Document) -> str:
    """The answer in one or two sentences."""
    return str(document["summary"])


def certainty(finding: Document) -> list[str]:
    """How sure a finding is, and what it cannot be told apart from."""
    name = finding["effect"].replace("_", " ")
    lines = [f"How sure that it is {name}: {100.0 * finding['confidence']:.0f} %."]
    for other in finding["alternatives"]:
        lines.append(
            f"These data cannot tell {name} from {other['effect'].replace('_', ' ')}; this would: "
            f"{other['experiment']}."
        )
    return lines


def remains(document: Document) -> str:
    """What is left, and where it lives."""
    fit, left = document["fit"], [m for m in document["remaining"] if m["chance"] < 1e-3 and m["share"] > 0.01]
    times = fit["held_out"]["after"] / max(fit["noise_floor"], 1e-30)
    if not left or times < 1.1:
        return "What is left is noise: no coordinate orders it any more."
    most = left[0]
    return (
        f"What is left is {times:.1f} times the noise floor; most of what is ordered in it lies over "
        f"{most['coordinate']} ({100.0 * most['share']:.0f} % of it)."
    )


def next_experiments(document: Document) -> list[str]:
    """What to record next: what separates the alternatives, and what would make a finding surer."""
    lines = []
    for finding in document["findings"]:
        name = finding["effect"].replace("_", " ")
        for other in finding["alternatives"]:
            lines.append(f"To tell {name} from {other['effect'].replace('_', ' ')}: {other['experiment']}.")
        lines.append(f"To see {name} by itself: {finding['experiment']}.")
    if document["verdict"] == "unexplained":
        where = document["located"][0]["coordinate"]
        lines.append(
            f"Repeat the recordings slower and faster, over the same range of {where}: what stays tied to the place is "
            "the axis, what stays tied to the time is its surroundings."
        )
    return list(dict.fromkeys(lines))
