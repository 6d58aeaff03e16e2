"""Virtual environments in the cache with pinned Python packages, for the tests that compare with them.

They are optional: where one cannot be had, set-up says so and goes on, and its tests skip.
"""

import hashlib
import os
import platform
import shutil
import subprocess
import sys
from typing import Any, NamedTuple, Optional

import parts
from common import cache_dir, pip_environment, say
from pins import MUJOCO_VERSION, PYARROW_VERSION, RCLPY_VERSION

HERE = os.path.dirname(os.path.abspath(__file__))


class Environment(NamedTuple):
    name: str
    version: str
    requirements: str
    variable: str  # tells the tests which Python it is
    imports: str
    whole: bool  # its packages lay files beside site-packages, which takes a pip that knows --python (22.3)


MUJOCO = Environment(
    name="mujoco",
    version=MUJOCO_VERSION,
    requirements=os.path.join(HERE, "mujoco-requirements.txt"),
    variable="CAUDATA_MUJOCO_PYTHON",
    imports="import mujoco, numpy",
    whole=False,
)
RECORDINGS = Environment(
    name="recordings",
    version=PYARROW_VERSION,
    requirements=os.path.join(HERE, "recordings-requirements.txt"),
    variable="CAUDATA_PYTHON",
    imports="import pyarrow, pyarrow.parquet, numpy, sqlite3",
    whole=False,
)
ROS2 = Environment(
    name="ros2",
    version=RCLPY_VERSION,
    requirements=os.path.join(HERE, "ros2-requirements.txt"),
    variable="CAUDATA_ROS2_PYTHON",
    imports="import rclpy.serialization, sensor_msgs.msg, geometry_msgs.msg, diagnostic_msgs.msg, mcap.writer, zenoh_ros2_sdk",
    whole=True,
)


class Unavailable(Exception):
    pass


def provision(wanted: Environment) -> Optional[str]:
    """Returns the Python that imports it, or None after saying why there is none."""
    users = os.environ.get(wanted.variable)
    if users and not _is_ours(users):
        if _imports(wanted, users):
            return users
        say("%s: `%s` fails with %s=%s, using our own" % (wanted.name, wanted.imports, wanted.variable, users))
    try:
        return _provision(wanted)
    except (Unavailable, OSError, subprocess.SubprocessError) as error:
        say("%s: skipped, and with it the tests that compare with it (%s)" % (wanted.name, error))
        return None


def ready(wanted: Environment) -> Optional[str]:
    """The Python of an earlier `--with-…`, if it is still there. Starts no process."""
    users = os.environ.get(wanted.variable)
    if users and not _is_ours(users) and os.path.exists(users):
        return users
    python = _python_of(_folder(wanted))
    return python if os.path.exists(python) else None


def _provision(wanted: Environment) -> str:
    folder = _folder(wanted)
    if _imports(wanted, _python_of(folder)):
        return _python_of(folder)
    with parts.locked(cache_dir()):
        if not _imports(wanted, _python_of(folder)):
            _make(wanted, folder)
    return _python_of(folder)


def _make(wanted: Environment, folder: str) -> None:
    say("%s: installing %s for Python %s" % (wanted.name, wanted.version, platform.python_version()))
    building = folder + ".tmp"
    shutil.rmtree(building, ignore_errors=True)
    try:
        _install(wanted, building)
        shutil.rmtree(folder, ignore_errors=True)
        os.rename(building, folder)
    finally:
        shutil.rmtree(building, ignore_errors=True)
    say("%s: ready in %s" % (wanted.name, folder))


def _install(wanted: Environment, building: str) -> None:
    # Without pip inside, because Debian keeps ensurepip in a package of its own; ours installs from outside.
    _run(sys.executable, "-m", "venv", "--without-pip", building)
    python = _python_of(building)
    pip = (sys.executable, "-m", "pip")
    if wanted.whole:
        where = ()
        pip += ("--python", python)
    else:
        site = _run(python, "-c", "import sysconfig; print(sysconfig.get_paths()['purelib'])").strip()
        where = ("--target", site)
    # On a terminal pip shows how long the downloads will take.
    shown = sys.stderr.isatty()
    _run(
        *pip, "install", *(() if shown else ("--quiet",)), "--disable-pip-version-check", "--no-deps",
        *("--require-hashes", "--only-binary=:all:", *where, "--requirement", wanted.requirements),
        stdout=sys.stderr if shown else subprocess.PIPE,
    )
    if not _imports(wanted, python):
        raise Unavailable("installed, but `%s` fails" % wanted.imports)


def _folder(wanted: Environment) -> str:
    """One per version, set of pins, and Python: a changed pin or interpreter gives a new folder."""
    with open(wanted.requirements, "rb") as file:
        key = file.read() + os.path.realpath(sys.executable).encode("utf-8")
    tag = "py%d%d-%s" % (sys.version_info[0], sys.version_info[1], hashlib.sha256(key).hexdigest()[:8])
    return os.path.join(cache_dir(), "%s-%s-%s" % (wanted.name, wanted.version, tag))


def _python_of(folder: str) -> str:
    return os.path.join(folder, "bin", "python")


def _is_ours(python: str) -> bool:
    return os.path.abspath(python).startswith(cache_dir() + os.sep)


def _imports(wanted: Environment, python: str) -> bool:
    if not os.path.exists(python):
        return False
    done = subprocess.run(
        [python, "-c", wanted.imports], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, timeout=120, check=False
    )
    return done.returncode == 0


def _run(*command: str, stdout: Any = subprocess.PIPE) -> str:
    done = subprocess.run(command, stdout=stdout, stderr=subprocess.PIPE, env=pip_environment())
    if done.returncode != 0:
        lines = done.stderr.decode("utf-8", "replace").strip().splitlines()
        errors = [line for line in lines if line.startswith("ERROR")] or lines[-1:] or ["no message"]
        raise Unavailable(errors[-1])
    return (done.stdout or b"").decode("utf-8", "replace")
