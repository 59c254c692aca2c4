/* An amplifier by CiA 402 on CANopenNode, in cyclic synchronous torque, with a motor and a joint behind it: inertia,
 * dry and viscous friction. It watches its master by what the stack offers, the heartbeat consumer 0x1016 and the
 * deadline 0x1400:5, and by its own NMT state: whatever of these fails is an aborted connection (0x6007). */
#include <math.h>

#include "CO_application.h"
#include "OD.h"
#include "joint.h"
#include "objects.h"

#define INERTIA_KG_M2 0.001
#define COULOMB_NM 0.045
#define VISCOUS_NMS 0.056
#define STEP_S 50e-6
#define REST_RAD_S 0.02 /* a stop is over */
#define LONGEST_STOP_S 1.0

typedef enum { OFF, READY, SWITCHED_ON, ENABLED, STOPPING, REACTING, FAULTY } state_t;
static const uint16_t shown[] = {0x40, 0x21, 0x23, 0x27, 0x07, 0x0F, 0x08};

static joint_t* joint;
static state_t state = OFF;
static double stopping_s;
static uint16_t last_word;

static int powered(void) { return state == ENABLED || state == STOPPING || state == REACTING; }

/* --- The joint --- */

static void move_joint(double passed_s) {
    for (double left_s = fmin(passed_s, 0.2); left_s > 0.0; left_s -= STEP_S) {
        double speed = joint->speed_rad_s;
        if (fabs(speed) < 1e-4 && fabs(joint->torque_nm) <= COULOMB_NM) {
            joint->speed_rad_s = 0.0;
            continue;
        }
        double direction = fabs(speed) < 1e-4 ? copysign(1.0, joint->torque_nm) : copysign(1.0, speed);
        double next = speed
                      + STEP_S * (joint->torque_nm - COULOMB_NM * direction - VISCOUS_NMS * speed) / INERTIA_KG_M2;
        joint->speed_rad_s = speed * next < 0.0 ? 0.0 : next; /* friction stops, it does not turn round */
        joint->position_rad += STEP_S * joint->speed_rad_s;
    }
}

/* --- The state machine; numbers are the transitions of CiA 402 --- */

static void stop(state_t how, int option) {
    state = option == 0 ? (how == REACTING ? FAULTY : OFF) : how;
    stopping_s = 0.0;
}

static void fail(uint16_t code) { /* 13 */
    error_code = code;
    stop(powered() ? REACTING : FAULTY, powered() ? fault_reaction_option : 0);
}

static void obey(uint16_t word) {
    int command = word & 0x0F;
    int reset = word & ~last_word & 0x80;
    last_word = word;
    if (state == FAULTY) {
        if (reset) { /* 15 */
            error_code = 0;
            state = OFF;
        }
    } else if (state == REACTING || (word & 0x80)) {
        return;
    } else if ((command & 0x2) == 0) { /* 7, 9, 10, 12: disable voltage */
        state = OFF;
    } else if ((command & 0x4) == 0) { /* 7, 10, 11: quick stop */
        if (state == ENABLED) {
            stop(STOPPING, quick_stop_option);
        } else if (state != STOPPING) {
            state = OFF;
        }
    } else if (state == STOPPING) {
        return;
    } else if ((command & 0x1) == 0) { /* 2, 6, 8: shutdown */
        state = READY;
    } else if (state == READY) { /* 3 */
        state = SWITCHED_ON;
    } else if (state != OFF) { /* 4, 5 */
        state = (command & 0x8) && mode == 10 ? ENABLED : SWITCHED_ON;
    }
}

static void guard(CO_t* co) {
    static int was_lost;
    int silent = CO_isError(co->em, CO_EM_HEARTBEAT_CONSUMER), late = CO_isError(co->em, CO_EM_RPDO_TIME_OUT);
    int lost = silent || late || CO_NMT_getInternalState(co->NMT) != CO_NMT_OPERATIONAL;
    if (lost && !was_lost && state >= SWITCHED_ON && state <= ENABLED) {
        if (abort_connection_option == 1) {
            fail(late ? CO_EMC_RPDO_TIMEOUT : CO_EMC_HEARTBEAT);
        } else if (abort_connection_option == 3 && state == ENABLED) {
            stop(STOPPING, quick_stop_option);
        } else if (abort_connection_option != 0) {
            state = OFF;
        }
    }
    was_lost = lost;
}

static void end_stop(double passed_s) {
    stopping_s += passed_s;
    if (fabs(joint->speed_rad_s) < REST_RAD_S || stopping_s > LONGEST_STOP_S) {
        if (state == REACTING) { /* 14 */
            state = FAULTY;
        } else if (quick_stop_option < 5) { /* 12 */
            state = OFF;
        }
    }
}

static int limited(double wanted) {
    double most = fmin(max_torque, positive_torque_limit), least = -fmin(max_torque, negative_torque_limit);
    return (int)lround(fmax(least, fmin(most, wanted)));
}

static void drive(void) {
    double wanted = 0.0;
    if (state == ENABLED) {
        wanted = target_torque + torque_offset;
    } else if (state == STOPPING || state == REACTING) {
        wanted = -2000.0 * tanh(joint->speed_rad_s / 0.2); /* brakes by twice the rated torque, less near rest */
    }
    torque_demand = (int16_t)limited(wanted);
    torque_actual = torque_demand;
    joint->torque_nm = torque_demand * 1e-6 * rated_torque;
    joint->powered = powered();
    status_word = shown[state] | 0x0210 /* voltage, remote */
                  | (powered() && limited(wanted) != lround(wanted) ? 0x0800 : 0)
                  | (state == ENABLED && mode == 10 ? 0x1000 : 0);
    mode_display = mode;
    position_actual = (int32_t)llround(joint->position_rad * COUNTS_PER_RAD);
    velocity_actual = (int32_t)llround(joint->speed_rad_s * COUNTS_PER_RAD);
}

/* --- What CANopenNode calls --- */

CO_ReturnError_t app_programStart(uint16_t* bit_rate, uint8_t* node_id, uint32_t* error) {
    (void)bit_rate, (void)node_id, (void)error;
    OD_PERSIST_COMM.x1000_deviceType = 0x00020192;
    OD_PERSIST_COMM.x1018_identity.vendor_ID = 0xC0DE;
    OD_PERSIST_COMM.x1018_identity.productCode = 402;
    joint = joint_of_file();
    return joint != NULL ? CO_ERROR_NO : CO_ERROR_OUT_OF_MEMORY;
}

void app_communicationReset(CO_t* co) { (void)co; }

void app_programEnd(void) {}

void app_programAsync(CO_t* co, uint32_t passed_us) {
    guard(co);
    obey(control_word);
    if (state == STOPPING || state == REACTING) {
        end_stop(passed_us * 1e-6);
    }
    drive();
    move_joint(passed_us * 1e-6);
}
