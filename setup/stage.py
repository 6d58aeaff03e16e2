"""What the wheel and the archive carry beside code: programs, robots, policies."""

import glob
import os
import shutil
import subprocess
from typing import Tuple

from common import SetupError

CHECKOUT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
TARGET = os.environ.get("CARGO_TARGET_DIR") or os.path.join(CHECKOUT, "target")
PROGRAMS = ("caudata", "caudata-actor", "caudata-learner", "caudata-policy-server", "caudata-robot", "caudata-ros2")
_DATA: Tuple[Tuple[str, Tuple[str, ...]], ...] = (
    ("robots", ("*.toml", "*.xml", "*.urdf")),
    ("policies", ("*.onnx", "*.json")),
)


def stage(root: str, release: str = os.path.join(TARGET, "release"), strip: str = "strip") -> None:
    """Makes `bin`, `robots` and `policies` below `root` anew, of what was built into `release`. Programs find the
    other two from their own place."""
    programs = _empty(root, "bin")
    for name in PROGRAMS:
        built = os.path.join(release, name)
        if not os.path.exists(built):
            raise SetupError("%s is missing: `make build` makes it" % os.path.relpath(built))
        copy_program(built, os.path.join(programs, name), strip)
    for folder, patterns in _DATA:
        into = _empty(root, folder)
        for pattern in patterns:
            for path in glob.glob(os.path.join(CHECKOUT, folder, pattern)):
                shutil.copy(path, into)


def copy_program(built: str, packed: str, strip: str = "strip") -> None:
    """Without the names of functions: half the size."""
    if subprocess.run([strip, "-o", packed, built], stderr=subprocess.DEVNULL).returncode != 0:
        shutil.copy2(built, packed)


def _empty(root: str, name: str) -> str:
    folder = os.path.join(root, name)
    shutil.rmtree(folder, ignore_errors=True)
    os.makedirs(folder)
    return folder
