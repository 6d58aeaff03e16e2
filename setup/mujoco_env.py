"""A virtual environment in the cache with pinned MuJoCo, for the tests that compare with it.

MuJoCo is optional: where it cannot be had, set-up says so and goes on, and those tests skip.
"""

import hashlib
import os
import platform
import shutil
import subprocess
import sys
from typing import Optional

import parts
from common import cache_dir, pip_environment, say
from pins import MUJOCO_VERSION

REQUIREMENTS = os.path.join(os.path.dirname(os.path.abspath(__file__)), "mujoco-requirements.txt")
VARIABLE = "CAUDATA_MUJOCO_PYTHON"
_IMPORT = "import mujoco, numpy"


class Unavailable(Exception):
    pass


def provision(requirements: str = REQUIREMENTS) -> Optional[str]:
    """Returns the Python that imports mujoco, or None after saying why there is none."""
    users = os.environ.get(VARIABLE)
    if users and not _is_ours(users):
        if _imports_mujoco(users):
            return users
        say("mujoco: %s=%s cannot import mujoco and numpy, using our own" % (VARIABLE, users))
    try:
        return _provision(requirements)
    except (Unavailable, OSError, subprocess.SubprocessError) as error:
        say("mujoco: skipped, and with it the tests that compare with it (%s)" % error)
        return None


def ready(requirements: str = REQUIREMENTS) -> Optional[str]:
    """The Python of an earlier `--with-mujoco`, if it is still there. Starts no process."""
    users = os.environ.get(VARIABLE)
    if users and not _is_ours(users) and os.path.exists(users):
        return users
    python = _python_of(_folder(requirements))
    return python if os.path.exists(python) else None


def _provision(requirements: str) -> str:
    folder = _folder(requirements)
    if _imports_mujoco(_python_of(folder)):
        return _python_of(folder)
    with parts.locked(cache_dir()):
        if not _imports_mujoco(_python_of(folder)):
            _make(folder, requirements)
    return _python_of(folder)


def _make(folder: str, requirements: str) -> None:
    say("mujoco: installing %s for Python %s" % (MUJOCO_VERSION, platform.python_version()))
    building = folder + ".tmp"
    shutil.rmtree(building, ignore_errors=True)
    try:
        _install(building, requirements)
        shutil.rmtree(folder, ignore_errors=True)
        os.rename(building, folder)
    finally:
        shutil.rmtree(building, ignore_errors=True)
    say("mujoco: ready in %s" % folder)


def _install(building: str, requirements: str) -> None:
    # Without pip inside, because Debian keeps ensurepip in a package of its own; ours installs from outside.
    _run(sys.executable, "-m", "venv", "--without-pip", building)
    where = "import sysconfig; print(sysconfig.get_paths()['purelib'])"
    site = _run(_python_of(building), "-c", where).strip()
    _run(
        *(sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-deps"),
        *("--require-hashes", "--only-binary=:all:", "--target", site, "--requirement", requirements),
    )
    if not _imports_mujoco(_python_of(building)):
        raise Unavailable("installed, but `%s` fails" % _IMPORT)


def _folder(requirements: str) -> str:
    """One per MuJoCo version, set of pins, and Python: a changed pin or interpreter gives a new folder."""
    with open(requirements, "rb") as file:
        key = file.read() + os.path.realpath(sys.executable).encode("utf-8")
    tag = "py%d%d-%s" % (sys.version_info[0], sys.version_info[1], hashlib.sha256(key).hexdigest()[:8])
    return os.path.join(cache_dir(), "mujoco-%s-%s" % (MUJOCO_VERSION, tag))


def _python_of(folder: str) -> str:
    return os.path.join(folder, "bin", "python")


def _is_ours(python: str) -> bool:
    return os.path.abspath(python).startswith(cache_dir() + os.sep)


def _imports_mujoco(python: str) -> bool:
    if not os.path.exists(python):
        return False
    done = subprocess.run(
        [python, "-c", _IMPORT], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, timeout=120, check=False
    )
    return done.returncode == 0


def _run(*command: str) -> str:
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=pip_environment())
    if done.returncode != 0:
        lines = done.stderr.decode("utf-8", "replace").strip().splitlines()
        errors = [line for line in lines if line.startswith("ERROR")] or lines[-1:] or ["no message"]
        raise Unavailable(errors[-1])
    return done.stdout.decode("utf-8", "replace")
