/* The objects of a device profile in CANopenNode's dictionary, from one list of the application: OBJECTS(VALUE, PAIR),
 * by rising index. VALUE(index, type, name, default, access) is a variable, PAIR an array of two of one type. Included
 * by the application, which gets the variables, and by the dictionary (OD_DEFINITION), which makes and describes them. */
#include <stdint.h>

#include "301/CO_ODinterface.h"
#include APPLICATION

#ifdef OD_DEFINITION

enum { RO = ODA_SDO_R, RW = ODA_SDO_RW, TX = ODA_SDO_R | ODA_TPDO, RX = ODA_SDO_RW | ODA_RPDO };

#define ACCESS(type, access) (OD_attr_t)((access) | (sizeof(type) > 1 ? ODA_MB : 0))
#define VALUE_MADE(index, type, name, initial, access)                                                                 \
    type name = initial;                                                                                               \
    static OD_obj_var_t od_##name = {&name, ACCESS(type, access), sizeof(type)};
#define PAIR_MADE(index, type, name, first, second, access)                                                            \
    type name[2] = {first, second};                                                                                    \
    static OD_obj_array_t od_##name = {(uint8_t*)&two, name, ODA_SDO_R, ACCESS(type, access), sizeof(type), sizeof(type)};
#define VALUE_ENTRY(index, type, name, initial, access) {index, 1, ODT_VAR, &od_##name, NULL},
#define PAIR_ENTRY(index, type, name, first, second, access) {index, 3, ODT_ARR, &od_##name, NULL},

static const uint8_t two = 2;
OBJECTS(VALUE_MADE, PAIR_MADE)
#define APPLICATION_ENTRIES OBJECTS(VALUE_ENTRY, PAIR_ENTRY)

#else

#define VALUE_KNOWN(index, type, name, initial, access) extern type name;
#define PAIR_KNOWN(index, type, name, first, second, access) extern type name[2];
OBJECTS(VALUE_KNOWN, PAIR_KNOWN)

#endif
