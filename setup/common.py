"""What all set-up modules share: error kinds with their exit codes, and lines for the user."""

import os
import platform
import sys
from typing import Dict


class SetupError(Exception):
    """A failure the user can act on: one line that says what, where and what to do."""

    exit_code = 1


class NetworkError(SetupError):
    exit_code = 10


class HashError(SetupError):
    exit_code = 11


class DiskError(SetupError):
    exit_code = 12


class UserPathError(SetupError):
    """LIBTORCH or ORT_DYLIB_PATH, as the user set it, does not hold what is needed."""

    exit_code = 13


class PlatformError(SetupError):
    exit_code = 14


class CacheError(SetupError):
    """The cache folder cannot be created, written or locked."""

    exit_code = 15


class PipError(SetupError):
    exit_code = 16


def say(text: str) -> None:
    # Standard error, because standard output belongs to `--print-env`.
    print("setup: " + text, file=sys.stderr, flush=True)


def cache_dir() -> str:
    base = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    return os.path.join(os.path.abspath(base), "caudata")


def machine() -> str:
    """The processor name as the wheels spell it; refuses what no wheel exists for."""
    arch = {"amd64": "x86_64", "arm64": "aarch64"}.get(platform.machine().lower(), platform.machine())
    if sys.platform != "linux" or arch not in ("x86_64", "aarch64"):
        raise PlatformError(
            "no pinned libraries for %s on %s: set LIBTORCH to your own libtorch and ORT_DYLIB_PATH"
            " to your own ONNX Runtime library, then run this again" % (arch, sys.platform)
        )
    return arch


def pip_environment() -> Dict[str, str]:
    """The user's pip settings, less those that forbid a download or an install into a folder."""
    return dict(os.environ, PIP_USER="0", PIP_REQUIRE_VIRTUALENV="0", PIP_ROOT_USER_ACTION="ignore")


def megabytes(size: float) -> str:
    return "%d MB" % round(size / 1e6) if size >= 1e6 else "%d kB" % round(size / 1e3)
