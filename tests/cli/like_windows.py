"""Run commands, one per line of the standard input, without what Windows lacks; print exit codes and last lines.

Other libraries are imported before, because they have code of their own for Windows.
"""

import importlib
import os
import pathlib
import pkgutil
import select
import selectors
import shlex
import signal
import sys
import types

OTHERS = """click.testing concurrent.futures h5py matplotlib.backends.backend_agg matplotlib.pyplot msgspec.toml
multiprocessing.connection multiprocessing.pool numba.cuda platformdirs rich.progress scipy.fft scipy.interpolate
scipy.io scipy.ndimage scipy.optimize scipy.signal scipy.spatial scipy.special scipy.stats serial.tools.list_ports yaml
zmq.auth"""
MODULES = ("fcntl", "grp", "pty", "pwd", "resource", "syslog", "termios", "tty")
GONE = {
    os: (
        *("WNOHANG", "chown", "fchmod", "fchown", "fork", "forkpty", "getegid", "geteuid", "getgid", "getloadavg"),
        *("getpgid", "getuid", "killpg", "mkfifo", "nice", "openpty", "posix_fallocate", "pread", "pwrite"),
        *("register_at_fork", "sched_getaffinity", "setpgid", "setsid", "sysconf", "uname", "wait4", "waitid"),
        *("O_DIRECTORY", "O_NOFOLLOW", "O_NONBLOCK"),
    ),
    signal: (
        *("SIGALRM", "SIGCHLD", "SIGCONT", "SIGHUP", "SIGKILL", "SIGPIPE", "SIGQUIT", "SIGSTOP", "SIGTSTP", "SIGUSR1"),
        *("SIGUSR2", "SIGWINCH", "ITIMER_REAL", "SIG_BLOCK", "SIG_UNBLOCK", "alarm", "pthread_kill"),
        *("pthread_sigmask", "setitimer", "siginterrupt", "sigtimedwait", "sigwait"),
    ),
    selectors: ("EpollSelector", "PollSelector"),
    select: ("epoll", "poll"),
}


def take_away():
    """Turn this process into one like those on Windows, as far as Python code sees it."""
    sys.modules.update(dict.fromkeys(MODULES))
    for module, names in GONE.items():
        for name in names:
            if hasattr(module, name):
                delattr(module, name)
    sys.modules["msvcrt"] = types.ModuleType("msvcrt")
    vars(sys.modules["msvcrt"]).update(LK_LOCK=0, LK_NBLCK=0, LK_UNLCK=0, locking=lambda *_: None)
    sys.modules["nt"] = types.ModuleType("nt")  # for ctypes
    flags = {"_LOAD_LIBRARY_SEARCH_DEFAULT_DIRS": os.RTLD_NOW, "_LOAD_LIBRARY_SEARCH_DLL_LOAD_DIR": 0}
    vars(sys.modules["nt"]).update(flags, _getfullpathname=str)
    pathlib.WindowsPath = pathlib.PosixPath
    sys.platform, os.name = "win32", "nt"


def import_all():
    """Import every module but those that need a GPU."""
    for root in ("ertis_numba", "ertis_cli"):
        for found in pkgutil.walk_packages(importlib.import_module(root).__path__, f"{root}."):
            if found.name.rpartition(".")[2] not in {"__main__", "gpu", "_cufft"}:
                importlib.import_module(found.name)


if __name__ == "__main__":
    for other in OTHERS.split():
        importlib.import_module(other)
    take_away()
    import_all()
    cli = importlib.import_module("ertis_cli.main").cli
    for line in sys.stdin.read().splitlines():
        done = sys.modules["click.testing"].CliRunner().invoke(cli, shlex.split(line))
        sys.stdout.write(f"{done.exit_code} | {line} | {(done.stderr.splitlines() or [''])[-1]}\n")
