/* user-mode-linux 6.1 sets its processes' floating point registers with a buffer of the size it was built for; a host
 * kernel takes only its own whole size, which is larger where the processor has AMX (EFAULT: "ptrace set fp regs failed").
 * Preloaded into linux.uml by guest.py, this fills the rest with what the kernel itself gives. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <elf.h>
#include <stdarg.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/types.h>
#include <sys/uio.h>

typedef long (*ptrace_function)(enum __ptrace_request, ...);

long ptrace(enum __ptrace_request request, ...)
{
    static unsigned char whole[65536];
    ptrace_function next = (ptrace_function)dlsym(RTLD_NEXT, "ptrace");
    va_list arguments;
    va_start(arguments, request);
    pid_t pid = va_arg(arguments, pid_t);
    void *address = va_arg(arguments, void *);
    void *data = va_arg(arguments, void *);
    va_end(arguments);
    if (request == PTRACE_SETREGSET && address == (void *)NT_X86_XSTATE) {
        struct iovec *given = data, all = {whole, sizeof whole};
        if (next(PTRACE_GETREGSET, pid, address, &all) == 0 && all.iov_len > given->iov_len) {
            memcpy(whole, given->iov_base, given->iov_len);
            return next(PTRACE_SETREGSET, pid, address, &all);
        }
    }
    return next(request, pid, address, data);
}
