/* A CiA 402 amplifier's objects: one that knows cyclic synchronous torque alone. */
#define OBJECTS(VALUE, PAIR)                                                                                           \
    VALUE(0x6007, int16_t, abort_connection_option, 1, RW)                                                             \
    VALUE(0x603F, uint16_t, error_code, 0, TX)                                                                         \
    VALUE(0x6040, uint16_t, control_word, 0, RX)                                                                       \
    VALUE(0x6041, uint16_t, status_word, 0, TX)                                                                        \
    VALUE(0x605A, int16_t, quick_stop_option, 2, RW)                                                                   \
    VALUE(0x605E, int16_t, fault_reaction_option, 2, RW)                                                               \
    VALUE(0x6060, int8_t, mode, 0, RX)                                                                                 \
    VALUE(0x6061, int8_t, mode_display, 0, TX)                                                                         \
    VALUE(0x6064, int32_t, position_actual, 0, TX)                                                                     \
    VALUE(0x606C, int32_t, velocity_actual, 0, TX)                                                                     \
    VALUE(0x6071, int16_t, target_torque, 0, RX)                                                                       \
    VALUE(0x6072, uint16_t, max_torque, 3000, RX)                                                                      \
    VALUE(0x6074, int16_t, torque_demand, 0, TX)                                                                       \
    VALUE(0x6076, uint32_t, rated_torque, 100, RO)                                                                     \
    VALUE(0x6077, int16_t, torque_actual, 0, TX)                                                                       \
    PAIR(0x607D, int32_t, position_limits, INT32_MIN, INT32_MAX, RW)                                                   \
    VALUE(0x6080, uint32_t, max_motor_speed, 6000, RW)                                                                 \
    VALUE(0x60B2, int16_t, torque_offset, 0, RX)                                                                       \
    PAIR(0x60C2, int8_t, interpolation_period, 1, -3, RW)                                                              \
    VALUE(0x60E0, uint16_t, positive_torque_limit, 3000, RX)                                                           \
    VALUE(0x60E1, uint16_t, negative_torque_limit, 3000, RX)                                                           \
    VALUE(0x6502, uint32_t, supported_modes, 0x200, RO)
