"""The limits of a configuration that has no others to test: wide, and each of them stated."""

LIMITS = {
    "torque_nm": 1.0,
    "torque_rate_nm_per_s": 100.0,
    "speed_rad_s": 10.0,
    "position_min_rad": -1.0,
    "position_max_rad": 1.0,
    "following_error_rad": 0.5,
    "encoder_mismatch_rad": 0.2,
}
