/* An encoder by CiA 406 on CANopenNode. Its dictionary does the work: the position is read where it is asked for, at
 * each SYNC and by SDO; a preset moves the offset. */
#include <math.h>
#include <string.h>

#include "CO_application.h"
#include "OD.h"
#include "joint.h"
#include "objects.h"

static joint_t* joint;
static OD_extension_t position_read, preset_written;

static int64_t turned_counts(void) { return llround(joint->position_rad * COUNTS_PER_RAD); }

static ODR_t read_position(OD_stream_t* stream, void* buffer, OD_size_t count, OD_size_t* read) {
    int64_t range = measuring_range;
    position = (uint32_t)(((turned_counts() + offset) % range + range) % range);
    return OD_readOriginal(stream, buffer, count, read);
}

static ODR_t write_preset(OD_stream_t* stream, const void* buffer, OD_size_t count, OD_size_t* written) {
    if (fabs(joint->speed_rad_s) > 1e-3) {
        return ODR_DATA_DEV_STATE;
    }
    ODR_t done = OD_writeOriginal(stream, buffer, count, written);
    offset = (int32_t)(preset - turned_counts());
    return done;
}

CO_ReturnError_t app_programStart(uint16_t* bit_rate, uint8_t* node_id, uint32_t* error) {
    (void)bit_rate, (void)node_id, (void)error;
    OD_PERSIST_COMM.x1000_deviceType = 0x00020196;
    OD_PERSIST_COMM.x1018_identity.vendor_ID = 0xC0DE;
    OD_PERSIST_COMM.x1018_identity.productCode = 406;
    joint = joint_of_file();
    position_read = (OD_extension_t){.read = read_position, .write = OD_writeOriginal};
    preset_written = (OD_extension_t){.read = OD_readOriginal, .write = write_preset};
    OD_extension_init(OD_find(OD, 0x6003), &preset_written);
    OD_extension_init(OD_find(OD, 0x6004), &position_read);
    return joint != NULL ? CO_ERROR_NO : CO_ERROR_OUT_OF_MEMORY;
}

void app_communicationReset(CO_t* co) { (void)co; }
void app_programEnd(void) {}
void app_programAsync(CO_t* co, uint32_t passed_us) { (void)co, (void)passed_us; }
