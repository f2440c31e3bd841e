"""Takes away what only Linux has from every Python process whose PYTHONPATH has this folder."""

import ctypes
import os
import pathlib
import socket
import time

MISSING = [(os, "sched_getaffinity"), (os, "sched_setaffinity"), (time, "CLOCK_BOOTTIME"), (socket, "MSG_CMSG_CLOEXEC")]
for module, name in MISSING:
    delattr(module, name)

_library, _read_text, _sysconf = ctypes.CDLL, pathlib.Path.read_text, os.sysconf


class _Library(_library):
    def __getattr__(self, name):
        if name == "prctl":
            raise AttributeError(f"there is no {name} here")
        return super().__getattr__(name)


def _read(path, *arguments, **options):
    if str(path).startswith(("/proc/", "/sys/fs/cgroup")):
        raise FileNotFoundError(f"there is no {path} here")
    return _read_text(path, *arguments, **options)


def _configured(name):
    if name == "SC_AVPHYS_PAGES":
        raise ValueError("unrecognized configuration name")
    return _sysconf(name)


ctypes.CDLL, pathlib.Path.read_text, os.sysconf = _Library, _read, _configured
