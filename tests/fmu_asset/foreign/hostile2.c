/* FMI 2.0 co-simulation that misbehaves in the way that -D says, in the third step unless it does so earlier
   (and only while the file named by HOSTILE_FLAG exists, if that is set): otherwise an integrator. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <math.h>
#include <netinet/in.h>
#include <signal.h>
#include <spawn.h>
#include <stdio.h>
#include <sched.h>
#include <sys/inotify.h>
#include <sys/msg.h>
#include <sys/prctl.h>
#include <sys/resource.h>
#include <sys/sem.h>
#include <sys/shm.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/un.h>
#include <sys/wait.h>
#include <unistd.h>
#include "model.h"
enum { Y, U, DAMAGE, FACTOR };
#ifndef AFTER
#define AFTER 2 /* steps that go well */
#endif

static int starts; /* of the process, so that a reset shows */
void model_start(Model *m) { m->r[FACTOR] = 1.0; starts++; }
static void hang(void) { for (;;) pause(); } /* without a processor's time */
static void *volatile kept; /* so that the compiler does not leave the memory out */
static void take(size_t size) { kept = memset(malloc(size), 1, size); }
static void crash(void) { *(volatile int *)8 = 1; }

/* What ATTEMPT may be, to the file, port or process that the environment names; below 0 if it fails. */
#define TARGET getenv("HOSTILE_TARGET")
static int overwrite(const char *path) { return open(path, O_WRONLY | O_TRUNC); }
static int create(const char *path) { return open(path, O_WRONLY | O_CREAT, 0600); }
static int look_into(const char *path) {
    char some[8];
    return open(path, O_RDONLY) < 0 ? -1 : read(open(path, O_RDONLY), some, 8) > 0 ? 0 : -1;
}
static int write_everywhere(const void *what, size_t size) {
    for (int k = 3; k < 64; k++) if (write(k, what, size) < 0) continue;
    return 0;
}
static int write_message(const char *text) { /* as Python's multiprocessing.connection sends it */
    struct { unsigned length; char text[512]; } message = {htonl(strlen(text))};
    strcpy(message.text, text);
    return write_everywhere(&message, 4 + strlen(text));
}
static int send_by_pair(const char *path) {
    struct sockaddr_un there = {AF_UNIX};
    int pair[2];
    strcpy(there.sun_path, path);
    if (socketpair(AF_UNIX, SOCK_DGRAM, 0, pair) < 0) return -1;
    return sendto(pair[0], "key", 3, 0, (struct sockaddr *)&there, sizeof there);
}
static void hold_pipes(void) { /* open for oneself what the twin has open */
    char name[40];
    for (int k = 3; k < 64; k++) if (sprintf(name, "/proc/self/fd/%d", k)) open(name, O_RDWR | O_NONBLOCK);
}
static int call(int kind, int protocol, const char *port) {
    struct sockaddr_in there = {AF_INET, htons(atoi(port)), {htonl(INADDR_LOOPBACK)}};
    int line = socket(AF_INET, kind, protocol);
    if (line < 0 || connect(line, (struct sockaddr *)&there, sizeof there) < 0) return -1;
    return send(line, "key", 3, 0);
}
static int call_service(const char *path) {
    struct sockaddr_un there = {AF_UNIX};
    int line = socket(AF_UNIX, SOCK_STREAM, 0);
    strcpy(there.sun_path, path);
    return line < 0 ? -1 : connect(line, (struct sockaddr *)&there, sizeof there);
}
static int start_program(const char *path) {
    char *words[] = {"touch", (char *)path, NULL}, *none[] = {NULL};
    pid_t child;
    int status = 0;
    errno = posix_spawn(&child, "/usr/bin/touch", NULL, NULL, words, none);
    return errno ? -1 : waitpid(child, &status, 0);
}

static char there[512];
static const char *beside_binary(void) { /* a new file in the folder of the extracted FMU */
    Dl_info self;
    dladdr((void *)beside_binary, &self);
    return strcat(strcpy(there, self.dli_fname), ".new");
}
static const char *in_temporary(void) { return strcat(strcpy(there, getenv("TMPDIR")), "/new"); }
#define BY_CHILD(what) ({ \
    int status; \
    if (fork() == 0) _exit((what) < 0); \
    wait(&status); \
    errno = EACCES; \
    -status; \
})

#if defined CRASH_AT_LOAD
__attribute__((constructor)) static void load(void) { crash(); }
#elif defined HANG_AT_LOAD
__attribute__((constructor)) static void load(void) { hang(); }
#elif defined EXIT_AT_LOAD
__attribute__((constructor)) static void load(void) { exit(4); }
#elif defined MISSING_LIBRARY_FUNCTION
void function_that_no_library_has(void);
__attribute__((constructor)) static void load(void) { function_that_no_library_has(); }
#endif

void *frame_instance(Model *m) {
#ifdef NO_INSTANCE
    model_say(m, ERROR, "no licence");
    return NULL;
#endif
    return m;
}
static double hidden; /* of the process, not of the state */
static int process_clock;
#ifdef STAYS_LOADED
__attribute__((constructor)) static void stay(void) {
    Dl_info self;
    if (dladdr((void *)stay, &self)) dlopen(self.dli_fname, RTLD_LAZY | RTLD_NODELETE);
}
#endif
#define INSTANCE_CLOCK *(int *)(m->parts[3] ? m->parts[3] : (m->parts[3] = calloc(1, sizeof(int))))

int frame_get_state(Model *m, Model *copy) {
#ifdef STATE_ERROR
    model_say(m, ERROR, "fmi2GetFMUstate is not implemented");
    return ERROR;
#endif
    *copy = *m;
    return OK;
}
int frame_set_state(Model *m, const Model *copy) {
#ifdef STATE_NOT_RESTORED
    return OK;
#elif defined STATE_CRASH
    crash();
#endif
    *m = *copy;
    return OK;
}
int model_initialise(Model *m) {
#ifdef HANG_IN_INITIALISATION
    hang();
#elif defined REFUSE_INITIALISATION
    model_say(m, ERROR, "the table file is missing");
    return ERROR;
#endif
    hidden = 0.0;
    return OK;
}
int model_step(Model *m, double time, double size) {
#ifdef STATELESS
    m->r[Y] = m->r[FACTOR] * m->r[U] * (1.0 - m->r[DAMAGE]);
#elif defined NEGATIVE_ZERO_AFTER_RESET
    m->r[Y] = starts > 1 ? -0.0 : 0.0;
#else
    m->r[Y] += m->r[U] * size;
#endif
    hidden += 1.0;
#if defined CLOCK /* of the instance or of the process, and no reset brings it back */
    if (++(CLOCK) > 5) m->r[Y] += 1.0;
#endif
#if defined STATE_HIDDEN
    m->r[Y] += 0.001 * hidden;
#elif defined NOT_DETERMINISTIC
    m->r[Y] += 1e-9 * (double)getpid() + 1e-12 * hidden;
#endif
    if (m->stepped < AFTER) return OK;
    if (getenv("HOSTILE_FLAG") && access(getenv("HOSTILE_FLAG"), F_OK) != 0) return OK;
#if defined ENDS
    m->r[Y] -= 0.5 * m->r[U] * size;
    m->time = time + 0.5 * size;
    m->i[14] = 1;
    return DISCARD;
#elif defined SEGFAULT
    crash();
#elif defined ABORT
    abort();
#elif defined DIVIDE
    raise(SIGFPE);
#elif defined HANG
    hang();
#elif defined EXIT
    exit(3);
#elif defined KILL
    kill(getpid(), SIGKILL);
#elif defined LEAK_IN_STEP
    for (;;) take(1 << 20);
#elif defined LEAK_SLOWLY
    take(16 << 20);
#elif defined FILL_DISK
    {
        FILE *file = fopen("big.log", "w");
        ftruncate(fileno(file), (off_t)3 << 30);
        lseek(fileno(file), (off_t)3 << 30, SEEK_SET);
        fputs("x", file);
        fclose(file);
    }
#elif defined NOT_A_NUMBER
    m->r[Y] = NAN;
#elif defined REFUSE
    if (m->r[U] > 5.0) {
        m->r[Y] -= m->r[U] * size;
        model_say(m, DISCARD, "u is too large");
        return DISCARD;
    }
#elif defined FAIL
    model_say(m, ERROR, "the iteration does not converge");
    return ERROR;
#elif defined FATALLY
    model_say(m, FATAL, "out of memory");
    return FATAL;
#elif defined ASYNCHRONOUS
    return PENDING;
#elif defined ODD_STATUS
    return 42;
#elif defined CLOSE_FILES
    for (int k = 3; k < 64; k++) close(k);
#elif defined WRITE_INTO_PIPES
    for (int k = 3; k < 64; k++) if (write(k, "rubbish rubbish rubbish", 23) < 0) continue;
#elif defined HALF_AN_ANSWER
    write_everywhere("\1\0\0\0\0\0\0\0", 8);
    hang();
#elif defined START_PROCESS
    if (m->stepped == 2 && fork() == 0) for (;;) pause();
#elif defined FORK_AND_RETURN
    if (m->stepped == AFTER) fork(); /* two processes return from this step, and would answer */
#elif defined START_PROCESS_ELSEWHERE
    if (m->stepped == AFTER && fork() == 0) {
        GROUP;
        for (;;) pause();
    }
#elif defined ESCAPE /* nobody's death ends it, nor its grandchild in another session */
    if (m->stepped == AFTER) {
        prctl(PR_SET_PDEATHSIG, 0);
        if (fork() == 0) {
            setsid();
            if (fork() == 0) for (;;) pause();
            _exit(0);
        }
        ESCAPE;
    }
#elif defined HOP /* ever new processes, of which each lives for a moment */
    if (m->stepped == AFTER && fork() == 0) for (;;) if (fork() != 0) _exit(0);
#elif defined NEST_FOLDERS
    for (int k = 0; k < 3000; k++) if (mkdir("d", 0755) || chdir("d")) return ERROR;
#elif defined NEGATIVE_STATUS
    return -1;
#elif defined CHATTER
    for (int k = 0; k < 100000; k++) puts("step step step step step step step step");
    fflush(stdout);
#elif defined ATTEMPT
    if (m->stepped > AFTER) return OK;
    if ((ATTEMPT) < 0) {
        char text[512];
        snprintf(text, sizeof text, "it cannot have %s: %s", TARGET, strerror(errno));
#ifndef SILENT
        model_say(m, ERROR, text);
        errno = 0;
#endif
        return ERROR;
    }
#elif defined REMOVE_FILES
    if (system("rm -rf \"$PWD\"/*") != 0) return ERROR;
#elif defined IGNORE_SIGNALS
    signal(SIGTERM, SIG_IGN);
    signal(SIGINT, SIG_IGN);
    hang();
#endif
    return OK;
}
void model_free(Model *m) {
#ifdef CRASH_IN_FREE
    crash();
#elif defined HANG_IN_FREE
    hang();
#elif defined LEAK_IN_FREE
    take(1 << 18);
#endif
}
