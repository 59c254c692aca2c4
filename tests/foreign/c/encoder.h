/* A CiA 406 encoder's objects: a multi-turn one, scaled 1:1. */
#define OBJECTS(VALUE, PAIR)                                                                                           \
    VALUE(0x6000, uint16_t, operating_parameters, 4, RW)                                                               \
    VALUE(0x6001, uint32_t, units_per_turn, 1048576, RW)                                                               \
    VALUE(0x6002, uint32_t, measuring_range, 0x80000000, RW)                                                           \
    VALUE(0x6003, uint32_t, preset, 0, RW)                                                                             \
    VALUE(0x6004, uint32_t, position, 0, TX)                                                                           \
    VALUE(0x6200, uint16_t, cyclic_timer, 100, RW)                                                                     \
    VALUE(0x6500, uint16_t, operating_status, 4, RO)                                                                   \
    VALUE(0x6501, uint32_t, single_turn_resolution, 1048576, RO)                                                       \
    VALUE(0x6502, uint16_t, turns, 2048, RO)                                                                           \
    VALUE(0x6503, uint16_t, alarms, 0, TX)                                                                             \
    VALUE(0x6504, uint16_t, supported_alarms, 1, RO)                                                                   \
    VALUE(0x6505, uint16_t, warnings, 0, TX)                                                                           \
    VALUE(0x6506, uint16_t, supported_warnings, 0, RO)                                                                 \
    VALUE(0x6509, int32_t, offset, 0, RO)
