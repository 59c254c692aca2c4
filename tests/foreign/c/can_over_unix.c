/* Puts a program that knows AF_CAN on the virtual bus, on a machine whose kernel has no CAN: loaded before its
 * libraries (LD_PRELOAD), it turns each CAN socket into a connection to the hub's Unix socket, whose path is in
 * VIRTUAL_CAN. The hub speaks `struct can_frame` already, so that sending and receiving need nothing.
 *
 * The kernel's receive filters are left out but for one thing: a socket that accepts nothing (how CANopenNode waits
 * while it resets its communication) must not keep the frames of that time. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <linux/can.h>
#include <linux/can/raw.h>
#include <stdlib.h>
#include <string.h>
#include <net/if.h>
#include <sys/socket.h>
#include <sys/un.h>

enum { DESCRIPTORS = 1024, INTERFACE = 1 };
static char is_can[DESCRIPTORS], deaf[DESCRIPTORS];

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

static int ours(int fd) { return fd >= 0 && fd < DESCRIPTORS && is_can[fd]; }

int socket(int domain, int type, int protocol) {
    int fd = domain == PF_CAN ? REAL(socket)(AF_UNIX, SOCK_SEQPACKET, 0) : REAL(socket)(domain, type, protocol);
    if (fd >= 0 && fd < DESCRIPTORS) {
        is_can[fd] = domain == PF_CAN;
        deaf[fd] = 0;
    }
    return fd;
}

int bind(int fd, const struct sockaddr* address, socklen_t length) {
    if (!ours(fd)) {
        return REAL(bind)(fd, address, length);
    }
    struct sockaddr_un hub = {.sun_family = AF_UNIX};
    strncpy(hub.sun_path, getenv("VIRTUAL_CAN"), sizeof(hub.sun_path) - 1);
    return connect(fd, (struct sockaddr*)&hub, sizeof(hub));
}

int setsockopt(int fd, int level, int name, const void* value, socklen_t length) {
    if (!ours(fd) || level != SOL_CAN_RAW) {
        return REAL(setsockopt)(fd, level, name, value, length);
    }
    if (name == CAN_RAW_FILTER) {
        char packet[64];
        while (deaf[fd] && recv(fd, packet, sizeof(packet), MSG_DONTWAIT) > 0) {}
        deaf[fd] = length == 0;
    }
    return 0;
}

unsigned int if_nametoindex(const char* name) { return name != NULL ? INTERFACE : 0; }

char* if_indextoname(unsigned int index, char name[IF_NAMESIZE]) {
    if (index != INTERFACE) {
        errno = ENXIO;
        return NULL;
    }
    return strcpy(name, "virtual");
}
