"""What in an axis configuration weakens a guard, or lies beyond what model and drive can do, for people.

Beside the data path: said by `servoctl config check` and in the daemon's log. Every value here is allowed, and some
axis may need it; whoever set it shall know what it takes away.
"""

from __future__ import annotations

import math

from servod.formats.config import AxisConfig
from servod.formats.joint_bounds import contradictions, joint_of
from servod.formats.model.axis_model import AxisKind, AxisModel
from servod.formats.wiring import warnings
from servod.kernels.filters import low_pass_share

#: No joint of a machine that people stand beside turns faster (9549 turns a minute).
_MOST_SPEED_RAD_S = 1000.0
#: Servo motors stand three times their rated torque for a moment, few four times.
_MOST_OF_RATED = 4.0
#: Without feedback the torque of before goes on for this time at most before it is noticed.
_MOST_BLIND_S = 0.05
_MOST_LATE_S, _MOST_RAMP_S = 0.25, 0.5
#: A drive whose master has died holds its torque for so long (servod's own time-out is 150 ms).
_MOST_DEAD_MS = 500
#: A forged heartbeat shows when the node's own comes, this share of the period later.
_NOTICED_SHARE, _MOST_NOTICED_MS = 0.4, 50.0
#: 0x6007: the voltage is disabled.
_COASTS = 2
#: One count that looks like more than this share of the speed limit makes a joint trip far below it.
_MOST_COUNT_SPEED = 0.2
#: No servo motor, alone and at its peak torque, accelerates faster; those of the highest dynamics reach a third of it.
_MOST_ACCELERATION_RAD_S2 = 1e6
#: Torque after a loss of the master, where the drive knows no deadline of its commands.
_MOST_WITHIN_S = 0.3
#: A drive that reacts at all to its deadline need not wait longer than for a dead master's heartbeat.
_MOST_DEADLINE_MS = 150
#: Drive and encoder that drift apart by so much are not on one joint; a slip of an eighth of a turn is long seen.
_MOST_MISMATCH_RAD = math.pi / 4.0


def weakened(config: AxisConfig, model: AxisModel | None = None) -> list[str]:
    """One line for each value of `config` (after `with_expected`) that guards less than it seems, key first."""
    lines = [*_limits(config), *_watches(config), *_times(config), *_reactions(config), *_above_drive(config)]
    lines += warnings(config)
    if model is not None and model.axis is AxisKind.ROTARY:
        lines += [*_above_model(config, model), *contradictions(config, model)]
    if config.gains.accept_uncertified:
        lines.append("gains.accept_uncertified is true: a gain set that nobody verified, or of another drive, may run")
    if config.recorder.history_s == 0.0:
        lines.append("recorder.history_s is 0: nothing of the seconds before a fault is kept")
    if "interface" not in config.bus.model_fields_set:
        lines.append(f"bus.interface is not stated: a virtual axis at {config.bus.channel}, no drive on a real bus")
    return lines


def _limits(config: AxisConfig) -> list[str]:
    limits, period_s = config.limits, config.cycle.period_us * 1e-6
    travel_rad = limits.position_max_rad - limits.position_min_rad
    counts = config.encoder.measuring_range_counts or 2**32
    range_rad = 2.0 * math.pi * counts / config.encoder.counts_per_turn
    lines = []
    if limits.speed_rad_s > _MOST_SPEED_RAD_S:
        lines.append(f"limits.speed_rad_s {limits.speed_rad_s:g}: no joint turns so fast; nothing limits the speed")
    elif limits.speed_rad_s * period_s > 0.5 * range_rad:
        lines.append(
            f"limits.speed_rad_s {limits.speed_rad_s:g}: half the encoder's range of {range_rad:.3g} rad and more "
            "in one period, so that the speed cannot be told"
        )
    count_rad_s = _one_count_rad_s(config)
    if count_rad_s > _MOST_COUNT_SPEED * limits.speed_rad_s:
        lines.append(
            f"limits.speed_rad_s {limits.speed_rad_s:g}: one count of the encoder (encoder.counts_per_turn "
            f"{config.encoder.counts_per_turn}) looks like {count_rad_s:.3g} rad/s, and so much below the limit the "
            "joint may trip; lower encoder.velocity_cutoff_hz"
        )
    if travel_rad >= range_rad:
        lines.append(
            f"limits.position_min_rad and position_max_rad: the encoder's range of {range_rad:.3g} rad ends before them"
        )
    if limits.following_error_rad >= travel_rad:
        lines.append(f"limits.following_error_rad {limits.following_error_rad:g}: the position limits come before it")
    if limits.encoder_mismatch_rad > min(_MOST_MISMATCH_RAD, travel_rad):
        lines.append(
            f"limits.encoder_mismatch_rad {limits.encoder_mismatch_rad:g}: a coupling that slips by an eighth of a "
            "turn is not noticed"
        )
    if limits.torque_rate_nm_per_s * period_s >= 2.0 * limits.torque_nm:
        lines.append(
            f"limits.torque_rate_nm_per_s {limits.torque_rate_nm_per_s:g}: from one torque limit to the other in a "
            "period, so that it limits nothing"
        )
    return lines


def _watches(config: AxisConfig) -> list[str]:
    """What is told from the torque, and never comes where its limit is beyond all torque."""
    limits, joint = config.limits, joint_of(config)
    lines = []
    if limits.torque_mismatch_nm is not None and limits.torque_mismatch_nm >= limits.torque_nm:
        lines.append(
            f"limits.torque_mismatch_nm {limits.torque_mismatch_nm:g}: torque that the drive does not give is not "
            "noticed; left out it is a quarter of limits.torque_nm"
        )
    if limits.oscillation_nm is not None and limits.oscillation_nm > limits.torque_nm:
        lines.append(
            f"limits.oscillation_nm {limits.oscillation_nm:g}: a feedback loop that swings by itself is not noticed "
            "before it does so by more than limits.torque_nm, and never from twice that on"
        )
    if joint is not None and limits.torque_nm > _MOST_ACCELERATION_RAD_S2 * joint.most_inertia:
        lines.append(
            f"limits.torque_nm {limits.torque_nm:g}: {limits.torque_nm / joint.most_inertia:.3g} rad/s^2 of this "
            "joint, which no motor gives; every stop is reckoned with that torque"
        )
    return lines


def _reactions(config: AxisConfig) -> list[str]:
    """What the drive shall do by itself."""
    amplifier, lines = config.amplifier, []
    if amplifier.unguarded:
        lines.append("amplifier.unguarded is true: a drive that does not stop by itself when servod dies may run")
    if amplifier.quick_stop_option == 0:
        lines.append("amplifier.quick_stop_option 0: at a quick stop the drive lets the joint coast")
    if amplifier.heartbeat_reaction == _COASTS:
        lines.append(
            f"amplifier.heartbeat_reaction {_COASTS}: when servod dies the drive lets the joint coast instead of "
            "braking it"
        )
    if amplifier.guard_test_days is None and config.bus.interface != "virtual":
        lines.append(
            "amplifier.guard_test_days is not stated: nothing asks for a new proof (`servoctl guard-test`) that the "
            "drive stops by itself when servod is dead"
        )
    return lines


def _one_count_rad_s(config: AxisConfig) -> float:
    """What the low-passed speed shows after a step of one count in one period, rad/s."""
    count_rad, period_s = 2.0 * math.pi / config.encoder.counts_per_turn, config.cycle.period_us * 1e-6
    return low_pass_share(config.encoder.velocity_cutoff_hz, period_s) * count_rad / period_s


def _times(config: AxisConfig) -> list[str]:
    limits, period_s = config.limits, config.cycle.period_us * 1e-6
    found = (
        ("limits.stale_cycles", limits.stale_cycles, limits.stale_cycles * period_s, _MOST_BLIND_S, "without feedback"),
        (
            "limits.late_cycles",
            limits.late_cycles,
            limits.late_cycles * period_s,
            _MOST_LATE_S,
            "of a loop that stands",
        ),
        ("limits.ramp_down_s", limits.ramp_down_s, limits.ramp_down_s, _MOST_RAMP_S, "of torque after a fault"),
    )
    lines = [
        f"{key} {value:g}: up to {time_s:.3g} s {what} before the axis is off; up to {most_s:g} s is usual"
        for key, value, time_s, most_s, what in found
        if time_s > most_s
    ]
    if config.heartbeat.command_deadline_ms == 0:
        lines.append(
            "heartbeat.command_deadline_ms 0: when the commands alone are lost the drive holds its torque until the "
            "joint shows it; when this computer dies, until the heartbeat is missed"
        )
    if (config.heartbeat.command_deadline_ms or 0) > _MOST_DEADLINE_MS:
        lines.append(
            f"heartbeat.command_deadline_ms {config.heartbeat.command_deadline_ms}: so long the drive goes on with "
            "its last torque when its commands are lost"
        )
    if (config.stopping.within_s or 0.0) > _MOST_WITHIN_S:
        lines.append(
            f"stopping.within_s {config.stopping.within_s:g}: torque may act for so long after a loss of the master; "
            f"up to {_MOST_WITHIN_S:g} s is usual"
        )
    noticed_ms = _NOTICED_SHARE * config.heartbeat.node_period_ms
    if noticed_ms > _MOST_NOTICED_MS:
        lines.append(
            f"heartbeat.node_period_ms {config.heartbeat.node_period_ms}: a heartbeat that somebody else sends for a "
            f"node is told up to {noticed_ms / 1e3:g} s later"
        )
    dead_ms = config.heartbeat.drive_timeout_ms
    if dead_ms > _MOST_DEAD_MS:
        lines.append(
            f"heartbeat.drive_timeout_ms {dead_ms}: when this computer dies the drive holds its torque for "
            f"{dead_ms / 1e3:g} s"
        )
    return lines


def _above_drive(config: AxisConfig) -> list[str]:
    rated_mnm = config.amplifier.rated_torque_mnm
    if rated_mnm is None:
        return []
    share = config.limits.torque_nm / (rated_mnm * 1e-3 * config.amplifier.gear_ratio)
    if share <= _MOST_OF_RATED:
        return []
    return [
        f"limits.torque_nm {config.limits.torque_nm:g}: {share:.3g} times what the motor is rated for, after the gear"
    ]


def _above_model(config: AxisConfig, model: AxisModel) -> list[str]:
    limits, lines = config.limits, []
    saturation = model.torque_saturation
    if saturation is not None:
        most_nm = max(saturation.limit, saturation.negative_limit or 0.0)
        if limits.torque_nm > most_nm:
            lines.append(
                f"limits.torque_nm {limits.torque_nm:g}: the joint of {config.model} gives {most_nm:g} at most"
            )
    if model.friction.kind == "local":
        known_rad_s = max(abs(velocity) for velocity in model.friction.velocities)
        if limits.speed_rad_s > known_rad_s:
            lines.append(
                f"limits.speed_rad_s {limits.speed_rad_s:g}: the friction of {config.model} was measured up to "
                f"{known_rad_s:.3g} rad/s"
            )
    return lines
