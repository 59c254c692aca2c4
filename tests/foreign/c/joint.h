/* The joint that amplifier and encoder have in common: the amplifier's program moves it, both see it, and the test
 * reads it as what really happened. It lies in the file that JOINT names. */
#include <fcntl.h>
#include <stdint.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <unistd.h>

#define COUNTS_PER_TURN 1048576
#define COUNTS_PER_RAD (COUNTS_PER_TURN / 6.283185307179586)

typedef struct {
    double position_rad, speed_rad_s, torque_nm;
    uint32_t powered;
} joint_t;

static joint_t* joint_of_file(void) {
    const char* path = getenv("JOINT");
    int file = open(path != NULL ? path : "/dev/shm/joint", O_RDWR | O_CREAT, 0600);
    if (file < 0 || ftruncate(file, sizeof(joint_t)) != 0) {
        return NULL;
    }
    joint_t* joint = mmap(NULL, sizeof(joint_t), PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
    return joint != MAP_FAILED ? joint : NULL;
}
