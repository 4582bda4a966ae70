/* Log of all operations that reach the file system below a folder. Load this library with LD_PRELOAD.

   Environment:
     POWERCUT_FOLDER  absolute path; files below it are logged
     POWERCUT_LOG     file to which records are appended
     POWERCUT_ACKS    absolute path of a file; what is written to it is logged as acknowledged
     POWERCUT_STDOUT  if set, what is written to descriptor 1 is logged as acknowledged
     POWERCUT_FAIL    "FIRST COUNT SEED": from number FIRST on, COUNT syncs fail with EIO: one after the other where
                      SEED is even, or else each with probability 1/2; every process counts its own

   A record is a struct entry, the path, a second path or the data. One writev per record: with O_APPEND, records of
   several processes do not mix, and their order is that of the events.

   Not logged: memory maps, links, splice and its relatives. Nothing that is tested here uses them.  */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/uio.h>
#include <unistd.h>

enum kind { CREATE = 1, WRITE, TRUNCATE, SYNC_BEGIN, SYNC_END, SYNC_FAIL, RENAME, UNLINK, MKDIR, RMDIR, ACK };

struct entry {
  uint32_t kind, pid;
  uint64_t inode, offset;
  uint32_t path_bytes, data_bytes;
};

static const char *folder, *acks;
static size_t folder_bytes;
static int log_fd = -1, stdout_acks;
static unsigned fail_first, fail_count, fail_seed, n_syncs, n_failed;

#define REAL(name) ((typeof(&name))real(#name))
static void *real(const char *name) { return dlsym(RTLD_NEXT, name); }

__attribute__((constructor)) static void begin(void) {
  const char *log = getenv("POWERCUT_LOG"), *fail = getenv("POWERCUT_FAIL");
  folder = getenv("POWERCUT_FOLDER");
  acks = getenv("POWERCUT_ACKS");
  stdout_acks = getenv("POWERCUT_STDOUT") != NULL;
  if (!log || !folder) return;
  folder_bytes = strlen(folder);
  if (fail) sscanf(fail, "%u %u %u", &fail_first, &fail_count, &fail_seed);
  int low = REAL(open)(log, O_WRONLY | O_APPEND | O_CREAT | O_CLOEXEC, 0600);
  log_fd = fcntl(low, F_DUPFD_CLOEXEC, 500);
  REAL(close)(low);
}

static void put(enum kind kind, uint64_t inode, uint64_t offset, const char *path, const void *data, size_t n) {
  int saved = errno;
  struct entry entry = {kind, (uint32_t)getpid(), inode, offset, path ? (uint32_t)strlen(path) : 0, (uint32_t)n};
  struct iovec parts[] = {{&entry, sizeof entry}, {(void *)path, entry.path_bytes}, {(void *)data, n}};
  REAL(writev)(log_fd, parts, 3);
  errno = saved;
}

static int is_ours(const char *path) {
  return log_fd >= 0 && !strncmp(path, folder, folder_bytes) && (path[folder_bytes] == '/' || !path[folder_bytes]);
}

/* Absolute path of a name, without following a link at its end. */
static int absolute(int at, const char *name, char *path) {
  int n = 0;
  if (name[0] != '/') {
    char link[40];
    if (at == AT_FDCWD) strcpy(link, "/proc/self/cwd");
    else snprintf(link, sizeof link, "/proc/self/fd/%d", at);
    n = (int)readlink(link, path, PATH_MAX - 1);
    if (n < 0) return 0;
    path[n++] = '/';
  }
  return snprintf(path + n, (size_t)(PATH_MAX - n), "%s", name) < PATH_MAX - n;
}

/* Path and status of a descriptor, if it is below the folder. */
static int known(int fd, char *path, struct stat *status) {
  if (log_fd < 0 || fd == log_fd) return 0;
  int saved = errno, found = 0;
  char link[40];
  snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
  ssize_t n = readlink(link, path, PATH_MAX - 1);
  if (n > 0) {
    path[n] = 0;
    found = is_ours(path) && !fstat(fd, status) && (S_ISREG(status->st_mode) || S_ISDIR(status->st_mode));
  }
  errno = saved;
  return found;
}

static int opened(int at, const char *name, int flags, mode_t mode) {
  char path[PATH_MAX];
  int ours = log_fd >= 0 && (flags & (O_CREAT | O_TRUNC)) && (flags & O_TMPFILE) != O_TMPFILE &&
             absolute(at, name, path) && is_ours(path);
  int is_new = ours && (flags & O_CREAT) && faccessat(AT_FDCWD, path, F_OK, AT_SYMLINK_NOFOLLOW);
  int fd = REAL(openat)(at, name, flags, mode);
  struct stat status;
  if (fd >= 0 && ours && !fstat(fd, &status) && S_ISREG(status.st_mode)) {
    if (is_new) put(CREATE, status.st_ino, 0, path, NULL, 0);
    else if (flags & O_TRUNC) put(TRUNCATE, status.st_ino, 0, path, NULL, 0);
  }
  return fd;
}

#define MODE \
  mode_t mode = 0; \
  if (flags & (O_CREAT | O_TMPFILE)) { va_list more; va_start(more, flags); mode = va_arg(more, mode_t); va_end(more); }
int open(const char *name, int flags, ...) { MODE return opened(AT_FDCWD, name, flags, mode); }
int open64(const char *name, int flags, ...) { MODE return opened(AT_FDCWD, name, flags | O_LARGEFILE, mode); }
int openat(int at, const char *name, int flags, ...) { MODE return opened(at, name, flags, mode); }
int openat64(int at, const char *name, int flags, ...) { MODE return opened(at, name, flags | O_LARGEFILE, mode); }
int creat(const char *name, mode_t mode) { return opened(AT_FDCWD, name, O_CREAT | O_WRONLY | O_TRUNC, mode); }

static void wrote(int fd, const void *data, ssize_t n, off64_t offset) {
  char path[PATH_MAX];
  struct stat status;
  if (n <= 0 || log_fd < 0) return;
  if (fd == 1 && stdout_acks) put(ACK, 0, 0, NULL, data, (size_t)n);
  else if (known(fd, path, &status)) {
    if (offset < 0) offset = lseek64(fd, 0, SEEK_CUR) - n;
    put(WRITE, status.st_ino, (uint64_t)offset, path, data, (size_t)n);
  } else if (acks && fd > 2) {
    char link[40];
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t length = readlink(link, path, PATH_MAX - 1);
    if (length > 0 && (path[length] = 0, !strcmp(path, acks))) put(ACK, 0, 0, NULL, data, (size_t)n);
  }
}

ssize_t write(int fd, const void *data, size_t n) {
  ssize_t done = REAL(write)(fd, data, n);
  int saved = errno;
  wrote(fd, data, done, -1);
  errno = saved;
  return done;
}

ssize_t pwrite64(int fd, const void *data, size_t n, off64_t offset) {
  ssize_t done = REAL(pwrite64)(fd, data, n, offset);
  int saved = errno;
  wrote(fd, data, done, offset);
  errno = saved;
  return done;
}
ssize_t pwrite(int fd, const void *data, size_t n, off_t offset) { return pwrite64(fd, data, n, offset); }

ssize_t writev(int fd, const struct iovec *parts, int count) {
  char path[PATH_MAX];
  struct stat status;
  if (!known(fd, path, &status)) return REAL(writev)(fd, parts, count);
  ssize_t total = 0;
  for (int i = 0; i < count; i++) {
    ssize_t done = write(fd, parts[i].iov_base, parts[i].iov_len);
    if (done < 0) return total ? total : done;
    total += done;
    if ((size_t)done < parts[i].iov_len) break;
  }
  return total;
}

int ftruncate64(int fd, off64_t n) {
  char path[PATH_MAX];
  struct stat status;
  int result = REAL(ftruncate64)(fd, n);
  if (!result && known(fd, path, &status)) put(TRUNCATE, status.st_ino, (uint64_t)n, path, NULL, 0);
  return result;
}
int ftruncate(int fd, off_t n) { return ftruncate64(fd, n); }

int truncate64(const char *name, off64_t n) {
  char path[PATH_MAX];
  struct stat status;
  int result = REAL(truncate64)(name, n);
  if (!result && absolute(AT_FDCWD, name, path) && is_ours(path) && !stat(path, &status))
    put(TRUNCATE, status.st_ino, (uint64_t)n, path, NULL, 0);
  return result;
}
int truncate(const char *name, off_t n) { return truncate64(name, n); }

static int synced(int fd, int (*sync)(int)) {
  char path[PATH_MAX];
  struct stat status;
  if (!known(fd, path, &status)) return sync(fd);
  put(SYNC_BEGIN, status.st_ino, S_ISDIR(status.st_mode), path, NULL, 0);
  unsigned number = __atomic_fetch_add(&n_syncs, 1, __ATOMIC_SEQ_CST);
  uint32_t mixed = (number + 1 + fail_seed) * 2654435761u;
  if (number >= fail_first && n_failed < fail_count && (!(fail_seed & 1) || (mixed >> 16 & 1))) {
    __atomic_fetch_add(&n_failed, 1, __ATOMIC_SEQ_CST);
    put(SYNC_FAIL, status.st_ino, S_ISDIR(status.st_mode), path, NULL, 0);
    errno = EIO;
    return -1;
  }
  int result = 0; /* The disk model decides which data is durable, so a real sync is not needed. */
  put(SYNC_END, status.st_ino, S_ISDIR(status.st_mode), path, NULL, 0);
  return result;
}
int fsync(int fd) { return synced(fd, REAL(fsync)); }
int fdatasync(int fd) { return synced(fd, REAL(fdatasync)); }

int renameat2(int from_at, const char *from, int to_at, const char *to, unsigned flags) {
  char source[PATH_MAX], target[PATH_MAX];
  int ours = log_fd >= 0 && absolute(from_at, from, source) && absolute(to_at, to, target) && is_ours(target);
  int result = REAL(renameat2)(from_at, from, to_at, to, flags);
  if (!result && ours) put(RENAME, 0, 0, source, target, strlen(target));
  return result;
}
int renameat(int from_at, const char *from, int to_at, const char *to) {
  return renameat2(from_at, from, to_at, to, 0);
}
int rename(const char *from, const char *to) { return renameat2(AT_FDCWD, from, AT_FDCWD, to, 0); }

int unlinkat(int at, const char *name, int flags) {
  char path[PATH_MAX];
  int ours = log_fd >= 0 && absolute(at, name, path) && is_ours(path);
  int result = REAL(unlinkat)(at, name, flags);
  if (!result && ours) put(flags & AT_REMOVEDIR ? RMDIR : UNLINK, 0, 0, path, NULL, 0);
  return result;
}
int unlink(const char *name) { return unlinkat(AT_FDCWD, name, 0); }
int rmdir(const char *name) { return unlinkat(AT_FDCWD, name, AT_REMOVEDIR); }
int remove(const char *name) { return unlink(name) && (errno == EISDIR || errno == EPERM) ? rmdir(name) : 0; }

int mkdirat(int at, const char *name, mode_t mode) {
  char path[PATH_MAX];
  int result = REAL(mkdirat)(at, name, mode);
  if (!result && log_fd >= 0 && absolute(at, name, path) && is_ours(path)) put(MKDIR, 0, 0, path, NULL, 0);
  return result;
}
int mkdir(const char *name, mode_t mode) { return mkdirat(AT_FDCWD, name, mode); }
